"""Settings and sizes of `switch-nerf`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from nerfstudio.models.base_model import ModelConfig

from leco_plugin.models.switch.field import SwitchFieldConfig
from leco_plugin.scenes.bounds import BoundsConfig


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
