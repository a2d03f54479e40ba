"""The candidates of a batch of rays: which rays can be marched, and from which step to which.

Nothing is held for a candidate; its edges follow from its number (`edges.py`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from leco_plugin.samplers.marching.edges import (
    MAX_CANDIDATES_PER_RAY,
    candidate_counts,
    candidate_edges,
)
from leco_plugin.samplers.marching.rays import check_rays, usable_rays


class TooManyCandidates(ValueError):
    """A ray has more candidates than a float32 can number."""


class Candidates(NamedTuple):
    """The candidates of a batch of rays, of which only the numbers are held."""

    coordinates: Tensor
    """Origins and directions, [2, 3, n_rays]: a CPU reads one coordinate at a time fastest."""
    t_mins: Tensor
    """t of edge 0 of each ray, [n_rays]."""
    first: Tensor
    """Number of the first step that is a candidate, whole but floating, [n_rays]; or [1] where it
    is the same for all rays, which saves computing with it for each candidate."""
    counts: Tensor
    """Number of candidates of each ray, whole but floating, [n_rays]."""
    step_size: float
    cone_angle: float

    def of_rays(self, rays: slice | Tensor) -> Candidates:
        """Those of some of the rays, given by a slice or by indices."""

        def pick(tensor: Tensor) -> Tensor:
            return tensor[..., rays] if isinstance(rays, slice) else tensor.index_select(-1, rays)

        return self._replace(
            coordinates=pick(self.coordinates.flatten(0, 1)).unflatten(0, (2, 3)),
            t_mins=pick(self.t_mins),
            first=self.first if len(self.first) == 1 else pick(self.first),
            counts=pick(self.counts),
        )

    def window(self, first_step: Tensor | int, n_steps: int) -> Candidates:
        """Those of the given steps of each ray, counted from its first candidate."""
        counts = (self.counts - first_step).clamp(0, n_steps)
        return self._replace(first=self.first + first_step, counts=counts)

    def edges(self, n_steps: int) -> Tensor:
        """t of the first `n_steps` + 1 edges of each ray, [n_steps + 1, n_rays]."""
        return self.edges_at(self.numbers(n_steps + 1))

    def edges_at(self, numbers: Tensor) -> Tensor:
        """t of the edges of these numbers [n], counted from the first candidate; [n, n_rays]."""
        steps = self.first + numbers[:, None]
        return candidate_edges(self.t_mins, steps, self.step_size, self.cone_angle)

    def numbers(self, end: int, step: int = 1) -> Tensor:
        """0, `step`, 2 `step` and so on, below `end`, of the type of t."""
        return torch.arange(0, end, step, dtype=self.t_mins.dtype, device=self.t_mins.device)


def plan(
    origins: Tensor,
    directions: Tensor,
    t_mins: Tensor,
    t_maxs: Tensor,
    step_size: float,
    cone_angle: float = 0.0,
    jitter: Tensor | None = None,
    t_enters: Tensor | None = None,
) -> tuple[Candidates, int, int]:
    """Number the candidates of each ray; arguments and errors as for `marching.march`.

    Returns:
        the candidates, and the least and most of any ray (the one wait for the device).
    """
    candidates = number(
        origins, directions, t_mins, t_maxs, step_size, cone_angle, jitter, t_enters
    )
    counts, shortest, longest = candidates.counts, 0, 0
    if len(counts):
        last = (candidates.first + counts).amax()
        sizes = torch.stack([*counts.aminmax(), last])
        shortest, longest, highest = sizes.long().tolist()
        check_longest(highest, len(counts), step_size)
    return candidates, shortest, longest


def number(
    origins: Tensor,
    directions: Tensor,
    t_mins: Tensor,
    t_maxs: Tensor,
    step_size: float,
    cone_angle: float = 0.0,
    jitter: Tensor | None = None,
    t_enters: Tensor | None = None,
) -> Candidates:
    """As `plan`, without the wait: how many candidates the longest ray has is not checked."""
    check_rays(origins, directions, t_mins, t_maxs, jitter, t_enters)
    if not (step_size > 0.0 and math.isfinite(step_size)):
        raise ValueError(f"step_size must be positive and finite, got {step_size}")
    if not (cone_angle >= 0.0 and math.isfinite(cone_angle)):
        raise ValueError(f"cone_angle must be finite and not negative, got {cone_angle}")
    if jitter is not None:
        t_mins = t_mins + jitter * step_size
    coordinates = torch.stack([origins.T, directions.T])
    usable = usable_rays(coordinates, t_mins, t_maxs)
    if t_enters is not None:
        usable &= t_enters < t_maxs
    skipped = ~usable
    t_mins, t_maxs = t_mins.masked_fill(skipped, 0.0), t_maxs.masked_fill(skipped, 0.0)
    if t_enters is None:
        counts = candidate_counts(t_mins, t_maxs, step_size, cone_angle)
        first = counts.new_zeros(1)
    else:
        limits = torch.stack([t_enters.minimum(t_maxs), t_maxs])
        first, ends = candidate_counts(t_mins, limits, step_size, cone_angle)
        counts = ends - first
    return Candidates(coordinates, t_mins, first, counts, step_size, cone_angle)


def check_longest(highest: int, n_rays: int, step_size: float) -> None:
    """Raise where a ray has more steps than a float32 can number.

    Args:
        highest: steps of a ray from its t_min to its last candidate, the most of any.
    Raises:
        TooManyCandidates: those are more than 2^24.
    """
    if highest > MAX_CANDIDATES_PER_RAY:
        raise TooManyCandidates(
            f"the longest of {n_rays} rays has over 2^24 steps of {step_size:g}: give a far "
            "plane (the report of an occupancy has near and far), t_max or a box, begin nearer to "
            "it, or take a longer step or a cone angle"
        )
