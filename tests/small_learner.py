"""A small mixture, and data for a learner of it in which there is nothing to see."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from leco_plugin.learning.learner import Learner
from leco_plugin.learning.run import LearningOnly, Progress
from leco_plugin.learning.sharpening import SharpeningConfig
from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.field import FieldConfig
from leco_plugin.models.gate import GateConfig
from leco_plugin.models.leco_config import LecoModelConfig
from leco_plugin.models.mixture import Mixture
from leco_plugin.models.rendering import Routing
from leco_plugin.models.sizing.sizes import Sizes

SMALLEST = Sizes(
    gate=GateConfig(EncodingConfig(octaves=1), width=8, layers=1, scene_experts=2),
    field=FieldConfig(EncodingConfig("hash", levels=1, log2_table=4), appearance_dim=2),
    learn_candidates=32,
    candidates=64,
    guided_batch=4.0,
)


def small_mixture(sizes: Sizes = SMALLEST, images: int = 2) -> Mixture:
    """A new one, whose region is a contraction of half extent 4."""
    mixture = Mixture(sizes, images, "float32", Routing(0.2, False))
    mixture.region.space.set("contraction", torch.zeros(3), 4.0)
    mixture.region.near.fill_(0.5)
    mixture.region.far.fill_(2.0)
    mixture.region.aabb.copy_(torch.tensor([-100.0] * 3 + [100.0] * 3))
    mixture.region.known.fill_(True)
    return mixture


class NoPixels:
    """Data of nine rays along x, without pixels."""

    def __init__(self) -> None:
        origins = torch.stack([torch.zeros(9), torch.arange(9.0), torch.zeros(9)], dim=-1)
        directions = torch.tensor([[1.0, 0.0, 0.0]]).expand(9, 3)
        self.survey: Any = SimpleNamespace(origins=origins, directions=directions)

    def prepare_batch(self, factor: float, distances: bool, set_aside: int = 0) -> None:
        """Nothing is drawn."""

    def held_out(self, count: int, seed: int = 0, share: str = "") -> tuple[Any, Tensor]:
        """Pixels were asked for."""
        raise AssertionError("pixels were asked for")

    def of_vouching(self, *_: Any) -> list[Any]:
        """No photograph."""
        return []

    def of_tests(self, *_: Any) -> list[Any]:
        """Nor any test photograph."""
        return []

    def count_held_out(self, limit: int) -> float:
        """As if none were held out."""
        return math.inf

    def facts(self) -> dict[str, Any]:
        """None."""
        return {}


class ARun(LearningOnly):
    """A run of so many steps that notes at which it was saved."""

    goes_on = True

    def __init__(self, end: float = math.inf, start: int = 0, **rest: Any) -> None:
        super().__init__(**rest)
        self.start, self.end = start, end
        self.saved: list[int] = []

    def save(self, step: int) -> None:
        """Notes the step."""
        self.saved.append(step)


def small_learner(
    run: LearningOnly | None = None,
    mixture: Mixture | None = None,
    data: Any = None,
    progress: Progress | None = None,
    **options: Any,
) -> Learner:
    """A learner before its first step.

    Args:
        run: `LearningOnly` by default.
        options: of `LecoModelConfig`; nothing is sharpened by default.
    """
    config = LecoModelConfig(**{"sharpening": SharpeningConfig(steps=0), **options})
    steps = config.schedule.learn_steps
    return Learner(
        small_mixture() if mixture is None else mixture,
        NoPixels() if data is None else data,
        LearningOnly() if run is None else run,
        config,
        Progress(learn_steps=steps, configured=steps) if progress is None else progress,
    )
