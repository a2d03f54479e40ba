"""Learned occupancy in a plain torch + nerfacc loop: plain_torch_nerfacc_loop.py FILE [STEPS]."""

import argparse

import nerfacc
import torch

from leco_plugin.occupancy import Occupancy
from leco_plugin.samplers.estimator import LearnedOccupancyEstimator
from leco_plugin.samplers.nerfacc_cpu import install

install()  # nerfacc alone needs CUDA
parser = argparse.ArgumentParser(description=__doc__.partition(":")[0])
parser.add_argument("file", help="occupancy.safetensors of a run")
parser.add_argument("steps", type=int, nargs="?", default=200)
given = parser.parse_args()
try:
    occupancy = Occupancy.load(given.file)
except (OSError, ValueError) as error:
    parser.error(str(error))
options = {"far_plane": occupancy.report["far"], "render_step_size": 0.02, "stratified": True}
estimator = LearnedOccupancyEstimator(occupancy)
field = torch.nn.Sequential(torch.nn.Linear(3, 64), torch.nn.ReLU(), torch.nn.Linear(64, 4))
optimizer = torch.optim.Adam(field.parameters(), lr=1e-2)
for step in range(given.steps):
    rays_o = torch.nn.functional.normalize(torch.randn(512, 3), dim=-1)  # your rays here
    rays_d = torch.nn.functional.normalize(0.3 * torch.randn(512, 3) - rays_o, dim=-1)

    def rgb_sigma(t_starts, t_ends, rays, rays_o=rays_o, rays_d=rays_d):
        rgb_sigma = field(rays_o[rays] + rays_d[rays] * ((t_starts + t_ends) / 2)[:, None])
        return rgb_sigma[:, :3].sigmoid(), torch.nn.functional.softplus(rgb_sigma[:, 3])

    rays, t0, t1 = estimator.sampling(rays_o, rays_d, **options)
    rgb = nerfacc.rendering(t0, t1, rays, len(rays_o), rgb_sigma, render_bkgd=torch.ones(3))[0]
    loss = torch.nn.functional.mse_loss(rgb, rays_o * 0.5 + 0.5)  # your pixels
    optimizer.zero_grad(), loss.backward(), optimizer.step()
    print(f"step {step}: loss {loss.item():.4f}, {len(rays) / len(rays_o):.1f} samples per ray")
