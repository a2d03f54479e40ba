"""The field of Switch-NeRF: one projection, a gate, equal experts, shared heads (section 3).

The paper's network between expert and colour has one more linear layer without activation before
another linear layer; the two are one here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn

from leco_plugin.models.compute.dispatch import dispatch, pad_to_steady_size, within_capacity
from leco_plugin.models.encodings import FrequencyEncoding
from leco_plugin.models.field import ColorHead
from leco_plugin.models.gate import logits_of
from leco_plugin.models.hmoe import Expert

SHIFT = -1.0
"""Added to the density head's answer before its softplus."""
NEW_DENSITY = math.log1p(math.exp(SHIFT))
"""Density of a field that has learned nothing, per half extent and unit of its scale."""


@dataclass(frozen=True)
class SwitchFieldConfig:
    """The shape of the field; the defaults are those of the paper."""

    octaves: int = 12
    """Octaves of the encoding of the mapped position."""
    experts: int = 8
    """Number of experts."""
    width: int = 256
    """Units of each layer of an expert and of the gate."""
    layers: int = 7
    """Layers of an expert."""
    skip: int | None = 3
    """Layer of an expert that sees its input again, or None."""
    gate_layers: int = 2
    """Hidden layers of the gate."""
    color_width: int = 128
    """Units of the hidden layer of the colour head."""
    direction_octaves: int = 4
    """Octaves of the encoding of the viewing direction."""
    appearance_dim: int = 48
    """Width of the appearance code of each training image; 0 is without."""


class Answers(NamedTuple):
    """What the field says of N points."""

    sigmas: Tensor
    """[N] float32, per half extent of the scene."""
    features: Tensor
    """[N, width], what colour is made of."""
    logits: Tensor
    """[N, experts] float32 of the gate."""
    routes: Tensor
    """[N] int64 in [0, experts), where the gate sends each point, also one for which its expert
    has no place."""


class SwitchGate(nn.Module):
    """The external gating network: MLP, LayerNorm, linear (section 3.1)."""

    def __init__(self, width: int, layers: int, experts: int) -> None:
        super().__init__()
        self.hidden = nn.ModuleList(nn.Linear(width, width) for _ in range(layers))
        self.norm = nn.LayerNorm(width)
        self.head = nn.Linear(width, experts)

    def forward(self, projected: Tensor) -> Tensor:
        """[N, width] to logits [N, experts] float32."""
        features = projected
        for i, layer in enumerate(self.hidden):
            features = layer(torch.relu(features) if i > 0 else features)
        return logits_of(features, self.norm, self.head)


class SwitchField(nn.Module):
    """Density and colour of mapped positions, each from the expert that the gate chose.

    Attributes:
        density_scale: factor of the density, 1 in the paper; see `hosts/first_steps.py`.
    """

    def __init__(self, config: SwitchFieldConfig, num_images: int) -> None:
        super().__init__()
        self.config = config
        self.density_scale = 1.0
        self.encoding = FrequencyEncoding(config.octaves)
        self.projection = nn.Linear(self.encoding.out_dim, config.width)
        self.gate = SwitchGate(config.width, config.gate_layers, config.experts)
        self.experts = nn.ModuleList(
            Expert(config.width, config.layers, config.skip) for _ in range(config.experts)
        )
        self.density_head = nn.Linear(config.width, 1)
        self.color = ColorHead(
            config.width,
            config.color_width,
            config.direction_octaves,
            config.appearance_dim,
            num_images,
        )

    def forward(
        self, mapped: Tensor, noise: float = 0.0, capacity_factor: float | None = None
    ) -> Answers:
        """Asks the field about points.

        Args:
            mapped: [N, 3] in [-1, 1].
            noise: standard deviation of what is added to the density before its activation.
            capacity_factor: places of each expert, as a multiple of an equal share of the points;
                a point without a place has zero features. None is dropless.
        """
        count = len(mapped)
        projected = self.projection(self.encoding(pad_to_steady_size(mapped)))
        logits = self.gate(projected)[:count]
        gate_values, routes = logits.softmax(dim=-1).max(dim=-1)
        features = self._mixture(projected[:count], routes, gate_values, capacity_factor)
        raw = self.density_head(pad_to_steady_size(features))[:count, 0].float()
        if noise > 0.0:
            raw = raw + noise * torch.randn_like(raw)
        sigmas = self.density_scale * nn.functional.softplus(raw + SHIFT)
        return Answers(sigmas, features, logits, routes)

    def _mixture(
        self, projected: Tensor, routes: Tensor, gate_values: Tensor, capacity_factor: float | None
    ) -> Tensor:
        """G_i*(x) E_i*(x), [N, width]."""
        count = self.config.experts
        if capacity_factor is not None:
            within = within_capacity(routes, gate_values.detach(), count, capacity_factor)
            routes = routes.masked_fill(~within, count)
        hidden = dispatch(projected, routes, [*self.experts, None])
        return hidden * gate_values[:, None].to(hidden.dtype)
