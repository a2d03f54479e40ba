"""What fills space: density, and colour, from sines of a position."""

from __future__ import annotations

import math

import torch
from nerfstudio.cameras.rays import RaySamples
from nerfstudio.field_components.field_heads import FieldHeadNames
from nerfstudio.fields.base_field import Field
from torch import Tensor, nn


class Scout(Field):
    """Density alone, for a first look along a ray."""

    outputs = 1

    def __init__(self, width: int = 16, octaves: int = 4) -> None:
        super().__init__()
        self.register_buffer("scales", math.pi * 2.0 ** torch.arange(octaves), persistent=False)
        self.layers = nn.Sequential(
            nn.Linear(6 * octaves, width), nn.ReLU(), nn.Linear(width, self.outputs)
        )

    def get_density(self, ray_samples: RaySamples) -> tuple[Tensor, Tensor]:
        """[..., 1] of samples, and what colour is made of."""
        angles = (ray_samples.frustums.get_positions()[..., None] * self.scales).flatten(-2)
        found = self.layers(torch.cat([angles.sin(), angles.cos()], dim=-1))
        return nn.functional.softplus(found[..., :1]), found[..., 1:]

    def get_outputs(
        self, ray_samples: RaySamples, density_embedding: Tensor | None = None
    ) -> dict[FieldHeadNames, Tensor]:
        """Nothing: a scout sees no colour."""
        return {}


class Matter(Scout):
    """Density and colour."""

    outputs = 4

    def get_outputs(
        self, ray_samples: RaySamples, density_embedding: Tensor | None = None
    ) -> dict[FieldHeadNames, Tensor]:
        """Colours [..., 3] in (0, 1)."""
        assert density_embedding is not None
        return {FieldHeadNames.RGB: density_embedding.sigmoid()}
