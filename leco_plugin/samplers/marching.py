"""The one ray-marching rule: every sampler here is this rule with another "is it occupied?".

The rule is that of nerfacc's `traverse_grids`: intervals of length dt(t) = max(t cone_angle,
step_size) follow one another from t_min, and an interval is a candidate while its midpoint lies in
front of t_max; its midpoint is the position that is asked. Edge k has a closed form (linear while
the step is constant, geometric after), so no candidate depends on the decision for another, none
needs to be stored, and neighbours share their edge exactly.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from leco_plugin.samplers.rays import check_rays, usable_rays

OccupiedFn = Callable[[Tensor], Tensor]
"""Positions [N, 3] to bool [N]."""

NearFn = Callable[[Tensor, Tensor], Tensor]
"""Positions [N, 3] and radii [N] to bool [N]: may anything within the radius be occupied?"""

Samples = tuple[Tensor, Tensor, Tensor]
"""ray_indices int64 [n_samples], t_starts [n_samples], t_ends [n_samples]."""

MAX_CANDIDATES_PER_RAY = 1 << 24
"""Above this a float32 cannot number the candidates of a ray; nobody means to march so far."""

CPU_CHUNK = 1 << 19
DEVICE_CHUNK = 1 << 22
"""Candidates worked on at once: what fits the cache of a CPU core; elsewhere a training batch,
because each chunk there waits for the device once."""


RUN = 16
"""Candidates of a run: long enough to work on at once, short enough to waste little."""


class TooManyCandidates(ValueError):
    """A ray has more candidates than a float32 can number."""


class Candidates(NamedTuple):
    """The candidates of a batch of rays, of which only the numbers are held."""

    coordinates: Tensor
    """Origins and directions, [2, 3, n_rays]: a CPU reads one coordinate at a time fastest."""
    t_mins: Tensor
    """t of edge 0 of each ray, [n_rays]."""
    first: Tensor
    """Number of the first step that is a candidate, whole but floating, [n_rays]."""
    counts: Tensor
    """Number of candidates of each ray, whole but floating, [n_rays]."""
    step_size: float
    cone_angle: float

    def of_rays(self, rays: slice | Tensor) -> Candidates:
        """Those of some of the rays, given by a slice or by indices."""

        def pick(tensor: Tensor) -> Tensor:
            return tensor[..., rays] if isinstance(rays, slice) else tensor.index_select(-1, rays)

        return self._replace(
            coordinates=pick(self.coordinates),
            t_mins=pick(self.t_mins),
            first=pick(self.first),
            counts=pick(self.counts),
        )

    def window(self, first_step: Tensor | int, n_steps: int) -> Candidates:
        """Those of the given steps of each ray, counted from its first candidate."""
        counts = (self.counts - first_step).clamp(0, n_steps)
        return self._replace(first=self.first + first_step, counts=counts)

    def edges(self, n_steps: int) -> Tensor:
        """t of the first `n_steps` + 1 edges of each ray, [n_rays, n_steps + 1]."""
        steps = torch.arange(n_steps + 1, dtype=self.t_mins.dtype, device=self.t_mins.device)
        steps = self.first[:, None] + steps
        return candidate_edges(self.t_mins[:, None], steps, self.step_size, self.cone_angle)


@torch.no_grad()
def march(
    origins: Tensor,
    directions: Tensor,
    t_mins: Tensor,
    t_maxs: Tensor,
    *,
    step_size: float,
    cone_angle: float = 0.0,
    jitter: Tensor | None = None,
    occupied: OccupiedFn | None = None,
    near_occupied: NearFn | None = None,
    t_enters: Tensor | None = None,
    chunk_size: int | None = None,
) -> Samples:
    """Candidates along rays, without those that `occupied` denies.

    Args:
        origins: ray origins, world units, float32 or float64 [n_rays, 3].
        directions: ray directions [n_rays, 3]; t counts in multiples of their length.
        t_mins, t_maxs: where each ray is marched, [n_rays].
        step_size: shortest step, world units, > 0.
        cone_angle: growth of the step with distance, >= 0; 0 is a constant step.
        jitter: in [0, 1), [n_rays]: shifts all candidates of a ray by that share of `step_size`
            (stratified sampling); None is deterministic.
        occupied: which positions to keep; None keeps every candidate. Positions come with each
            coordinate contiguous (strides (1, N)): cheapest to make and to read.
        near_occupied: a coarse question, asked first and once for 16 candidates in a row; where it
            answers False, `occupied` would deny them all. It changes the time, not the result.
        t_enters: leave out candidates whose midpoint lies in front of this, [n_rays]: where a ray
            enters a box, without moving the candidates inside it.
        chunk_size: most candidates held at once (a run of 16 at least).

    Returns:
        ray_indices int64 [n_samples], t_starts [n_samples], t_ends [n_samples], sorted by ray,
        then t. A ray that is not finite, has no direction or t_min >= t_max has no samples.

    Raises:
        ValueError: shapes, types or devices do not fit; a step is not positive; a ray would have
            more than 2^24 candidates (usually a missing far plane).
    """
    candidates, shortest, longest = plan(
        origins, directions, t_mins, t_maxs, step_size, cone_angle, jitter, t_enters
    )
    if chunk_size is None:
        chunk_size = CPU_CHUNK if origins.device.type == "cpu" else DEVICE_CHUNK
    rays_at_once = max(1, chunk_size // max(RUN, -(-longest // RUN) * RUN))  # in whole runs
    steps_at_once = min(longest, max(RUN, chunk_size // RUN * RUN))
    kept: list[Samples] = []
    for first_ray in range(0, len(origins) if longest else 0, rays_at_once):
        rays = candidates.of_rays(slice(first_ray, first_ray + rays_at_once))
        for first_step in range(0, longest, steps_at_once):
            n_steps = min(steps_at_once, longest - first_step)
            tile = rays.window(first_step, n_steps) if n_steps < longest else rays
            uniform = shortest >= first_step + n_steps
            ray_indices, t_starts, t_ends = keep(tile, n_steps, uniform, occupied, near_occupied)
            kept.append((ray_indices + first_ray, t_starts, t_ends))
    return join(kept, origins)


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
    """Number the candidates of each ray; arguments and errors as for `march`.

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
    usable = usable_rays(origins, directions, t_mins, t_maxs)
    if t_enters is not None:
        usable &= t_enters < t_maxs
    t_mins, t_maxs = t_mins.masked_fill(~usable, 0.0), t_maxs.masked_fill(~usable, 0.0)
    counts = candidate_counts(t_mins, t_maxs, step_size, cone_angle)
    first = torch.zeros_like(counts)
    if t_enters is not None:
        first = candidate_counts(t_mins, t_enters.minimum(t_maxs), step_size, cone_angle)
        counts = counts - first
    coordinates = torch.stack([origins.T, directions.T])
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
            "plane, t_max or a box, begin nearer to it, or take a longer step or a cone angle"
        )


def keep(
    candidates: Candidates,
    n_steps: int,
    uniform: bool,
    occupied: OccupiedFn | None,
    near_occupied: NearFn | None = None,
) -> Samples:
    """Pack those candidates that are occupied.

    Args:
        n_steps: most candidates of any ray.
        uniform: all rays have that many. Otherwise, and for the coarse question, rays are cut into
            runs of equal length, and `occupied` is also asked about the few steps by which a
            ray's last run is too long: their answers are not used.
    """
    runs, rays = candidates, None
    if not uniform or near_occupied is not None:
        rays, runs = cut(candidates, n_steps, near_occupied)
        n_steps = RUN
    edges = runs.edges(n_steps)
    wanted = None
    if rays is not None:
        wanted = torch.arange(n_steps, device=edges.device) < runs.counts[:, None]
    if occupied is not None:
        midpoints = (edges[:, :-1] + edges[:, 1:]).mul_(0.5)
        origins, directions = runs.coordinates[..., None]
        answers = occupied(torch.addcmul(origins, directions, midpoints).view(3, -1).T)
        wanted = answers if wanted is None else wanted.view(-1).logical_and_(answers)
    if wanted is None:
        wanted = edges.new_ones(len(edges) * n_steps, dtype=torch.bool)
    chosen = wanted.view(-1).nonzero()[:, 0]
    run_indices = chosen.div(n_steps, rounding_mode="floor")
    at = chosen + run_indices  # a row of edges is one longer than a row of candidates
    edges = edges.view(-1)
    ray_indices = run_indices if rays is None else rays.index_select(0, run_indices)
    return ray_indices, edges.index_select(0, at), edges.index_select(0, at + 1)


def cut(
    candidates: Candidates, n_steps: int, near_occupied: NearFn | None
) -> tuple[Tensor, Candidates]:
    """Cut rays of up to `n_steps` candidates into runs, and keep those near something occupied.

    Returns:
        ray of each run, int64 [n_runs], and the runs as if each were a ray.
    """
    t_mins, device = candidates.t_mins, candidates.t_mins.device
    numbers = torch.arange(0, n_steps + RUN, RUN, dtype=t_mins.dtype, device=device)
    wanted = numbers[:-1] < candidates.counts[:, None]
    if near_occupied is not None:
        steps = candidates.first[:, None] + numbers
        edges = candidate_edges(t_mins[:, None], steps, candidates.step_size, candidates.cone_angle)
        starts, ends = edges[:, :-1], edges[:, 1:]
        origins, directions = candidates.coordinates[..., None]
        centers = torch.addcmul(origins, directions, (starts + ends) * 0.5).view(3, -1)
        speeds = directions.square().sum(dim=0).sqrt()
        near = near_occupied(centers.T, ((ends - starts) * (0.5 * speeds)).view(-1))
        wanted = wanted.view(-1).logical_and_(near)
    chosen = wanted.view(-1).nonzero()[:, 0]
    rays = chosen.div(len(numbers) - 1, rounding_mode="floor")
    first = (chosen - rays * (len(numbers) - 1)) * RUN
    return rays, candidates.of_rays(rays).window(first, RUN)


def join(parts: list[Samples], like: Tensor) -> Samples:
    """Concatenate samples; none at all is three empty tensors of the device and type of `like`."""
    if not parts:
        empty = torch.zeros(0, dtype=like.dtype, device=like.device)
        return empty.long(), empty, empty
    if len(parts) == 1:
        return parts[0]
    ray_indices, t_starts, t_ends = zip(*parts, strict=True)
    return torch.cat(ray_indices), torch.cat(t_starts), torch.cat(t_ends)


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
        t_maxs: [n_rays], may be infinite.

    Returns:
        [n_rays], whole but floating; exact below 2^24, capped near 2^25.
    """
    counts = ((t_maxs - t_mins) / step_size - 0.5).ceil()
    if cone_angle > 0.0:
        n_linear, t_switch = switch(t_mins, step_size, cone_angle)
        ratio = t_maxs / (t_switch * (1.0 + 0.5 * cone_angle))
        geometric = n_linear + (ratio.clamp(min=1e-12).log() / math.log1p(cone_angle)).ceil()
        counts = torch.where(counts > n_linear, geometric.maximum(n_linear), counts)
    counts = counts.nan_to_num(nan=0.0).clamp(0, 2 * MAX_CANDIDATES_PER_RAY)
    # The estimate can be one off by rounding; the rule is the comparison with the midpoint itself.
    for _ in range(2):
        counts = counts + (_midpoint(t_mins, counts, step_size, cone_angle) < t_maxs)
        late = _midpoint(t_mins, counts - 1.0, step_size, cone_angle) >= t_maxs
        counts = counts - (late & (counts > 0)).to(counts.dtype)
    return counts


def _midpoint(t_mins: Tensor, steps: Tensor, step_size: float, cone_angle: float) -> Tensor:
    starts = candidate_edges(t_mins, steps, step_size, cone_angle)
    return (starts + candidate_edges(t_mins, steps + 1.0, step_size, cone_angle)) * 0.5


def switch(t_mins: Tensor, step_size: float, cone_angle: float) -> tuple[Tensor, Tensor]:
    """First edge with t cone_angle >= step_size, from which the step grows, and its t."""
    n_linear = ((step_size / cone_angle - t_mins) / step_size).ceil().clamp(min=0.0)
    return n_linear, torch.add(t_mins, n_linear, alpha=step_size)
