"""The field of Switch-NeRF: one projection, a gate, equal experts, shared heads (section 3).

With fixed shares in place of the gate it is that of Mega-NeRF, but for what experts share.

The paper's network between expert and colour has one more linear layer without activation before
another linear layer; the two are one here. The settings of `switch-nerf` stand below.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import torch
from nerfstudio.models.base_model import ModelConfig
from torch import Tensor, nn

from leco_plugin.models.compute.dispatch import dispatch, pad_to_steady_size, within_capacity
from leco_plugin.models.encodings import FrequencyEncoding
from leco_plugin.models.field import ColorHead
from leco_plugin.models.gate import logits_of
from leco_plugin.models.hmoe import Expert
from leco_plugin.models.rendering import Answers
from leco_plugin.models.sizing.sizes import size_at
from leco_plugin.scenes.bounds import BoundsConfig
from leco_plugin.scenes.input_error import require

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
    routing: Literal["learned", "nearest"] = "learned"
    """Who has a point: the expert that a gate chooses, or the nearest on the ground, as in
    Mega-NeRF."""
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


class NearestOnTheGround(nn.Module):
    """Fixed shares in place of a gate, as in Mega-NeRF: centroids stand in rows and columns on the
    ground, and a point belongs to the nearest one."""

    centroids: Tensor
    """[experts, 2] x and y of mapped positions."""

    def __init__(self, experts: int) -> None:
        super().__init__()
        self.register_buffer("centroids", torch.empty(experts, 2))
        self.spread(torch.tensor([-1.0, -1.0]), torch.tensor([1.0, 1.0]))

    def spread(self, low: Tensor, high: Tensor) -> None:
        """Places the centroids in the middles of equal parts, as square as can be, of the ground
        between two corners, x and y of mapped positions."""
        experts, (width, depth) = len(self.centroids), (high - low).tolist()
        divisors = [count for count in range(1, experts + 1) if experts % count == 0]
        columns = min(divisors, key=lambda c: abs(math.log((width / c) / (depth / (experts // c)))))
        counts = columns, experts // columns
        x, y = ((torch.arange(count) + 0.5) / count for count in counts)
        shares = torch.cartesian_prod(x, y).to(low)
        self.centroids.copy_(low + shares * (high - low))

    def forward(self, mapped: Tensor) -> Tensor:
        """[N, 3] in [-1, 1] to [N, experts] float32, the negative squares of the distances."""
        return -torch.cdist(mapped[:, :2].float(), self.centroids).square()


class SwitchField(nn.Module):
    """Density and colour of mapped positions, each from the expert that has them.

    Attributes:
        density_scale: factor of the density, 1 in the paper; see `hosts/host_watch.py`.
    """

    def __init__(self, config: SwitchFieldConfig, num_images: int) -> None:
        super().__init__()
        self.config = config
        self.density_scale = 1.0
        self.encoding = FrequencyEncoding(config.octaves)
        self.projection = nn.Linear(self.encoding.out_dim, config.width)
        self.gate: SwitchGate | NearestOnTheGround = (
            SwitchGate(config.width, config.gate_layers, config.experts)
            if config.routing == "learned"
            else NearestOnTheGround(config.experts)
        )
        self.experts = nn.ModuleList(
            Expert(config.width, config.layers, config.skip) for _ in range(config.experts)
        )
        self.density_head = nn.Linear(config.width, 1)
        of_ray = config.direction_octaves, config.appearance_dim
        self.color = ColorHead(config.width, config.color_width, *of_ray, num_images)

    def forward(
        self, mapped: Tensor, noise: float = 0.0, capacity_factor: float | None = None
    ) -> Answers:
        """Asks the field about points.

        Args:
            mapped: [N, 3] in [-1, 1].
            noise: standard deviation of what is added to the density before its activation.
            capacity_factor: places of each expert, as a multiple of an equal share of the points;
                a point without a place has zero features, and keeps its route. None is dropless.
        """
        count = len(mapped)
        projected = self.projection(self.encoding(pad_to_steady_size(mapped)))
        logits, gate_values, routes = self._route(mapped, projected)
        features = self._mixture(projected[:count], routes, gate_values, capacity_factor)
        raw = self.density_head(pad_to_steady_size(features))[:count, 0].float()
        if noise > 0.0:
            raw = raw + noise * torch.randn_like(raw)
        sigmas = self.density_scale * nn.functional.softplus(raw + SHIFT)
        return Answers(sigmas, features, logits, routes)

    def _route(self, mapped: Tensor, projected: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Logits [N, experts], and the factor and expert [N] of each point."""
        if isinstance(self.gate, NearestOnTheGround):
            logits = self.gate(mapped)
            return logits, torch.ones_like(logits[:, 0]), logits.argmax(dim=-1)
        logits = self.gate(projected)[: len(mapped)]
        return logits, *logits.softmax(dim=-1).max(dim=-1)

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


@dataclass(frozen=True)
class SwitchSizes:
    """Everything whose best value depends on how much the machine can compute."""

    field: SwitchFieldConfig = field(default_factory=SwitchFieldConfig)
    """Gate, experts and heads."""
    coarse: int = 256
    """Coarse samples of a ray, spread evenly."""
    fine: int = 512
    """Fine samples of a ray, drawn where the coarse ones have weight."""
    candidates: int = 768
    """Candidates of a median ray, of which an estimator keeps some."""
    grid_resolution: int = 128
    """Cells of the occupancy grid along each axis, at each level."""
    grid_warmup_steps: int = 256
    """Steps in which all cells are asked at each update, as nerfacc has it."""


PAPER = SwitchSizes()
"""The sizes of the paper: 8 experts of 7 layers of 256 units, 256 + 512 samples."""

SMALL = SwitchSizes(
    field=SwitchFieldConfig(
        octaves=8,
        experts=4,
        width=64,
        layers=4,
        skip=2,
        gate_layers=1,
        color_width=64,
        direction_octaves=2,
        appearance_dim=16,
    ),
    coarse=64,
    fine=64,
    candidates=128,
    grid_resolution=64,
    grid_warmup_steps=64,
)
"""Two CPU cores: a training step of 512 rays in a third of a second."""


def switch_sizes_for(device_type: str) -> SwitchSizes:
    """The default sizes of a device: `cpu`, `cuda` or `mps`."""
    return PAPER if device_type == "cuda" else SMALL


LEAST = {
    **dict.fromkeys(("field.experts", "field.width", "field.layers", "field.color_width"), 1),
    **dict.fromkeys(("coarse", "candidates", "grid_resolution"), 1),
    **dict.fromkeys(("field.octaves", "field.gate_layers", "field.direction_octaves"), 0),
    **dict.fromkeys(("field.appearance_dim", "fine", "grid_warmup_steps"), 0),
}
"""The least that each size can be."""


def _model() -> type:
    from leco_plugin.models.switch_nerf import SwitchNerfModel

    return SwitchNerfModel


@dataclass
class SwitchNerfModelConfig(ModelConfig):
    """Switch-NeRF: equal experts, a gate that learns to share the scene among them"""

    _target: type = field(default_factory=_model)
    """target class to instantiate"""
    enable_collider: bool = False
    """Rays are cut at the scene's own bounds instead."""
    eval_num_rays_per_chunk: int = 2048
    """Rays rendered at a time."""
    sizes: SwitchSizes = field(default_factory=lambda: SMALL)
    """Sizes of field and sampling."""
    sampling: Literal["coarse-fine", "occupancy-grid"] = "coarse-fine"
    """Samples of the method's own, coarse and fine; or packed ones where an occupancy grid, updated
    while training, has something."""
    capacity_factor: float | None = None
    """In training, places of each expert as a multiple of an equal share of the points (1.0 in the
    paper). Points beyond skip their expert: zero features, a hole for this step. None is dropless;
    renderings always are."""
    balance: float = 5e-4
    """Weight of the balanced gate loss."""
    sigma_noise: float = 1.0
    """Standard deviation of the noise on density, before its activation, while training."""
    early_stop_eps: float = 0.0
    """Packed samples, in training: transmittance below which a sample is not shaded. That asks for
    all densities first, which pays where surfaces are opaque; 0 does not."""
    grid_levels: int = 4
    """Nested levels of the occupancy grid around an unbounded scene; a bounded one has one."""
    near: float | None = None
    """Where rays begin, scene units; None is found from the data."""
    far: float | None = None
    """Where rays end, scene units; None is found from the data."""
    bounds: BoundsConfig = field(default_factory=BoundsConfig)
    """Where the scene lies, where the data do not say it right."""

    def __post_init__(self) -> None:
        for path, least in LEAST.items():
            size, option = size_at(self.sizes, path), f"sizes.{path.replace('_', '-')}"
            require(size >= least, option, size, f"at least {least}")
        skip, layers = self.sizes.field.skip, self.sizes.field.layers
        has_layer = skip is None or 0 <= skip < layers
        require(
            has_layer, "sizes.field.skip", skip, f"None or the number of a layer, 0 to {layers - 1}"
        )
        for name in ("balance", "sigma_noise"):
            weight = getattr(self, name)
            require(
                0.0 <= weight < math.inf, name.replace("_", "-"), weight, "a number, at least 0"
            )
        eps, places = self.early_stop_eps, self.capacity_factor
        require(0.0 <= eps < 1.0, "early-stop-eps", eps, "at least 0 and below 1")
        require(self.grid_levels >= 1, "grid-levels", self.grid_levels, "at least 1")
        has_places = places is None or 0.0 < places < math.inf
        require(has_places, "capacity-factor", places, "above 0, or None for dropless routing")
