"""Encodings of mapped positions as the fused gate forms them.

The torch twins are in `models/encodings.py`.

A tile holds a feature of a position at each place, [ROWS, COLUMNS]; columns beyond the features
are padding, which the rows of the first matrix beyond them, all zero, leave without effect.

Sines and cosines of 2^k pi x come from 2^k x, reduced to a quarter turn without rounding, and a
polynomial; the twin rounds its angles, by up to 2^(k - 23), and that is how far they differ.
"""

from __future__ import annotations

import triton
import triton.language as tl

from leco_plugin.models.encodings import PRIMES
from leco_plugin.samplers.kernels.gate_weights import HASH, VM

_HASH, _VM = tl.constexpr(HASH), tl.constexpr(VM)
_PRIME_Y, _PRIME_Z = (tl.constexpr(prime) for prime in PRIMES[1:])
_ROUNDING = tl.constexpr(1.5 * 2**23)
"""Added to a number below 2^22 it leaves the nearest whole one, whose last bit says whether it is
odd; rounding instructions run at an eighth of the rate of additions."""


@triton.jit
def frequencies(u, v, w, OCTAVES: tl.constexpr, COLUMNS: tl.constexpr):
    """Sines, behind them the coordinates; and cosines."""
    column = tl.arange(0, COLUMNS)
    turning = column < 3 * OCTAVES
    axis = (column % 3)[None, :]
    scale = (1 << tl.where(turning, column // 3, 0)).to(tl.float32)[None, :]
    coordinates = tl.where(
        axis == 0, u[:, None], tl.where(axis == 1, v[:, None], w[:, None])
    )  # [ROWS, COLUMNS]
    sines, cosines = _sines_and_cosines(coordinates * scale)
    return tl.where(turning[None, :], sines, coordinates), cosines


@triton.jit
def _sines_and_cosines(half_turns):
    """sin(pi y) and cos(pi y), to 1e-7."""
    shifted = half_turns + _ROUNDING
    part = half_turns - (shifted - _ROUNDING)
    odd = shifted.to(tl.int32, bitcast=True) << 31
    square = part * part
    sine = tl.fma(square, 0.07765766030370826, -0.5982912856197324)
    sine = tl.fma(square, sine, 2.5500775232145423)
    sine = tl.fma(square, sine, -5.167710083507896)
    sine = tl.fma(square, sine, 3.1415926401307073)
    cosine = tl.fma(square, 0.2196896110974905, -1.331876568080807)
    cosine = tl.fma(square, cosine, 4.058411352862603)
    cosine = tl.fma(square, cosine, -4.934792830619646)
    cosine = tl.fma(square, cosine, 0.9999999532476083)
    return _flip_sign(part * sine, odd), _flip_sign(cosine, odd)


@triton.jit
def _flip_sign(values, sign_bits):
    return (values.to(tl.int32, bitcast=True) ^ sign_bits).to(tl.float32, bitcast=True)


@triton.jit
def look_up(
    u,
    v,
    w,
    tables,
    grids,
    COLUMNS: tl.constexpr,
    KIND: tl.constexpr,
    LEVELS: tl.constexpr,
    FEATURES: tl.constexpr,
    MASK: tl.constexpr,
):
    """Features of a hash grid, of vector-matrix products or of K-planes."""
    u, v, w = u[:, None], v[:, None], w[:, None]
    if KIND == _HASH:
        return _hash_grid(u, v, w, tables, grids, COLUMNS, LEVELS, FEATURES, MASK)
    if KIND == _VM:
        return _vector_matrix(u, v, w, tables, grids, COLUMNS, FEATURES)
    return _planes(u, v, w, tables, grids, COLUMNS, LEVELS, FEATURES)


@triton.jit
def _level(grids, COLUMNS: tl.constexpr, LEVELS: tl.constexpr, FEATURES: tl.constexpr):
    """Of each column: whether it is a feature, its level's size and place, its number there."""
    column = tl.arange(0, COLUMNS)
    there = column < LEVELS * FEATURES
    level = tl.where(there, column // FEATURES, 0)
    size, place = tl.load(grids + 2 * level), tl.load(grids + 2 * level + 1)
    return there[None, :], size[None, :], place[None, :], (column % FEATURES)[None, :]


@triton.jit
def _hash_grid(
    u,
    v,
    w,
    tables,
    grids,
    COLUMNS: tl.constexpr,
    LEVELS: tl.constexpr,
    FEATURES: tl.constexpr,
    MASK: tl.constexpr,
):
    """`HashEncoding`: four rows of a tetrahedron at each level."""
    there, size, place, feature = _level(grids, COLUMNS, LEVELS, FEATURES)
    x, y, z = (u * 0.5 + 0.5) * size, (v * 0.5 + 0.5) * size, (w * 0.5 + 0.5) * size
    i, j, k = tl.floor(x), tl.floor(y), tl.floor(z)
    x, y, z = x - i, y - j, z - k
    at_x, at_y, at_z = i.to(tl.int32), j.to(tl.int32) * _PRIME_Y, k.to(tl.int32) * _PRIME_Z
    first = at_x ^ at_y ^ at_z
    along_x, along_y, along_z = (
        at_x ^ (at_x + 1),
        at_y ^ (at_y + _PRIME_Y),
        at_z ^ (at_z + _PRIME_Z),
    )
    x_over_y, y_over_z, x_over_z = x >= y, y >= z, x >= z
    largest = tl.where(x_over_y & x_over_z, along_x, tl.where(y_over_z, along_y, along_z))
    smallest = tl.where(x_over_z & y_over_z, along_z, tl.where(x_over_y, along_y, along_x))
    last = first ^ along_x ^ along_y ^ along_z
    most, least = tl.maximum(tl.maximum(x, y), z), tl.minimum(tl.minimum(x, y), z)
    middle = x + y + z - most - least
    rows = tables + place * FEATURES + feature
    total = (1.0 - most) * tl.load(rows + (first & MASK) * FEATURES, mask=there, other=0.0)
    row = (first ^ largest) & MASK
    total += (most - middle) * tl.load(rows + row * FEATURES, mask=there, other=0.0)
    row = (last ^ smallest) & MASK
    total += (middle - least) * tl.load(rows + row * FEATURES, mask=there, other=0.0)
    return total + least * tl.load(rows + (last & MASK) * FEATURES, mask=there, other=0.0)


@triton.jit
def _bilinear(table, points, column, row, there):
    """`grid_sample` of a table [points, points] whose ends lie on -1 and 1."""
    x, y = (column + 1.0) * 0.5 * (points - 1), (row + 1.0) * 0.5 * (points - 1)
    i, j = tl.minimum(tl.floor(x), points - 2.0), tl.minimum(tl.floor(y), points - 2.0)
    x, y = x - i, y - j
    at = table + j.to(tl.int32) * points + i.to(tl.int32)
    low = (1.0 - x) * tl.load(at, mask=there, other=0.0)
    low += x * tl.load(at + 1, mask=there, other=0.0)
    high = (1.0 - x) * tl.load(at + points, mask=there, other=0.0)
    high += x * tl.load(at + points + 1, mask=there, other=0.0)
    return (1.0 - y) * low + y * high


@triton.jit
def _vector_matrix(u, v, w, tables, grids, COLUMNS: tl.constexpr, FEATURES: tl.constexpr):
    """`VectorMatrixEncoding`: the planes of all pairs, and behind them their lines."""
    there, points, _, _ = _level(grids, COLUMNS, 1, 3 * FEATURES)
    column = tl.arange(0, COLUMNS)[None, :]
    pair = column // FEATURES
    along, upward = tl.where(pair == 2, v, u), tl.where(pair == 0, v, w)
    across = tl.where(pair == 0, w, tl.where(pair == 1, v, u))
    plane = _bilinear(tables + column * points * points, points, along, upward, there)
    line = tables + 3 * FEATURES * points * points + column * points
    z = (across + 1.0) * 0.5 * (points - 1)
    k = tl.minimum(tl.floor(z), points - 2.0)
    z, at = z - k, line + k.to(tl.int32)
    low = (1.0 - z) * tl.load(at, mask=there, other=0.0)
    return plane * (low + z * tl.load(at + 1, mask=there, other=0.0))


@triton.jit
def _planes(
    u,
    v,
    w,
    tables,
    grids,
    COLUMNS: tl.constexpr,
    LEVELS: tl.constexpr,
    FEATURES: tl.constexpr,
):
    """`KPlanesEncoding`: three planes of each level, multiplied."""
    there, points, place, feature = _level(grids, COLUMNS, LEVELS, FEATURES)
    table, size = tables + place + feature * points * points, FEATURES * points * points
    product = _bilinear(table, points, u, v, there)
    product *= _bilinear(table + size, points, u, w, there)
    return product * _bilinear(table + 2 * size, points, v, w, there)
