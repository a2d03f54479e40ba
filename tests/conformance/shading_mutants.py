"""Packed hosts that shade other samples than those that are kept, and samplers of hosts that give
them too few."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any
from unittest.mock import patch

import torch
from conformance.estimator_mutants import Answers
from conformance.proposal_mutants import SoundProposal
from nerfstudio.cameras.rays import RayBundle, RaySamples
from nerfstudio.models.instant_ngp import NGPModel
from torch import Tensor

from leco_plugin.samplers.marching import Samples


class Shades(NGPModel):
    """Shades some of the samples that are kept, in evaluation."""

    def get_outputs(self, ray_bundle: RayBundle) -> dict[str, Any]:
        if self.training:
            return super().get_outputs(ray_bundle)
        with patch.object(self.sampler, "forward", self.some(self.sampler.forward)):
            return super().get_outputs(ray_bundle)

    def some(self, sample: Callable[..., Any]) -> Callable[..., Any]:
        def sample_some(**options: Any) -> Any:
            samples, ray_indices = sample(**options)
            kept = self.chosen(samples)
            if not bool(kept.any()):  # as for rays that meet nothing
                return samples, ray_indices
            return samples[kept], ray_indices[kept]

        return sample_some

    def chosen(self, samples: RaySamples) -> Tensor:
        """Which samples [N] are shaded: bool [N]."""
        raise NotImplementedError


class ShadesEverySecond(Shades):
    def chosen(self, samples: RaySamples) -> Tensor:
        return torch.arange(len(samples)) % 2 == 0


class ShadesItsBoxOnly(Shades):
    """Leaves out what lies beyond its box, as in a scene that ends there."""

    def chosen(self, samples: RaySamples) -> Tensor:
        low, high = self.scene_box.aabb.view(2, 3)
        positions = samples.frustums.get_positions()
        return ((positions >= low) & (positions <= high)).all(dim=-1)


class ShadesElsewhere(Shades):
    """Asks its field half a step behind each sample."""

    def chosen(self, samples: RaySamples) -> Tensor:
        samples.frustums.starts = samples.frustums.starts + 0.025
        samples.frustums.ends = samples.frustums.ends + 0.025
        return torch.ones(len(samples), dtype=torch.bool)


class AsksThereToo(ShadesElsewhere):
    """Asks there and at each sample, and shades what it should."""

    def chosen(self, samples: RaySamples) -> Tensor:
        every = torch.ones(len(samples), dtype=torch.bool)
        behind = samples[every]
        super().chosen(behind)
        self.field(behind)
        return every


class FillsUp(NGPModel):
    """Shades a whole ray in each batch, lest the field forget what free space is."""

    def get_outputs(self, ray_bundle: RayBundle) -> dict[str, Any]:
        edges = torch.linspace(0.1, 6.0, 20)[None, :, None]
        whole: RaySamples = ray_bundle[:1].get_ray_samples(edges[:, :-1], edges[:, 1:])
        self.field(whole)
        return super().get_outputs(ray_bundle)


class SamplesElsewhere(NGPModel):
    """Has the sampler look at a scene that was moved."""

    def get_outputs(self, ray_bundle: RayBundle) -> dict[str, Any]:
        ray_bundle.origins = ray_bundle.origins - torch.tensor([0.5, -1.0, 2.0])
        return super().get_outputs(ray_bundle)


class AsksAsItIs(NGPModel):
    """Comes with an adapter that asks the gate in the host's coordinates, whatever its own are."""


class ThinsOneRay(Answers):
    """Leaves out one sample in eight of the first ray."""

    def change(self, ray_indices: Tensor, t_starts: Tensor, t_ends: Tensor) -> Samples:
        kept = (ray_indices > 0) | (torch.arange(len(ray_indices)) % 8 > 0)
        return ray_indices[kept], t_starts[kept], t_ends[kept]


class DropsOneRay(Answers):
    """Has nothing on the first ray."""

    def change(self, ray_indices: Tensor, t_starts: Tensor, t_ends: Tensor) -> Samples:
        kept = ray_indices > 0
        return ray_indices[kept], t_starts[kept], t_ends[kept]


class NearHalf(SoundProposal):
    """Draws from the nearer half of the places that are worth something."""

    def worth(self, positions: Tensor) -> Tensor:
        worth = super().worth(positions)
        return worth * (worth.cumsum(dim=-2) <= 0.5 * worth.sum(dim=-2, keepdim=True))
