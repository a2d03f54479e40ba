"""How much the GPU suite measures, and how it writes down what it found."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import torch

from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.sizing.sizes import PAPER, SMALL, Sizes
from leco_plugin.scenes.city.cameras import CaptureConfig
from leco_plugin.scenes.city.city import CityConfig

TINY = replace(
    SMALL,
    gate=replace(SMALL.gate, encoding=EncodingConfig(octaves=2), width=16, layers=1),
    field=replace(SMALL.field, encoding=replace(SMALL.field.encoding, log2_table=10)),
    learn_candidates=16,
    candidates=16,
)


@dataclass(frozen=True)
class Scale:
    """How much is measured."""

    device: torch.device
    positions: int = 1 << 22
    """Positions that a gate decides about in one call."""
    rays: int = 4096
    """Rays that are sampled at once."""
    batch: int = 1024
    """Rays of a training step."""
    grid: int = 128
    """Cells of the occupancy grids along each axis."""
    matrix: int = 8192
    """Side of the matrices of the card's ceilings."""
    rounds: int = 30
    """How often each thing is timed."""
    fit_steps: int = 300
    """Steps in which the gate of the sampling scene is fitted."""
    cache_bytes: int = 1 << 20
    """Budget of the cells."""
    tolerance: float = 1e-4
    """Share of decisions by which cells may differ from the gate, else there are none."""
    sizes: Sizes = PAPER
    """Of the gate and the field that are trained."""
    learning: float = 60.0
    """Seconds of learning the occupancy."""
    guided: float = 60.0
    """Seconds of guided training after it."""
    calibration: int = 4096
    """Held-out rays that the threshold is found on."""
    test: int = 1 << 15
    """Pixels of held-out pictures that PSNR is taken on."""
    city: CityConfig = field(default_factory=CityConfig)
    capture: CaptureConfig = field(default_factory=CaptureConfig)

    def dry(self) -> Scale:
        """The smallest of everything."""
        return replace(
            self,
            positions=512,
            rays=32,
            batch=64,
            grid=8,
            matrix=64,
            rounds=2,
            fit_steps=20,
            cache_bytes=1 << 18,
            tolerance=1.0,
            sizes=TINY,
            learning=1.0,
            guided=0.5,
            calibration=64,
            test=64,
            city=CityConfig(blocks=1),
            capture=CaptureConfig(16, 12, aerial_per_block=6, street_per_block=2),
        )


def figure(name: str, value: float, bar: float, at_most: bool, **parts: float) -> dict[str, Any]:
    """A ratio with the bar it must reach and the milliseconds behind it."""
    reached = value <= bar if at_most else value >= bar
    milliseconds = {part: round(time * 1e3, 5) for part, time in parts.items()}
    return {
        "name": name,
        "value": value,
        "bar": bar,
        "at_most": at_most,
        "reached": reached,
        "milliseconds": milliseconds,
    }
