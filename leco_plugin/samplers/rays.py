"""Rays, the rule by which they are marched, and their candidates.

Nothing is stored for a candidate: its edges follow from its number. Edge k has a closed form,
linear while the step is constant, geometric after. No candidate depends on another, and neighbours
share their edge exactly.
"""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

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


class TooManyCandidates(ValueError):
    """A ray has more candidates than a float32 can number."""


class Rays(NamedTuple):
    """A batch of rays and the part of each that is marched."""

    origins: Tensor
    """World units, float32 or float64 [n_rays, 3]."""
    directions: Tensor
    """[n_rays, 3]; t counts in multiples of their length."""
    t_mins: Tensor
    """Edge of the first candidate, [n_rays]."""
    t_maxs: Tensor
    """End of each ray, [n_rays]."""
    t_enters: Tensor | None = None
    """Where a ray enters a box, [n_rays]: leaves out candidates whose midpoint lies in front of
    this, without moving the others."""

    def shifted(self, by: Tensor) -> Rays:
        """The same rays with all candidates moved along them by t [n_rays]."""
        return self._replace(t_mins=self.t_mins + by)


class March(NamedTuple):
    """The marching rule: a step at distance t is as long as max(t cone_angle, step_size)."""

    step_size: float
    """Shortest step, world units, > 0."""
    cone_angle: float = 0.0
    """Growth of the step with distance, >= 0; 0 is a constant step."""

    @property
    def fits_kernels(self) -> bool:
        """Whether kernels can have the powers of a growing step in a table."""
        return self.cone_angle <= 0.0 or powers_needed(*self) <= MOST_POWERS


class Candidates(NamedTuple):
    """The candidates of a batch of rays; only their numbers are stored."""

    coordinates: Tensor
    """Origins and directions, [2, 3, n_rays]: a CPU reads one coordinate at a time fastest."""
    t_mins: Tensor
    """t of edge 0 of each ray, [n_rays]."""
    first: Tensor
    """Number of the first step that is a candidate, whole but floating, [n_rays]; or [1] where it
    is the same for all rays, which saves computing with it for each candidate."""
    counts: Tensor
    """Number of candidates of each ray, whole but floating, [n_rays]."""
    rule: March

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
        return candidate_edges(self.t_mins, self.first + numbers[:, None], *self.rule)

    def numbers(self, end: int, step: int = 1) -> Tensor:
        """0, `step`, 2 `step` and so on, below `end`, of the type of t."""
        return torch.arange(0, end, step, dtype=self.t_mins.dtype, device=self.t_mins.device)

    def for_kernels(self) -> tuple[Tensor, Tensor | None]:
        """What a kernel computes edges from.

        Returns:
            [5, n_rays]: t of edge 0, number of the first step, number of candidates, and number and
            t of the edge from which the step grows; and `growth_table`, None of a constant step.
        """
        step_size, cone_angle = self.rule
        switches, growth = (self.t_mins, self.t_mins), None
        if cone_angle > 0.0:
            switches = switch(self.t_mins, step_size, cone_angle)
            growth = growth_table(step_size, cone_angle, self.t_mins.device)
        first = self.first.expand_as(self.counts)
        return torch.stack([self.t_mins, first, self.counts, *switches]), growth


def plan(rays: Rays, rule: March) -> tuple[Candidates, int, int]:
    """The candidates of each ray, and the least and most of any ray (the one wait for the device).
    ValueError as of `marching.march`."""
    candidates = number(rays, rule)
    counts, shortest, longest = candidates.counts, 0, 0
    if len(counts):
        last = (candidates.first + counts).amax()
        sizes = torch.stack([*counts.aminmax(), last])
        shortest, longest, highest = sizes.long().tolist()
        check_longest(highest, len(counts), candidates.rule.step_size)
    return candidates, shortest, longest


def number(rays: Rays, rule: March) -> Candidates:
    """The candidates of each ray, without a wait: the longest ray is not checked.

    A ray that is not finite, has no direction or ends before it begins has no candidates: one bad
    pixel of a batch must not end a training run.
    """
    check_rays(rays)
    rule = March(*map(float, rule))  # kernels take the bits of a whole number for another
    step_size, cone_angle = rule
    if not (step_size > 0.0 and math.isfinite(step_size)):
        raise ValueError(f"step_size must be positive and finite, got {step_size}")
    if not (cone_angle >= 0.0 and math.isfinite(cone_angle)):
        raise ValueError(f"cone_angle must be finite and not negative, got {cone_angle}")
    t_mins, t_maxs, t_enters = rays.t_mins, rays.t_maxs, rays.t_enters
    coordinates = torch.stack([rays.origins.T, rays.directions.T])
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
    return Candidates(coordinates, t_mins, first, counts, rule)


def check_longest(highest: int, n_rays: int, step_size: float) -> None:
    """TooManyCandidates if a ray has more steps than a float32 can number, 2^24; `highest` counts
    those from its t_min to its last candidate, the most of any."""
    if highest > MAX_CANDIDATES_PER_RAY:
        raise TooManyCandidates(
            f"the longest of {n_rays} rays has over 2^24 steps of {step_size:g}: give a far "
            "plane (the report of an occupancy has near and far), t_max or a box, begin nearer to "
            "it, or take a longer step or a cone angle"
        )


def check_rays(rays: Rays) -> None:
    """ValueError unless the tensors describe one batch of rays: each is [n_rays, 3] or [n_rays], of
    the type and on the device of the origins, and in float32 or float64 (half precision cannot tell
    neighbouring steps apart)."""
    origins = rays.origins
    if origins.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"rays must be float32 or float64, got {origins.dtype}")
    n_rays = origins.shape[0] if origins.dim() else 0
    names = ("rays_o", "rays_d", "t_mins", "t_maxs", "t_enters")
    for name, tensor in zip(names, rays, strict=True):
        shape = (n_rays, 3) if name.startswith("rays") else (n_rays,)
        if tensor is None:
            continue
        if tensor.shape != shape:
            raise ValueError(f"{name} must be {list(shape)}, got {list(tensor.shape)}")
        if tensor.dtype != origins.dtype or tensor.device != origins.device:
            raise ValueError(
                f"{name} is {tensor.dtype} on {tensor.device}, but rays_o is {origins.dtype} on "
                f"{origins.device}"
            )


def usable_rays(coordinates: Tensor, t_mins: Tensor, t_maxs: Tensor) -> Tensor:
    """Which rays are finite, go somewhere and begin before they end, bool [n_rays], by their
    origins and directions [2, 3, n_rays], and where they begin and end [n_rays]."""
    origins, directions = coordinates.abs().amax(dim=1)
    largest = torch.maximum(origins, directions).maximum(t_mins.abs())  # NaN if anything is
    return (largest < torch.inf) & (directions > 0.0) & (t_mins < t_maxs)
