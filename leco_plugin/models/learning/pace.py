"""Learning rates in a multiple that a run finds for itself, whoever else sets them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from torch.optim import Optimizer

PACE = "leco_pace"
"""Of an optimizer: the multiple that it steps with."""


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
            optimizer.register_step_pre_hook(_slowed)
            optimizer.register_step_post_hook(_as_asked)
        setattr(optimizer, PACE, pace)


def _slowed(optimizer: Optimizer, *_: Any) -> None:
    for group in optimizer.param_groups:
        group["lr"] *= getattr(optimizer, PACE)


def _as_asked(optimizer: Optimizer, *_: Any) -> None:
    for group in optimizer.param_groups:
        group["lr"] /= getattr(optimizer, PACE)
