"""Where the candidates of a ray begin and end, and how many there are.

Edge k has a closed form (linear while the step is constant, geometric after), so no candidate
depends on another, none needs to be stored, and neighbours share their edge exactly.
"""

from __future__ import annotations

import functools
import math

import torch
from torch import Tensor

MAX_CANDIDATES_PER_RAY = 1 << 24
"""Above this a float32 cannot number the candidates of a ray; nobody means to march so far."""

MOST_POWERS = 1 << 22
"""Largest table of powers for the kernel: 16 MiB, enough for a cone angle of 2e-5."""


def candidate_edges(t_mins: Tensor, steps: Tensor, step_size: float, cone_angle: float) -> Tensor:
    """t of edge k of a ray: the solution of t_{k+1} = t_k + max(t_k cone_angle, step_size).

    Args:
        t_mins: t of edge 0.
        steps: k, whole but floating, >= 0, of a shape that broadcasts with `t_mins`.

    Returns:
        t of the edges in the broadcast shape; rounding errors do not add up along a ray.
    """
    linear = torch.add(t_mins, steps, alpha=step_size)
    if cone_angle <= 0.0:
        return linear
    n_linear, t_switch = switch(t_mins, step_size, cone_angle)
    growth = torch.exp((steps - n_linear).clamp_(min=0.0) * math.log1p(cone_angle))
    return torch.where(steps <= n_linear, linear, t_switch * growth)


def candidate_counts(t_mins: Tensor, t_maxs: Tensor, step_size: float, cone_angle: float) -> Tensor:
    """Number of candidates of each ray, that is, of midpoints in front of t_max.

    Args:
        t_mins: finite [n_rays].
        t_maxs: [..., n_rays], may be infinite.

    Returns:
        [..., n_rays], whole but floating; exact below 2^24, capped near 2^25.
    """
    counts = ((t_maxs - t_mins) / step_size - 0.5).ceil()
    if cone_angle > 0.0:
        n_linear, t_switch = switch(t_mins, step_size, cone_angle)
        ratio = t_maxs / (t_switch * (1.0 + 0.5 * cone_angle))
        geometric = n_linear + (ratio.clamp(min=1e-12).log() / math.log1p(cone_angle)).ceil()
        counts = torch.where(counts > n_linear, geometric.maximum(n_linear), counts)
    counts = counts.nan_to_num(nan=0.0).clamp(0, 2 * MAX_CANDIDATES_PER_RAY)
    # The estimate can be one off by rounding; the rule is the comparison with the midpoint itself:
    # of the last candidate, which has to lie in front, and of the one that would follow.
    around = torch.arange(-1, 2, dtype=counts.dtype, device=counts.device)
    around = around.view(3, *[1] * counts.dim())
    for _ in range(2):
        edges = candidate_edges(t_mins, counts + around, step_size, cone_angle)
        in_front = (edges[:-1] + edges[1:]) * 0.5 < t_maxs
        counts = (counts + in_front.sum(dim=0, dtype=counts.dtype) - 1.0).clamp(min=0.0)
    return counts


def switch(t_mins: Tensor, step_size: float, cone_angle: float) -> tuple[Tensor, Tensor]:
    """First edge with t cone_angle >= step_size, from which the step grows, and its t."""
    n_linear = ((step_size / cone_angle - t_mins) / step_size).ceil().clamp(min=0.0)
    return n_linear, torch.add(t_mins, n_linear, alpha=step_size)


def powers_needed(step_size: float, cone_angle: float) -> int:
    """Number of powers of a growing step before t exceeds what a float32 can hold.

    The step grows from t = step_size / cone_angle on.
    """
    grown = math.log(torch.finfo(torch.float32).max) - math.log(step_size / cone_angle)
    return max(0, math.ceil(grown / math.log1p(cone_angle))) + 4


@functools.lru_cache(maxsize=8)
def growth_table(step_size: float, cone_angle: float, device: torch.device) -> Tensor:
    """(1 + cone_angle)^m for every m that may occur, as `candidate_edges` computes it; float32.

    A kernel that reads these powers has the same edges to the last bit, whatever its own
    exponential would answer.
    """
    whole = torch.arange(powers_needed(step_size, cone_angle), dtype=torch.float32, device=device)
    return torch.exp(whole * math.log1p(cone_angle))
