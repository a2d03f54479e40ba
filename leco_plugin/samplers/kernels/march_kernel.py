"""The fused march: rays to packed kept intervals in two launches of one Triton kernel.

Its torch twin is `marching.march` with the questions of `LearnedOccupancyEstimator`: the same
edges to the last bit, `CellCache.near` and `CellCache.decide` for each candidate, the gate for
those that cells leave open. A program walks one ray, `STEPS` candidates at a time, and asks the
gate about such a stretch only if some of it is open. The first launch counts what each ray keeps,
the second writes it; that they are one kernel is what makes the second decide like the first.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from leco_plugin.samplers.cells.cache import CellCache
from leco_plugin.samplers.kernels.cache_kernel import cells_decide, cells_near
from leco_plugin.samplers.kernels.gate_kernel import gate_keeps, sizes_of
from leco_plugin.samplers.kernels.gate_weights import GateWeights
from leco_plugin.samplers.marching import Candidates, Samples, check_longest
from leco_plugin.samplers.marching.edges import MAX_CANDIDATES_PER_RAY, switch
from leco_plugin.samplers.marching.growth import growth_table

STEPS = 32
"""Candidates that a program works on at once: one coarse question for all of them, and the gate's
products for all of them if one is left open."""

_MOST = tl.constexpr(MAX_CANDIDATES_PER_RAY)


@triton.jit
def _edge(step, t_min, step_size, n_linear, t_switch, growth, CONED: tl.constexpr):
    """`edges.candidate_edges`, with the powers of the growing step from a table."""
    linear = tl.fma(step, step_size, t_min)
    if CONED:
        power = tl.load(growth + tl.maximum(step - n_linear, 0.0).to(tl.int32))
        return tl.where(step <= n_linear, linear, t_switch * power)
    return linear


@triton.jit(do_not_specialize=["n_rays", "n_planes"])
def _march_kernel(
    rays,
    n_rays,
    numbers,
    growth,
    step_size,
    starts,
    ends,
    found,
    ray_indices,
    t_starts,
    t_ends,
    coarse,
    fine,
    first_plane,
    planes,
    n_planes,
    clearance,
    frame,
    facts,
    matrices,
    vectors,
    tables,
    grids,
    epsilon,
    STEPS: tl.constexpr,
    CONED: tl.constexpr,
    RESOLUTION: tl.constexpr,
    KIND: tl.constexpr,
    OCTAVES: tl.constexpr,
    LEVELS: tl.constexpr,
    FEATURES: tl.constexpr,
    MASK: tl.constexpr,
    COLUMNS: tl.constexpr,
    WIDTH: tl.constexpr,
    PADDED: tl.constexpr,
    LAYERS: tl.constexpr,
    LOGITS: tl.constexpr,
    PADDED_LOGITS: tl.constexpr,
    CONTRACTED: tl.constexpr,
    HALF: tl.constexpr,
):
    ray = tl.program_id(0)
    n_rays = n_rays.to(tl.int64)  # six rows of them are read
    ox, oy, oz = (
        tl.load(rays + ray),
        tl.load(rays + n_rays + ray),
        tl.load(rays + 2 * n_rays + ray),
    )
    rays += 3 * n_rays
    dx, dy, dz = (
        tl.load(rays + ray),
        tl.load(rays + n_rays + ray),
        tl.load(rays + 2 * n_rays + ray),
    )
    speed = tl.sqrt(dx * dx + dy * dy + dz * dz)
    t_min = tl.load(numbers + ray)
    first = tl.load(numbers + n_rays + ray)
    counted = tl.load(numbers + 2 * n_rays + ray)
    n_linear = tl.load(numbers + 3 * n_rays + ray)
    t_switch = tl.load(numbers + 4 * n_rays + ray)
    place = tl.load(starts + ray)
    end = tl.load(ends + ray)
    begun = place
    count = tl.where(counted <= _MOST, counted, 0.0).to(tl.int32)
    begin, left = first, count
    for _ in range(0, count, STEPS):
        size = tl.minimum(left, STEPS)
        t_begin = _edge(begin, t_min, step_size, n_linear, t_switch, growth, CONED)
        finish = begin + size.to(tl.float32)
        t_finish = _edge(finish, t_min, step_size, n_linear, t_switch, growth, CONED)
        middle = (t_begin + t_finish) * 0.5
        near = cells_near(
            tl.fma(dx, middle, ox),
            tl.fma(dy, middle, oy),
            tl.fma(dz, middle, oz),
            (t_finish - t_begin) * (0.5 * speed),
            facts,
            frame,
            clearance,
            RESOLUTION,
            CONTRACTED,
        )
        if near:
            steps = tl.arange(0, STEPS)
            wanted = steps < size
            # a step too far would read beyond the table of growth
            numbered = begin + tl.minimum(steps, size - 1).to(tl.float32)
            t_start = _edge(numbered, t_min, step_size, n_linear, t_switch, growth, CONED)
            t_end = _edge(numbered + 1.0, t_min, step_size, n_linear, t_switch, growth, CONED)
            middles = (t_start + t_end) * 0.5
            x, y, z = tl.fma(dx, middles, ox), tl.fma(dy, middles, oy), tl.fma(dz, middles, oz)
            kept, left_open = cells_decide(
                x,
                y,
                z,
                wanted,
                facts,
                frame,
                coarse,
                fine,
                first_plane,
                planes,
                n_planes,
                RESOLUTION,
                CONTRACTED,
            )
            kept = tl.where(wanted & kept, 1, 0)
            if tl.max(left_open.to(tl.int32), axis=0) > 0:
                by_gate = gate_keeps(
                    x,
                    y,
                    z,
                    facts,
                    matrices,
                    vectors,
                    tables,
                    grids,
                    epsilon,
                    STEPS,
                    KIND,
                    OCTAVES,
                    LEVELS,
                    FEATURES,
                    MASK,
                    COLUMNS,
                    WIDTH,
                    PADDED,
                    LAYERS,
                    LOGITS,
                    PADDED_LOGITS,
                    CONTRACTED,
                    HALF,
                )
                kept = tl.where(left_open, by_gate.to(tl.int32), kept)
            places = place + tl.cumsum(kept, axis=0) - kept
            written = tl.where(kept > 0, places, end) < end
            tl.store(ray_indices + places, ray.to(tl.int64), mask=written)
            tl.store(t_starts + places, t_start, mask=written)
            tl.store(t_ends + places, t_end, mask=written)
            place += tl.sum(kept, axis=0)
        begin += STEPS
        left -= STEPS
    tl.store(found + ray, place - begun)


def march_kept(cache: CellCache, weights: GateWeights, candidates: Candidates) -> Samples:
    """Packed kept intervals of rays, with one wait for the device between the two launches.

    Args:
        cache: the cells of the gate's decisions.
        weights: the gate, as `gate_weights` packs it.
        candidates: those of the rays, float32.

    Returns:
        As `marching.march` returns them.

    Raises:
        ValueError: a ray would have more than 2^24 candidates.
    """
    coordinates, t_mins, first, counts, step_size, cone_angle = candidates
    n_rays, device = len(counts), counts.device
    if not n_rays:
        return _room(0, device)
    coned = cone_angle > 0.0
    switches = switch(t_mins, step_size, cone_angle) if coned else (t_mins, t_mins)
    numbers = torch.stack([t_mins, first.expand_as(counts), counts, *switches])
    growth = growth_table(step_size, cone_angle, device) if coned else numbers
    tables = cache.tables()
    frame = torch.cat([cache.scale.view(-1), cache.shift.view(-1)])
    found = torch.zeros(n_rays, dtype=torch.int64, device=device)
    nowhere = torch.zeros_like(found)

    def launch(starts: Tensor, ends: Tensor, samples: Samples) -> None:
        _march_kernel[(n_rays,)](
            coordinates,
            n_rays,
            numbers,
            growth,
            step_size,
            starts,
            ends,
            found,
            *samples,
            tables.coarse,
            tables.fine,
            tables.first_plane,
            tables.planes,
            tables.planes.shape[1],
            tables.clearance,
            frame,
            weights.facts,
            weights.matrices,
            weights.vectors,
            weights.tables,
            weights.grids,
            weights.epsilon,
            STEPS=STEPS,
            CONED=coned,
            RESOLUTION=cache.resolution,
            **sizes_of(weights),
            num_warps=max(1, weights.padded_width // 32),
            enable_fp_fusion=False,
        )

    launch(nowhere, nowhere, _room(1, device))  # counts, and has no room to write
    ends = found.cumsum(0)
    last = (first + counts).max().long()
    total, highest = torch.stack([ends[-1], last]).tolist()  # the one wait
    check_longest(highest, n_rays, step_size)
    samples = _room(total, device)
    if total:
        launch(ends - found, ends, samples)
    return samples


def _room(count: int, device: torch.device) -> Samples:
    ray_indices = torch.empty(count, dtype=torch.int64, device=device)
    return ray_indices, torch.empty(count, device=device), torch.empty(count, device=device)
