"""The powers by which a step grows with distance, once for all rays.

Behind its linear part, edge k of a ray is `t_switch` times a power that depends on a whole number
only. A kernel that reads these powers has the edges of `edges.candidate_edges` to the last bit,
whatever its own exponential would answer.
"""

from __future__ import annotations

import functools
import math

import torch
from torch import Tensor

MOST_POWERS = 1 << 22
"""16 MiB; enough for a cone angle of 2e-5."""


def powers_needed(step_size: float, cone_angle: float) -> int:
    """Number of powers before t exceeds what a float32 can hold.

    The step grows from t = step_size / cone_angle on.
    """
    grown = math.log(torch.finfo(torch.float32).max) - math.log(step_size / cone_angle)
    return max(0, math.ceil(grown / math.log1p(cone_angle))) + 4


@functools.lru_cache(maxsize=8)
def growth_table(step_size: float, cone_angle: float, device: torch.device) -> Tensor:
    """(1 + cone_angle)^m for every m that may occur, as `candidate_edges` computes it; float32."""
    whole = torch.arange(powers_needed(step_size, cone_angle), dtype=torch.float32, device=device)
    return torch.exp(whole * math.log1p(cone_angle))
