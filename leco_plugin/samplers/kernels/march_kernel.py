"""The fused march: rays to packed kept intervals in two launches of one Triton kernel.

Its torch twin is `marching.march` with the questions of `LearnedOccupancyEstimator`: the same
edges to the last bit, `CellCache.near` and `CellCache.decide` for each candidate, the gate for
those that cells leave open. A program walks one ray, `STEPS` candidates at a time, and queries the
gate only if some of these are open. The first launch counts what each ray keeps, and the second
writes it. Both are the same kernel, so that they decide alike.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from leco_plugin.samplers.cells.cache import (
    BRICK,
    COARSE_OCCUPIED,
    FINE_EMPTY,
    FINE_OCCUPIED,
    CellCache,
)
from leco_plugin.samplers.kernels.gate_kernel import gate_keeps, largest_of, map_position
from leco_plugin.samplers.kernels.gate_weights import GateWeights
from leco_plugin.samplers.marching import Samples
from leco_plugin.samplers.rays import MAX_CANDIDATES_PER_RAY, Candidates, check_longest

STEPS = 32
"""Candidates that a program works on at once: one coarse question for all of them, and the gate's
products for all of them if one is left open."""

_MOST = tl.constexpr(MAX_CANDIDATES_PER_RAY)
_BRICK = tl.constexpr(BRICK)
_COARSE_OCCUPIED = tl.constexpr(COARSE_OCCUPIED)
_FINE_EMPTY = tl.constexpr(FINE_EMPTY)
_FINE_OCCUPIED = tl.constexpr(FINE_OCCUPIED)


@triton.jit
def _cells(x, y, z, facts, frame, RESOLUTION: tl.constexpr, CONTRACTED: tl.constexpr):
    """`CellCache._cells`: coordinates in coarse cells, the border included."""
    if CONTRACTED:
        x, y, z, _ = map_position(x, y, z, facts, True)
    scale = tl.load(frame)
    return (
        _clamp(tl.fma(x, scale, tl.load(frame + 1)), RESOLUTION),
        _clamp(tl.fma(y, scale, tl.load(frame + 2)), RESOLUTION),
        _clamp(tl.fma(z, scale, tl.load(frame + 3)), RESOLUTION),
    )


@triton.jit
def _clamp(cell, RESOLUTION: tl.constexpr):
    cell = tl.where(cell == cell, cell, 0.0)
    return tl.minimum(tl.maximum(cell, 0.0), RESOLUTION + 1.5)


@triton.jit
def cells_near(
    x, y, z, radius, facts, frame, clearance, RESOLUTION: tl.constexpr, CONTRACTED: tl.constexpr
):
    """`CellCache.near` of one cube."""
    u, v, w = _cells(x, y, z, facts, frame, RESOLUTION, CONTRACTED)
    u, v, w = (u - 1.0) * 2.0, (v - 1.0) * 2.0, (w - 1.0) * 2.0
    width: tl.constexpr = 2 * RESOLUTION
    last = width - 1.0
    i = tl.floor(tl.minimum(tl.maximum(u, 0.0), last))
    j = tl.floor(tl.minimum(tl.maximum(v, 0.0), last))
    k = tl.floor(tl.minimum(tl.maximum(w, 0.0), last))
    aside = largest_of(u - i - 0.5, v - j - 0.5, w - k - 0.5)
    index = (i.to(tl.int32) * width + j.to(tl.int32)) * width + k.to(tl.int32)
    pair = tl.load(clearance + (index >> 1)).to(tl.int32)
    clear = (pair >> ((index & 1) * 4)) & 15
    stretch = tl.load(frame)
    if CONTRACTED:
        half_extent = tl.load(facts + 3)
        distance = largest_of(x - tl.load(facts), y - tl.load(facts + 1), z - tl.load(facts + 2))
        inner = tl.maximum((distance - radius) / half_extent, 1.5)
        stretch = stretch * (0.5 / half_extent) * (4.0 * inner - 3.0) / (inner * inner)
    return radius * stretch * 2.0 + (aside + 0.5) >= clear


@triton.jit
def cells_decide(
    x, y, z, wanted, facts, frame, coarse, fine, first_plane, planes, n_planes,
    RESOLUTION: tl.constexpr, CONTRACTED: tl.constexpr,
):  # fmt: skip
    """`CellCache.decide`: which of the wanted positions are occupied, and which are left open."""
    u, v, w = _cells(x, y, z, facts, frame, RESOLUTION, CONTRACTED)
    i, j, k = tl.floor(u), tl.floor(v), tl.floor(w)
    width: tl.constexpr = RESOLUTION + 2
    at = (i.to(tl.int32) * width + j.to(tl.int32)) * width + k.to(tl.int32)
    brick = tl.load(coarse + at, mask=wanted, other=-1).to(tl.int32)
    occupied = brick == _COARSE_OCCUPIED

    u, v, w = (u - i) * _BRICK, (v - j) * _BRICK, (w - k) * _BRICK
    i, j, k = tl.floor(u), tl.floor(v), tl.floor(w)
    at = (i.to(tl.int32) * _BRICK + j.to(tl.int32)) * _BRICK + k.to(tl.int32)
    at += brick * (_BRICK * _BRICK * _BRICK)
    known = tl.load(fine + at, mask=brick >= 0, other=_FINE_EMPTY).to(tl.int32)
    occupied = occupied | (known == _FINE_OCCUPIED)

    held = known < _FINE_EMPTY
    plane = planes + tl.load(first_plane + brick, mask=held, other=0) + known
    height = tl.load(plane, mask=held, other=0).to(tl.float32)
    for axis in tl.static_range(3):
        plane += n_planes
        slope = tl.load(plane, mask=held, other=0).to(tl.float32)
        along = u - i if axis == 0 else (v - j if axis == 1 else w - k)
        height = tl.fma(slope, along * 2.0 - 1.0, height)
    error = tl.load(plane + n_planes, mask=held, other=0).to(tl.float32)
    occupied = occupied | (height > 0.0)
    return occupied, tl.where(held, tl.abs(height) <= error, held)


@triton.jit
def _edge(step, t_min, step_size, n_linear, t_switch, growth, CONED: tl.constexpr):
    """`rays.candidate_edges`, with the powers of the growing step from a table."""
    linear = tl.fma(step, step_size, t_min)
    if CONED:
        power = tl.load(growth + tl.maximum(step - n_linear, 0.0).to(tl.int32))
        return tl.where(step <= n_linear, linear, t_switch * power)
    return linear


@triton.jit
def _three_rows(rows, n_rays, ray):
    """A ray's numbers in three rows, one behind the other."""
    return tl.load(rows + ray), tl.load(rows + n_rays + ray), tl.load(rows + 2 * n_rays + ray)


@triton.jit(do_not_specialize=["n_rays", "n_planes"])
def _march_kernel(
    rays, n_rays, numbers, growth, step_size, starts, ends, found, ray_indices, t_starts, t_ends,
    coarse, fine, first_plane, planes, n_planes, clearance, frame, facts, matrices, vectors, seen,
    STEPS: tl.constexpr, CONED: tl.constexpr, RESOLUTION: tl.constexpr, OCTAVES: tl.constexpr,
    COLUMNS: tl.constexpr, WIDTH: tl.constexpr, PADDED_WIDTH: tl.constexpr, LAYERS: tl.constexpr,
    LOGITS: tl.constexpr, PADDED_LOGITS: tl.constexpr, CONTRACTED: tl.constexpr, HALF: tl.constexpr,
):  # fmt: skip
    ray = tl.program_id(0)
    n_rays = n_rays.to(tl.int64)  # six rows of them are read
    ox, oy, oz = _three_rows(rays, n_rays, ray)
    dx, dy, dz = _three_rows(rays + 3 * n_rays, n_rays, ray)
    speed = tl.sqrt(dx * dx + dy * dy + dz * dz)
    t_min, first, counted = _three_rows(numbers, n_rays, ray)
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
        u, v, w = tl.fma(dx, middle, ox), tl.fma(dy, middle, oy), tl.fma(dz, middle, oz)
        radius = (t_finish - t_begin) * (0.5 * speed)
        if cells_near(u, v, w, radius, facts, frame, clearance, RESOLUTION, CONTRACTED):
            steps = tl.arange(0, STEPS)
            wanted = steps < size
            # a step too far would read beyond the table of growth
            numbered = begin + tl.minimum(steps, size - 1).to(tl.float32)
            t_start = _edge(numbered, t_min, step_size, n_linear, t_switch, growth, CONED)
            t_end = _edge(numbered + 1.0, t_min, step_size, n_linear, t_switch, growth, CONED)
            middles = (t_start + t_end) * 0.5
            x, y, z = tl.fma(dx, middles, ox), tl.fma(dy, middles, oy), tl.fma(dz, middles, oz)
            kept, left_open = cells_decide(
                x, y, z, wanted, facts, frame, coarse, fine, first_plane, planes, n_planes,
                RESOLUTION, CONTRACTED,
            )  # fmt: skip
            kept = tl.where(wanted & kept, 1, 0)
            if tl.max(left_open.to(tl.int32), axis=0) > 0:
                by_gate = gate_keeps(
                    x, y, z, facts, matrices, vectors, seen, STEPS, OCTAVES, COLUMNS, WIDTH,
                    PADDED_WIDTH, LAYERS, LOGITS, PADDED_LOGITS, CONTRACTED, HALF,
                )  # fmt: skip
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
    """Packed kept intervals of rays, as of `marching.march`, with one wait for the device.

    Args:
        cache: the cells of the gate's decisions.
        weights: the gate, as `gate_weights` packs it.
        candidates: those of the rays, float32.
    Raises:
        ValueError: a ray would have more than 2^24 candidates.
    """
    coordinates, _, first, counts, (step_size, _) = candidates
    n_rays, device = len(counts), counts.device
    if not n_rays:
        return _room(0, device)
    numbers, powers = candidates.for_kernels()
    growth = numbers if powers is None else powers  # of a constant step none is read
    coarse, fine, first_plane, planes, clearance = cache.tables()
    cells = (coarse, fine, first_plane, planes, planes.shape[1], clearance, cache.frame)
    found = torch.zeros(n_rays, dtype=torch.int64, device=device)
    nowhere = torch.zeros_like(found)

    def launch(starts: Tensor, ends: Tensor, samples: Samples) -> None:
        marched = (coordinates, n_rays, numbers, growth, step_size, starts, ends, found)
        _march_kernel[(n_rays,)](
            *marched,
            *samples,
            *cells,
            *weights.values,
            STEPS=STEPS,
            CONED=powers is not None,
            RESOLUTION=cache.resolution,
            **weights.sizes,
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
