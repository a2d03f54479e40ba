"""A HostAdapter for a model that samples in a way of its own: host_adapter.py FILE"""

import argparse

import torch
from nerfstudio.cameras.rays import RayBundle, RaySamples
from nerfstudio.model_components.ray_samplers import UniformSampler
from torch import nn

from leco_plugin.hosts.guide import Guide
from leco_plugin.hosts.seams import HostAdapter
from leco_plugin.occupancy import Occupancy


class MyModel(nn.Module):
    """Stands for your nerfstudio `Model`: what samples is called `my_sampler`."""

    def __init__(self) -> None:
        super().__init__()
        self.my_sampler = UniformSampler(num_samples=64)


class Guided(nn.Module):
    """Called as MyModel calls its own sampler: a ray bundle in, ray samples out."""

    def __init__(self, sampler: nn.Module) -> None:
        super().__init__()
        self.sampler = sampler  # a submodule, so that train() and eval() reach it

    def forward(self, ray_bundle: RayBundle) -> RaySamples:
        return self.sampler(ray_bundle, density_fns=[])[0]  # its weights and candidates follow


def swap(host: MyModel, guide: Guide) -> None:
    """Puts the guide's sampler in the host's place; also remove what it makes superfluous."""
    # guide.proposal: a fixed number of samples on each ray, drawn where the occupancy is;
    # guide.estimator(aabb): packed samples, called as nerfacc's OccGridEstimator
    host.my_sampler = Guided(guide.proposal(num_samples=64, initial_sampler=UniformSampler()))


ADAPTER = HostAdapter("the sampler of MyModel", lambda host: isinstance(host, MyModel), swap)

if __name__ == "__main__":  # what `leco swap` does once ADAPTER is an entry point
    parser = argparse.ArgumentParser(description=__doc__.partition(":")[0])
    parser.add_argument("file", help="occupancy.safetensors of a run")
    try:
        occupancy = Occupancy.load(parser.parse_args().file)
    except (OSError, ValueError) as error:
        parser.error(str(error))
    guide, host = Guide(), MyModel().eval()
    guide.set_occupancy(occupancy)
    away = torch.nn.functional.normalize(torch.randn(256, 3), dim=-1)
    ends = torch.full((256, 1), 3.0 * float(occupancy.space.half_extent))
    origins = occupancy.space.center + ends * away
    rays = RayBundle(origins, -away, torch.ones(256, 1), nears=0 * ends, fars=2 * ends)
    for name in ("its own sampler", "the guide's"):
        places = host.my_sampler(rays).frustums.get_positions().reshape(-1, 3)
        print(f"{name}: {occupancy.occupied(places).float().mean():.0%} of samples are occupied")
        if ADAPTER.fits(host):
            ADAPTER.swap(host, guide)
