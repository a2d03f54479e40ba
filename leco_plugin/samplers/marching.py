"""The one ray-marching rule: every sampler here is this rule with another "is it occupied?".

The rule is that of nerfacc's `traverse_grids`: intervals of length dt(t) = max(t cone_angle,
step_size) follow one another from t_min, and an interval is a candidate while its midpoint lies in
front of t_max. The midpoint is the position that is queried.

In all matrices here steps are rows and rays are columns. Broadcast values, such as ray origins and
step numbers, are then read in long rows, which a CPU does five times faster than in short ones.
Packed samples are the true entries of a matrix of answers, in column order.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import torch
from torch import Tensor

from leco_plugin.samplers.rays import Candidates, March, Rays, number, plan

__all__ = ["Candidates", "March", "NearFn", "OccupiedFn", "Rays", "Samples", "march", "number"]

OccupiedFn = Callable[[Tensor], Tensor]
"""Positions [N, 3] to bool [N]."""

NearFn = Callable[[Tensor, Tensor], Tensor]
"""Positions [N, 3] and radii [N] to bool [N]: may anything within the radius (maximum norm, a cube
around the position) be occupied?"""

Samples = tuple[Tensor, Tensor, Tensor]
"""ray_indices int64 [n_samples], t_starts [n_samples], t_ends [n_samples]."""

CPU_CHUNK = 1 << 19
DEVICE_CHUNK = 1 << 22
"""Positions asked at once: what fits the cache of a CPU core; elsewhere a training batch, because
each chunk there waits for the device."""

RUN_BITS = 4
RUN = 1 << RUN_BITS
"""Candidates of a run: long enough to work on at once, short enough to waste little."""


@torch.no_grad()
def march(
    rays: Rays, rule: March, occupied: OccupiedFn | None = None, near_occupied: NearFn | None = None
) -> Samples:
    """Candidates along rays, without those that `occupied` denies.

    Args:
        rays: of any number; one that is not finite, has no direction or t_min >= t_max has no
            samples.
        rule: the steps along them.
        occupied: which positions to keep; None keeps every candidate. Positions come with each
            coordinate contiguous (strides (1, N)): cheapest to make and to read.
        near_occupied: a coarse question, asked first and once for 16 candidates in a row; where it
            answers False, `occupied` would deny them all. It changes the time, not the result.

    Returns:
        ray_indices int64 [n_samples], t_starts [n_samples], t_ends [n_samples], sorted by ray,
        then t.

    Raises:
        ValueError: shapes, types or devices do not fit; a step is not positive; a ray would have
            more than 2^24 candidates (usually a missing far plane).
    """
    candidates, shortest, longest = plan(rays, rule)
    chunk = CPU_CHUNK if rays.origins.device.type == "cpu" else DEVICE_CHUNK
    in_runs = near_occupied is not None or shortest < longest
    at_once = chunk * RUN if in_runs else chunk  # a run is one coarse question
    runs_at_once = max(1, chunk // RUN)
    kept: list[Samples] = []
    for first_ray, tile, n_steps in tiles(candidates, longest, at_once):
        if not in_runs:
            of_tile, t_starts, t_ends = keep_steps(tile, n_steps, None, occupied)
            kept.append((of_tile + first_ray, t_starts, t_ends))
            continue
        of_runs, runs = cut(tile, n_steps, near_occupied)
        of_runs += first_ray
        for first_run in range(0, len(of_runs), runs_at_once):
            part = slice(first_run, first_run + runs_at_once)
            dense = near_occupied is not None
            kept.append(keep_steps(runs.of_rays(part), RUN, of_runs[part], occupied, dense))
    return join(kept, rays.origins)


def tiles(
    candidates: Candidates, longest: int, at_once: int
) -> Iterator[tuple[int, Candidates, int]]:
    """Cut a batch into tiles of rays x steps, in the order of rays, then steps.

    Args:
        longest: most candidates of any ray.
        at_once: most candidates of a tile, in whole runs.

    Yields:
        the first ray of a tile, its candidates, and the most of any of its rays.
    """
    rays_at_once = max(1, at_once // max(RUN, -(-longest // RUN) * RUN))
    steps_at_once = min(longest, max(RUN, at_once // RUN * RUN))
    for first_ray in range(0, len(candidates.counts) if longest else 0, rays_at_once):
        rays = candidates.of_rays(slice(first_ray, first_ray + rays_at_once))
        for first_step in range(0, longest, steps_at_once):
            n_steps = min(steps_at_once, longest - first_step)
            tile = rays.window(first_step, n_steps) if n_steps < longest else rays
            yield first_ray, tile, n_steps


def keep_steps(
    candidates: Candidates,
    n_steps: int,
    rays: Tensor | None,
    occupied: OccupiedFn | None,
    dense: bool = False,
) -> Samples:
    """Pack those of the first `n_steps` candidates of each ray that are occupied.

    Where rays are runs, `occupied` is asked also about the few steps by which a ray's last run is
    too long: those answers are not used.

    Args:
        rays: what to call each ray, int64 [n_rays], where they are runs of rays and some are too
            long. None: each goes by its place, and all have `n_steps` candidates.
        dense: whether much is kept, as where a coarse question has been asked: to look for runs in
            which anything is kept would then take longer than it saves.
    """
    edges = candidates.edges(n_steps)
    n_rays = edges.shape[1]
    within = None if rays is None else _within(candidates.counts, n_steps)
    if occupied is not None:
        origins, directions = candidates.coordinates[:, :, None]
        twice = edges[:-1] + edges[1:]  # it is exact to halve the directions instead, and less work
        places = torch.addcmul(origins, directions * 0.5, twice).view(3, -1).T
        answers = occupied(places).reshape(n_steps, n_rays)
        wanted = answers.contiguous() if within is None else within & answers
    elif within is not None:
        wanted = within
    else:
        every = torch.arange(n_rays, device=edges.device)[:, None].expand(n_rays, n_steps)
        return every.reshape(-1), edges[:-1].T.reshape(-1), edges[1:].T.reshape(-1)
    columns, at = places_by_column(wanted) if dense else places_by_column_in_runs(wanted)
    edges = edges.view(-1)
    ray_indices = columns if rays is None else rays.index_select(0, columns)
    return ray_indices, edges.index_select(0, at), edges.index_select(0, at + n_rays)


def _within(counts: Tensor, n_steps: int) -> Tensor:
    """Which of up to 255 steps are candidates of a ray that has so many: bool [n_steps, n_rays]."""
    steps = torch.arange(n_steps, dtype=torch.uint8, device=counts.device)[:, None]
    within = torch.empty(n_steps, len(counts), dtype=torch.uint8, device=counts.device)
    # an answer in the type of what is compared is found ten times faster on a CPU than a bool
    return torch.lt(steps, counts.to(torch.uint8), out=within).view(torch.bool)


def cut(
    candidates: Candidates, n_steps: int, near_occupied: NearFn | None
) -> tuple[Tensor, Candidates]:
    """Cut rays of up to `n_steps` candidates into runs, and keep those near something occupied: the
    ray of each, int64 [n_runs], and the runs as if each were a ray."""
    numbers = candidates.numbers(n_steps + RUN, RUN)
    wanted = numbers[:-1, None] < candidates.counts
    if near_occupied is not None:
        edges = candidates.edges_at(numbers)
        starts, ends = edges[:-1], edges[1:]
        origins, directions = candidates.coordinates[:, :, None]
        centers = torch.addcmul(origins, directions, (starts + ends) * 0.5).view(3, -1)
        speeds = candidates.coordinates[1].abs().amax(dim=0)
        near = near_occupied(centers.T, ((ends - starts) * (0.5 * speeds)).view(-1))
        wanted.bitwise_and_(near.view_as(wanted))
    rays, runs = by_column(wanted)
    first = (runs * RUN).to(numbers.dtype)
    return rays, candidates.of_rays(rays).window(first, RUN)


def by_column(wanted: Tensor) -> tuple[Tensor, Tensor]:
    """Columns and rows of what is true in bool [n, m], int64, by column, then row.

    Waits for the device.
    """
    n = len(wanted)
    chosen = wanted.T.contiguous().view(-1).nonzero()[:, 0]
    columns = chosen.div(n, rounding_mode="floor")
    return columns, chosen - columns * n


def places_by_column(wanted: Tensor) -> tuple[Tensor, Tensor]:
    """Columns of what is true in bool [n, m], and its places in the flat matrix, in that order."""
    columns, rows = by_column(wanted)
    return columns, torch.add(columns, rows, alpha=wanted.shape[1])


def places_by_column_in_runs(wanted: Tensor) -> tuple[Tensor, Tensor]:
    """The same, faster on a CPU if few runs of rows are not all false.

    What is kept of a ray lies together. On a CPU, where finding true entries takes longer than
    anything else of the march, most runs of rows are passed over at once. Elsewhere each search
    would wait for the device, so there is only one.
    """
    if wanted.device.type != "cpu":
        return places_by_column(wanted)
    n, m = wanted.shape
    if n % RUN:
        wanted = torch.cat([wanted, wanted.new_zeros(-n % RUN, m)])
    some = wanted.view(torch.uint8).unflatten(0, (-1, RUN)).amax(dim=1)
    columns, runs = by_column(some)
    first = torch.add(columns, runs, alpha=RUN * m)
    places = (first[:, None] + torch.arange(RUN, device=first.device) * m).view(-1)
    chosen = wanted.view(-1).index_select(0, places).nonzero()[:, 0]
    return columns.index_select(0, chosen >> RUN_BITS), places.index_select(0, chosen)


def join(parts: list[Samples], like: Tensor) -> Samples:
    """Concatenate samples; none at all is three empty tensors of the device and type of `like`."""
    if not parts:
        empty = torch.zeros(0, dtype=like.dtype, device=like.device)
        return empty.long(), empty, empty
    if len(parts) == 1:
        return parts[0]
    ray_indices, t_starts, t_ends = zip(*parts, strict=True)
    return torch.cat(ray_indices), torch.cat(t_starts), torch.cat(t_ends)
