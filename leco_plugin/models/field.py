"""The radiance field of the HMoE: encoding, projection A, experts, density and colour heads."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

from leco_plugin.models.compute import native
from leco_plugin.models.compute.dispatch import pad_to_steady_size
from leco_plugin.models.compute.learned import FieldDensities
from leco_plugin.models.encodings import EncodingConfig, FrequencyEncoding, build_encoding
from leco_plugin.models.hmoe import HMoE, HMoEConfig

OPPONENT = torch.tensor(
    [[1 / 3**0.5] * 3, [1 / 2**0.5, 0.0, -1 / 2**0.5], [1 / 6**0.5, -2 / 6**0.5, 1 / 6**0.5]]
)
"""Rows: brightness and two hues, orthonormal, in red, green and blue. The colour head answers in
these, so that the errors in brightness, which are the larger ones, leave the weights of the hues
alone; in red, green and blue they pull all three rows of its last layer to one grey."""


APPEARANCE_SCALE = 0.1
"""Adam moves a code as fast as a weight, however little there is to learn from one image; scaled
down, codes follow slowly, and the mean code of a rendering is one that the field has met."""


NEARBY = 1.5
"""Of the median distance from a place to the next: how far the light of a photograph reaches."""
MOST_AT_A_PLACE = 8
"""Photographs of one panorama, or of one rig of cameras."""
NEXT_PLACE = 5.0
"""The next place is so many times as far as the photographs of the same one."""
WHOLE_FROM = 2.0
"""Neighbours count whole where the share of them that fits best, by least squares, is a half or
more: there the whole predicts better than the mean. Shares themselves cost a survey 0.3 dB."""
ASKED = 256
"""Photographs, evenly spread over all, by which both are judged: each chunk of a picture asks."""


def distance_to_next_place(between: Tensor) -> Tensor:
    """Median distance from photographs to the next place at which there are others: scalar.

    Photographs of a panorama or of a rig of cameras share a place. There the distances to the
    nearest, second nearest and so on jump from those within a place to those between places.

    Args:
        between: [A, N] distances from some photographs to all; infinite to themselves.
    """
    most = min(MOST_AT_A_PLACE, max(1, between.shape[1] // MOST_AT_A_PLACE))
    nearest = between.topk(most, dim=1, largest=False).values.nanmedian(dim=0).values
    jumps = (nearest[1:] > NEXT_PLACE * nearest[:-1]).nonzero()[:, 0]
    return nearest[jumps[-1] + 1] if len(jumps) else nearest[0]


def viewpoints(origins: Tensor) -> Tensor:
    """Where rays [R, 3] begin: [1, 3] where all begin at one place, as those of a picture, else as
    they are. To sort them takes a twentieth of a picture's time."""
    return origins[:1] if bool((origins == origins[:1]).all()) else origins


def codes_nearby(codes: Tensor, places: Tensor, origins: Tensor) -> Tensor:
    """Codes of views from those of the photographs nearby: exposure drifts along a flight.

    Weights fall with the square of the distance, as a bell; far from all photographs the nearest
    one counts. Where neighbours do not tell each other's codes, as where each photograph has an
    exposure of its own, they do not tell that of a view: it has the mean of all.

    Args:
        codes: [N, D] of photographs.
        places: [N, 3] where they were taken.
        origins: [R, 3] of rays.
    Returns:
        [R, D].
    """
    mean = codes.mean(dim=0)
    if len(places) < 2:
        return mean.expand(len(origins), -1)
    some = torch.arange(0, len(places), -(-len(places) // ASKED), device=places.device)
    exact = "donot_use_mm_for_euclid_dist"
    between = torch.cdist(places[some], places, compute_mode=exact)
    between[torch.arange(len(some)), some] = torch.inf
    reach = NEARBY * distance_to_next_place(between).clamp(min=1e-6)

    def beside_the_mean(distances: Tensor) -> Tensor:
        return torch.softmax(-(distances / reach).square(), dim=1) @ codes - mean

    told, own = beside_the_mean(between), codes[some] - mean
    share = (told * own).sum() / told.square().sum().clamp(min=1e-20)
    share = (WHOLE_FROM * share).clamp(0.0, 1.0)
    away = torch.cdist(viewpoints(origins), places, compute_mode=exact)
    found = mean + share * beside_the_mean(away)
    return found.expand(len(origins), -1)


class ColorHead(nn.Module):
    """One hidden layer over features, encoded direction and the appearance code of an image.

    Args:
        width, hidden: of the features, and of the hidden layer.
        appearance_dim: width of the code of each training image; 0 is without.
    """

    opponent: Tensor
    places: Tensor
    """[num_images, 3] where the photographs were taken; empty where that is unknown."""

    def __init__(
        self, width: int, hidden: int, direction_octaves: int, appearance_dim: int, num_images: int
    ) -> None:
        super().__init__()
        self.direction_encoding = FrequencyEncoding(direction_octaves)
        self.appearance = nn.Embedding(num_images, appearance_dim) if appearance_dim else None
        if self.appearance is not None:
            # alike at first: what differs between images is learned, not drawn
            nn.init.zeros_(self.appearance.weight)
        self.of_features = nn.Linear(width, hidden)
        self.of_ray = nn.Linear(
            self.direction_encoding.out_dim + appearance_dim, hidden, bias=False
        )
        self.out = nn.Linear(hidden, 3)
        self.register_buffer("opponent", OPPONENT.clone(), persistent=False)
        self.register_buffer("places", torch.empty(0, 3), persistent=False)

    def forward(
        self,
        features: Tensor,
        ray_indices: Tensor,
        directions: Tensor,
        image_indices: Tensor | None,
        origins: Tensor | None = None,
    ) -> Tensor:
        """Colour of samples, seen along their rays.

        Args:
            features: [M, width].
            ray_indices: [M] int64, the ray of each sample.
            directions: [R, 3] unit vectors.
            image_indices: [R] int64 of the training image, or None for that of the photographs
                nearby.
            origins: [R, 3] of the rays; without, None above is the mean of all photographs.
        Returns:
            [M, 3] float32 in [0, 1].
        """
        count = len(features)
        of_ray = self.hidden_of_rays(directions, image_indices, origins).to(features.dtype)
        hidden = self.of_features(pad_to_steady_size(features)) + of_ray.index_select(
            0, pad_to_steady_size(ray_indices)
        )
        opponent = self.out(torch.relu(hidden))[:count].float()
        return torch.sigmoid(opponent @ self.opponent)

    def hidden_of_rays(
        self, directions: Tensor, image_indices: Tensor | None, origins: Tensor | None
    ) -> Tensor:
        """What direction and code of rays add to the hidden layer: [R, hidden].

        The first layer of a concatenation is the sum of two, one of which is the same all along.
        """
        of_rays = [self.direction_encoding(directions)]
        if self.appearance is not None:
            codes = self.appearance.weight
            if image_indices is not None:
                code = self.appearance(image_indices)
            elif origins is not None and len(self.places) == len(codes):
                code = codes_nearby(codes, self.places, origins)
            else:
                code = codes.mean(dim=0).expand(len(directions), -1)
            of_rays.append(APPEARANCE_SCALE * code)
        return self.of_ray(torch.cat(of_rays, dim=-1))

    def suits_native(self, features: Tensor, weights: Tensor) -> bool:
        """Whether `networks.c` gives the colours of rays, and `gradients.c` what they teach."""
        widest = max(features.shape[-1], self.out.in_features)
        known = widest <= native.WIDEST
        return known and native.suits_networks([features, weights], self.layer_parts())

    def layer_parts(self) -> list[Tensor]:
        """Weights and biases of both layers."""
        return [*self.of_features.parameters(), *self.out.parameters()]

    def native_parts(self) -> list[Tensor]:
        """The same, the last layer's for red, green and blue."""
        *hidden, weight, bias = self.layer_parts()
        return [*hidden, self.opponent.T @ weight, self.opponent.T @ bias]


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
        of_ray = config.direction_octaves, config.appearance_dim
        self.color = ColorHead(width, config.color_width, *of_ray, num_images)

    def density(self, mapped: Tensor, routes: Tensor, gate_values: Tensor) -> tuple[Tensor, Tensor]:
        """Density and the features that colour is made of.

        Args:
            mapped: [N, 3] in [-1, 1].
            routes: [N] int64, expert of each point.
            gate_values: [N] float, factor of the features; see `rendering.gate_values_and_routes`.
        Returns:
            sigmas [N] float32, per half extent of the scene; features [N, width].
        """
        parts = self.native_parts() if self.suits_native() else []
        if parts and native.suits_networks([mapped, gate_values], parts):
            features, layers = self.encoding(mapped), self.config.experts.layers
            given = features, routes, gate_values, layers, *parts
            hidden, raw = FieldDensities.apply(*given)
            return self._sigmas(raw, routes), hidden
        count = len(mapped)
        projected = self.projection(self.encoding(pad_to_steady_size(mapped)))
        hidden = self.experts(
            projected, pad_to_steady_size(routes), pad_to_steady_size(gate_values)
        )
        raw = self.density_head(hidden)[:count, 0].float()
        return self._sigmas(raw, routes), hidden[:count]

    def _sigmas(self, raw: Tensor, routes: Tensor) -> Tensor:
        sigmas: Tensor = _TruncatedExponential.apply(raw - 1.0)
        return sigmas * (routes > 0) if self.config.experts.empty_expert == "none" else sigmas

    def suits_native(self) -> bool:
        """Whether `networks.c` knows the experts: residual, without a skip, beside the identity."""
        experts = self.config.experts
        plain = experts.residual and experts.skip is None and experts.empty_expert == "identity"
        plain = plain and experts.layers > 1
        widest = max(experts.width, self.encoding.out_dim, self.config.color_width)
        return plain and widest <= native.WIDEST

    def native_parts(self) -> list[Tensor | None]:
        """Weights and biases as `networks.c` takes them; None for those of a dropped expert."""
        layers = self.config.experts.layers
        parts: list[Tensor | None] = [
            *self.projection.parameters(),
            *self.density_head.parameters(),
        ]
        for expert in self.experts.experts:
            own = [] if expert is None else list(expert.parameters())
            parts += own or [None] * (2 * layers)
        return parts
