"""Sizes of `switch-nerf`: those of the paper, and what two CPU cores can train."""

from __future__ import annotations

from dataclasses import dataclass, field

from leco_plugin.models.switch.field import SwitchFieldConfig


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
