"""The cell cache as kernels ask it; the torch twins are methods of `CellCache`."""

from __future__ import annotations

import triton
import triton.language as tl

from leco_plugin.samplers.cells.cache import BRICK, COARSE_OCCUPIED, FINE_EMPTY, FINE_OCCUPIED
from leco_plugin.samplers.kernels.gate_kernel import largest_of, mapped_of

_BRICK = tl.constexpr(BRICK)
_COARSE_OCCUPIED = tl.constexpr(COARSE_OCCUPIED)
_FINE_EMPTY = tl.constexpr(FINE_EMPTY)
_FINE_OCCUPIED = tl.constexpr(FINE_OCCUPIED)


@triton.jit
def _cells(x, y, z, facts, frame, RESOLUTION: tl.constexpr, CONTRACTED: tl.constexpr):
    """`CellCache._cells`: coordinates in coarse cells, the border included."""
    if CONTRACTED:
        x, y, z, _ = mapped_of(x, y, z, facts, True)
    scale = tl.load(frame)
    return (
        _clamped(tl.fma(x, scale, tl.load(frame + 1)), RESOLUTION),
        _clamped(tl.fma(y, scale, tl.load(frame + 2)), RESOLUTION),
        _clamped(tl.fma(z, scale, tl.load(frame + 3)), RESOLUTION),
    )


@triton.jit
def _clamped(cell, RESOLUTION: tl.constexpr):
    cell = tl.where(cell == cell, cell, 0.0)
    return tl.minimum(tl.maximum(cell, 0.0), RESOLUTION + 1.5)


@triton.jit
def cells_near(
    x,
    y,
    z,
    radius,
    facts,
    frame,
    clearance,
    RESOLUTION: tl.constexpr,
    CONTRACTED: tl.constexpr,
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
    RESOLUTION: tl.constexpr,
    CONTRACTED: tl.constexpr,
):
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
