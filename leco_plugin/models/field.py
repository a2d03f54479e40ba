"""The radiance field of the HMoE: encoding, projection A, experts, density and colour heads."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

from leco_plugin.models.encodings import EncodingConfig, FrequencyEncoding, build_encoding
from leco_plugin.models.hmoe import HMoE, HMoEConfig


@dataclass(frozen=True)
class FieldConfig:
    """The shape of the field."""

    encoding: EncodingConfig = field(default_factory=lambda: EncodingConfig(kind="hash"))
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
        self.direction_encoding = FrequencyEncoding(config.direction_octaves)
        self.appearance = (
            nn.Embedding(num_images, config.appearance_dim) if config.appearance_dim else None
        )
        if self.appearance is not None:
            # alike at first: what differs between images is learned, not drawn
            nn.init.zeros_(self.appearance.weight)
        self.color_head = nn.Sequential(
            nn.Linear(
                width + self.direction_encoding.out_dim + config.appearance_dim, config.color_width
            ),
            nn.ReLU(),
            nn.Linear(config.color_width, 3),
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
        hidden = self.experts(self.projection(self.encoding(mapped)), routes, gate_values)
        raw = self.density_head(hidden)[:, 0].float()
        sigmas = _TruncatedExponential.apply(raw - 1.0)
        if self.config.experts.empty_expert == "none":
            sigmas = sigmas * (routes > 0)
        return sigmas, hidden

    def color(self, features: Tensor, directions: Tensor, image_indices: Tensor | None) -> Tensor:
        """Colour seen from a direction.

        Args:
            features: [M, width] of `density`.
            directions: [M, 3] unit vectors.
            image_indices: [M] int64 of the training image, or None for the mean appearance.
        Returns:
            [M, 3] float32 in [0, 1].
        """
        parts = [features, self.direction_encoding(directions).to(features.dtype)]
        if self.appearance is not None:
            code = (
                self.appearance(image_indices)
                if image_indices is not None
                else self.appearance.weight.mean(dim=0).expand(len(features), -1)
            )
            parts.append(code.to(features.dtype))
        return torch.sigmoid(self.color_head(torch.cat(parts, dim=-1)).float())
