"""Learning rates in a multiple that a run finds for itself, whoever else sets them."""

from __future__ import annotations

from collections.abc import Iterable

from torch.optim import Optimizer

SET, ASKED = "leco_set_rate", "leco_asked_rate"
"""Of a parameter group: the rate that was set here last, and the one that was there before."""


def keep_pace(optimizers: Iterable[Optimizer], pace: float) -> None:
    """Multiplies the learning rates; to be called before each step.

    A scheduler that sets a rate sets the one that is multiplied. What is remembered travels with
    the optimizers' own state.

    Args:
        pace: the multiple.
    """
    for optimizer in optimizers:
        for group in optimizer.param_groups:
            if SET not in group and pace == 1.0:
                continue  # as whoever made it wants it
            if group.get(SET) != group["lr"]:
                group[ASKED] = group["lr"]
            group["lr"] = group[SET] = group[ASKED] * pace
