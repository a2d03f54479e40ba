"""The radiance field of the HMoE: encoding, projection A, experts, density and colour heads."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

from leco_plugin.models.color_head import ColorHead
from leco_plugin.models.compute.dispatch import steadied
from leco_plugin.models.encodings import EncodingConfig, build_encoding
from leco_plugin.models.hmoe import HMoE, HMoEConfig


@dataclass(frozen=True)
class FieldConfig:
    """The shape of the field."""

    encoding: EncodingConfig = field(
        default_factory=lambda: EncodingConfig(kind="hash", log2_table=19)
    )
    """Encoding of the mapped position."""
    experts: HMoEConfig = field(default_factory=HMoEConfig)
    """The mixture of experts between encoding and heads."""
    appearance_dim: int = 16
    """Width of the appearance code of each training image; 0 is without."""
    color_width: int = 64
    """Units of the hidden layer of the colour head."""
    direction_octaves: int = 2
    """Octaves of the encoding of the viewing direction."""


class _TruncatedExponential(torch.autograd.Function):
    """exp forward; the gradient is clamped at exp(15) so that one bad step cannot overflow."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return x.exp()

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:  # type: ignore[override]
        (x,) = ctx.saved_tensors
        return gradient * x.clamp(max=15.0).exp()


class HMoEField(nn.Module):
    """Density and colour of mapped positions, each computed by the expert that the gate chose."""

    def __init__(self, config: FieldConfig, num_images: int) -> None:
        super().__init__()
        self.config = config
        width = config.experts.width
        self.encoding = build_encoding(config.encoding)
        self.projection = nn.Linear(self.encoding.out_dim, width)
        self.experts = HMoE(config.experts)
        self.density_head = nn.Linear(width, 1)
        self.color = ColorHead(
            width,
            config.color_width,
            config.direction_octaves,
            config.appearance_dim,
            num_images,
        )

    def density(self, mapped: Tensor, routes: Tensor, gate_values: Tensor) -> tuple[Tensor, Tensor]:
        """Density and the features that colour is made of.

        Args:
            mapped: [N, 3] in [-1, 1].
            routes: [N] int64, expert of each point.
            gate_values: [N] float, the gate's probability of that expert.
        Returns:
            sigmas [N] float32, per half extent of the scene; features [N, width].
        """
        count = len(mapped)
        projected = self.projection(self.encoding(steadied(mapped)))
        hidden = self.experts(projected, steadied(routes), steadied(gate_values))
        raw = self.density_head(hidden)[:count, 0].float()
        sigmas = _TruncatedExponential.apply(raw - 1.0)
        if self.config.experts.empty_expert == "none":
            sigmas = sigmas * (routes > 0)
        return sigmas, hidden[:count]
