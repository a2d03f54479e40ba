"""A host that asks no sampler of nerfacc or nerfstudio, and the adapter that swaps its own."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from nerfstudio.cameras.rays import RayBundle, RaySamples
from nerfstudio.field_components.field_heads import FieldHeadNames
from nerfstudio.model_components.ray_samplers import UniformSampler
from nerfstudio.models.base_model import Model, ModelConfig
from torch import nn

from leco_plugin.hosts.guide import Guide
from leco_plugin.hosts.seams import HostAdapter
from nerf_elsewhere.matter import Matter
from nerf_elsewhere.photographic import PhotographicModel


@dataclass
class PlacesModelConfig(ModelConfig):
    """A host of another package that lays out its places itself"""

    _target: type = field(default_factory=lambda: PlacesModel)
    """what is built"""
    collider_params: dict[str, float] | None = field(
        default_factory=lambda: {"near_plane": 0.05, "far_plane": 4.0}
    )
    """Where rays begin and end."""
    places: int = 24
    """Samples on each ray."""


class EqualPlaces(nn.Module):
    """Samples at equal distances."""

    def __init__(self, count: int) -> None:
        super().__init__()
        self.count = count

    def forward(self, rays: RayBundle) -> RaySamples:
        assert rays.nears is not None and rays.fars is not None
        shares = torch.linspace(0.0, 1.0, self.count + 1, device=rays.origins.device)
        edges = (rays.nears + (rays.fars - rays.nears) * shares)[..., None]
        return rays.get_ray_samples(bin_starts=edges[..., :-1, :], bin_ends=edges[..., 1:, :])


class PlacesModel(PhotographicModel):
    """Renders its places."""

    config: PlacesModelConfig

    def populate_modules(self) -> None:
        super().populate_modules()
        self.matter = Matter()
        self.places: nn.Module = EqualPlaces(self.config.places)

    def get_param_groups(self) -> dict[str, list[nn.Parameter]]:
        return {"matter": list(self.matter.parameters())}

    def get_outputs(self, ray_bundle: RayBundle) -> dict[str, Any]:
        samples = self.places(ray_bundle)
        found = self.matter(samples)
        weights = samples.get_weights(found[FieldHeadNames.DENSITY])
        middles = 0.5 * (samples.frustums.starts + samples.frustums.ends)
        return {
            "rgb": (weights * found[FieldHeadNames.RGB]).sum(dim=-2),
            "accumulation": weights.sum(dim=-2),
            "depth": (weights * middles).sum(dim=-2),
        }


class GuidedPlaces(nn.Module):
    """Samples where a proposal sampler puts them."""

    def __init__(self, sampler: nn.Module) -> None:
        super().__init__()
        self.sampler = sampler

    def forward(self, rays: RayBundle) -> RaySamples:
        return self.sampler(rays)[0]


def _swap(host: Any, guide: Guide) -> None:
    sampler = guide.proposal(num_samples=host.config.places, initial_sampler=UniformSampler())
    host.places = GuidedPlaces(sampler)


def _fits(host: Model) -> bool:
    return isinstance(host, PlacesModel)


ADAPTER = HostAdapter("the places of nerf-elsewhere", _fits, _swap)
