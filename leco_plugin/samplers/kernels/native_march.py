"""The march of an estimator's rays in C, on a CPU; its torch twin is `marching.march`.

Cells decide in C. What they leave open is packed too, and the gate is then asked about all of it.
"""

from __future__ import annotations

import torch
from torch import Tensor

from leco_plugin.models.compute import native
from leco_plugin.samplers.cells.cache import CellCache
from leco_plugin.samplers.marching import OccupiedFn, Samples, join
from leco_plugin.samplers.rays import Candidates, March, Rays, plan

CANDIDATES_AT_ONCE = 1 << 22
"""That room is made for: 17 bytes each, of which only what is kept is touched."""


@torch.no_grad()
def march(occupied: OccupiedFn, cache: CellCache | None, rays: Rays, rule: March) -> Samples | None:
    """The candidates that a frozen gate keeps, by its decisions and cells of them; None: ask the
    torch twin. ValueError as of `marching.march`."""
    if cache is None or not native.suits(rays.origins, cache.frame):
        return None
    candidates, _, longest = plan(rays, rule)
    if not rule.fits_kernels:
        return None
    at_once = max(1, CANDIDATES_AT_ONCE // max(longest, 1))
    parts = []
    for first in range(0, len(candidates.counts), at_once):
        part = candidates.of_rays(slice(first, first + at_once))
        (ray_indices, t_starts, t_ends), left_open = _march(cache, part)
        parts.append((ray_indices.add_(first), t_starts, t_ends, left_open))
    if not parts:
        return join([], rays.origins)
    ray_indices, t_starts, t_ends, left_open = map(torch.cat, zip(*parts))
    asked = left_open.nonzero()[:, 0]
    if not len(asked):
        return ray_indices, t_starts, t_ends
    of_ray = ray_indices.index_select(0, asked)
    middles = (t_starts.index_select(0, asked) + t_ends.index_select(0, asked)) * 0.5
    origins, directions = candidates.coordinates.index_select(2, of_ray)
    answers = occupied(torch.addcmul(origins, directions, middles).T)
    kept = torch.ones_like(left_open).index_copy_(0, asked, answers).nonzero()[:, 0]
    ray_indices, t_starts, t_ends = (
        values.index_select(0, kept) for values in (ray_indices, t_starts, t_ends)
    )
    return ray_indices, t_starts, t_ends


def _march(cache: CellCache, candidates: Candidates) -> tuple[Samples, Tensor]:
    """What cells keep or leave open, and which of it they leave open: bool [n_samples]."""
    room = candidates.counts.long()
    total = int(room.sum())
    numbers, powers = candidates.for_kernels()
    new = candidates.t_mins.new_empty  # whatever torch's default type and device are
    samples = {
        "ray_indices": new(total, dtype=torch.int64),
        "t_starts": new(total),
        "t_ends": new(total),
        "open": new(total, dtype=torch.bool),
    }
    coarse, bricks, first_plane, planes, clearance = cache.held
    rooms = room.cumsum(0) - room
    found = native.call_along_rays(
        "march_cells",
        rooms,
        {
            "coordinates": candidates.coordinates.contiguous(),
            "numbers": numbers,
            "powers": powers,
            "rooms": rooms,
            "coarse": coarse,
            "first_plane": first_plane,
            "bricks": bricks,
            "clearance": clearance,
            "planes": planes.contiguous(),
            "frame": cache.frame,
            **samples,
            "step_size": candidates.rule.step_size,
            "rays": len(room),
            "all_planes": planes.shape[1],
            "resolution": cache.resolution,
            "contracted": int(cache.contracted),
            "wide": int(coarse.dtype == torch.int32),
        },
    )
    ray_indices, t_starts, t_ends, left_open = (
        torch.cat([each[part] for part in found]) for each in samples.values()
    )
    return (ray_indices, t_starts, t_ends), left_open
