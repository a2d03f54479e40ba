"""The interface between a learner and the training loop around it."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Protocol

from torch import nn
from torch.optim import Optimizer

PACE = "leco_pace"
"""Attribute of an optimizer: the multiple of its learning rates that it steps with."""


class Run(Protocol):
    """A training run. `LearningOnly` is one without a trainer."""

    goes_on: bool
    """Whether the field goes on after freezing; else it is left behind."""
    start: int
    """Its first step: not 0 where it was resumed."""
    end: float
    """The step after its last one; infinity where freezing ends it."""
    folder: Path | None
    """Where it leaves its files; None leaves none."""
    resumed_from: Path | None
    """A checkpoint, or a folder of checkpoints, that it was resumed from."""

    def optimizers(self) -> list[Optimizer]:
        """All optimizers of the mixture's parameters."""

    def left(self, step: int) -> float:
        """Steps after this one that its gate will guide."""

    def save(self, step: int) -> None:
        """Saves a checkpoint, if it saves any."""

    def forget(self, groups: dict[str, list[nn.Parameter]]) -> None:
        """Has optimizers forget all parameters but these, by the names of their groups."""


class LearningOnly:
    """A run that ends when the gate is frozen, and leaves no file.

    Args:
        guides: steps of a host that the gate then guides.
    """

    goes_on, start, end = False, 0, math.inf
    folder: Path | None = None
    resumed_from: Path | None = None

    def __init__(self, optimizers: list[Optimizer] | None = None, guides: float = 0.0) -> None:
        self._optimizers, self._guides = optimizers or [], guides

    def optimizers(self) -> list[Optimizer]:
        """Those that it was given."""
        return self._optimizers

    def left(self, step: int) -> float:
        """Those of the host."""
        return self._guides

    def save(self, step: int) -> None:
        """Nothing: it is over in minutes."""

    def forget(self, groups: dict[str, list[nn.Parameter]]) -> None:
        """Nothing: no parameter leaves before the run is over."""


def keep_pace(optimizers: Iterable[Optimizer], pace: float) -> None:
    """Has optimizers step at a multiple of their learning rates from now on.

    The rates are multiplied for the time of a step only: schedulers and checkpoints see what was
    asked for.

    Args:
        pace: the multiple; a power of two leaves rates as they were to the last bit.
    """
    for optimizer in optimizers:
        if not hasattr(optimizer, PACE):
            if pace == 1.0:
                continue
            optimizer.register_step_pre_hook(_slow_down)
            optimizer.register_step_post_hook(_restore)
        setattr(optimizer, PACE, pace)


def _slow_down(optimizer: Optimizer, *_: Any) -> None:
    for group in optimizer.param_groups:
        group["lr"] *= getattr(optimizer, PACE)


def _restore(optimizer: Optimizer, *_: Any) -> None:
    for group in optimizer.param_groups:
        group["lr"] /= getattr(optimizer, PACE)
