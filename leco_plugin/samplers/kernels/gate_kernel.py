"""The fused gate: positions to keep or skip in one Triton kernel.

Its torch twin is `occupancy.Occupancy.occupied`. Imported by `fused.py` only where a kernel can
run: on CUDA, or in Triton's interpreter. Between positions and bits nothing reaches memory.
"""

from __future__ import annotations

import os

import torch
import triton
import triton.language as tl
from torch import Tensor

from leco_plugin.samplers.kernels.gate_weights import GateWeights
from leco_plugin.seen import CELLS

INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"
"""Whether kernels run in Triton's interpreter; decided when Triton was imported."""

_INTERPRETED = tl.constexpr(INTERPRETED)
_CELLS = tl.constexpr(CELLS)
_ROUNDING = tl.constexpr(1.5 * 2**23)
"""Added to a number below 2^22 it leaves the nearest whole one, whose last bit says whether it is
odd; rounding instructions run at an eighth of the rate of additions."""


@triton.jit
def map_position(x, y, z, facts, CONTRACTED: tl.constexpr):
    """`Space.map` of positions, and whether they lie in the cube and the walls."""
    half_extent = tl.load(facts + 3)
    u = tl.div_rn(x - tl.load(facts), half_extent)
    v = tl.div_rn(y - tl.load(facts + 1), half_extent)
    w = tl.div_rn(z - tl.load(facts + 2), half_extent)
    if CONTRACTED:
        outside = tl.maximum(largest_of(u, v, w), 1.0)
        factor = 2.0 - tl.div_rn(1.0, outside)
        u = tl.div_rn(u * factor, outside) * 0.5
        v = tl.div_rn(v * factor, outside) * 0.5
        w = tl.div_rn(w * factor, outside) * 0.5
    # each comparison is false for NaN, which the largest of the three need not be
    inside = (tl.abs(u) <= 1.0) & (tl.abs(v) <= 1.0) & (tl.abs(w) <= 1.0)
    inside &= (x >= tl.load(facts + 4)) & (x <= tl.load(facts + 7))
    inside &= (y >= tl.load(facts + 5)) & (y <= tl.load(facts + 8))
    inside &= (z >= tl.load(facts + 6)) & (z <= tl.load(facts + 9))
    return u, v, w, inside


@triton.jit
def largest_of(u, v, w):
    """Maximum norm."""
    return tl.maximum(tl.maximum(tl.abs(u), tl.abs(v)), tl.abs(w))


@triton.jit
def _seen_at(u, v, w, seen):
    """`SeenSpace.forward` of mapped positions in the cube."""
    last: tl.constexpr = _CELLS - 1.0
    i = tl.minimum((u + 1.0) * (0.5 * _CELLS), last).to(tl.int32)
    j = tl.minimum((v + 1.0) * (0.5 * _CELLS), last).to(tl.int32)
    k = tl.minimum((w + 1.0) * (0.5 * _CELLS), last).to(tl.int32)
    return tl.load(seen + (i * _CELLS + j) * _CELLS + k) != 0


@triton.jit
def _frequencies(u, v, w, OCTAVES: tl.constexpr, COLUMNS: tl.constexpr):
    """`FrequencyEncoding`: sines, behind them the coordinates; and cosines.

    A tile holds a feature of a position at each place, [ROWS, COLUMNS]; columns beyond the features
    are padding, which the rows of the first matrix beyond them, all zero, leave without effect.
    """
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
    """sin(pi y) and cos(pi y), to 1e-7.

    They come from y = 2^k x, reduced to a quarter turn without rounding, and a polynomial; the twin
    rounds its angles, by up to 2^(k - 23), and that is how far they differ.
    """
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
def _once(values):
    """The same values, hidden from the compiler so that it does not compute them again.

    Otherwise every thread that needs a position would map it for itself, with seven divisions.
    """
    if _INTERPRETED:
        return values
    return tl.inline_asm_elementwise(
        "mov.b32 $0, $1;", "=r,r", [values], dtype=tl.float32, is_pure=False, pack=1
    )


@triton.jit
def _multiply(features, matrix, sums, HALF: tl.constexpr):
    """sums + features matrix, with the features rounded to the type of the matrix."""
    if HALF:
        features = features.to(tl.bfloat16)
        if _INTERPRETED:  # the interpreter of Triton 3.9 would multiply the bits of bfloat16
            features, matrix = features.to(tl.float32), matrix.to(tl.float32)
    return tl.dot(features, matrix, sums, input_precision="ieee")


@triton.jit
def _load(matrices, ROWS: tl.constexpr, COLUMNS: tl.constexpr):
    rows, columns = tl.arange(0, ROWS), tl.arange(0, COLUMNS)
    return tl.load(matrices + rows[:, None] * COLUMNS + columns[None, :])


@triton.jit
def _halves(features, ROWS: tl.constexpr, COLUMNS: tl.constexpr):
    """The first and the second half of the columns."""
    halves = tl.reshape(features, (ROWS, 2, COLUMNS // 2))
    return tl.split(tl.permute(halves, (0, 2, 1)))


@triton.jit
def _layer(
    features, matrices, sums,
    ROWS: tl.constexpr, IN: tl.constexpr, OUT: tl.constexpr, HALF: tl.constexpr,
):  # fmt: skip
    """sums + features [ROWS, IN] times a matrix [IN, OUT], 64 rows of which are held at a time."""
    if IN == 256:
        low, high = _halves(features, ROWS, IN)
        sums = _half_layer(low, matrices, sums, ROWS, IN // 2, OUT, HALF)
        return _half_layer(high, matrices + IN // 2 * OUT, sums, ROWS, IN // 2, OUT, HALF)
    return _half_layer(features, matrices, sums, ROWS, IN, OUT, HALF)


@triton.jit
def _half_layer(
    features, matrices, sums,
    ROWS: tl.constexpr, IN: tl.constexpr, OUT: tl.constexpr, HALF: tl.constexpr,
):  # fmt: skip
    if IN == 128:
        low, high = _halves(features, ROWS, IN)
        sums = _multiply(low, _load(matrices, IN // 2, OUT), sums, HALF)
        return _multiply(high, _load(matrices + IN // 2 * OUT, IN // 2, OUT), sums, HALF)
    return _multiply(features, _load(matrices, IN, OUT), sums, HALF)


@triton.jit
def _activate(sums, biases, WIDTH: tl.constexpr, HALF: tl.constexpr):
    """Bias and ReLU; rounded where the twin's layer answers in bfloat16."""
    hidden = tl.maximum(sums + tl.load(biases + tl.arange(0, WIDTH))[None, :], 0.0)
    return hidden.to(tl.bfloat16).to(tl.float32) if HALF else hidden


@triton.jit
def _norm(hidden, epsilon, WIDTH: tl.constexpr, PADDED_WIDTH: tl.constexpr):
    """Means of the layer norm, and the reciprocals of its deviations."""
    mean = tl.sum(hidden, axis=1) / WIDTH
    real = (tl.arange(0, PADDED_WIDTH) < WIDTH)[None, :]
    centred = tl.where(real, hidden - mean[:, None], 0.0)
    return mean, tl.rsqrt(tl.sum(centred * centred, axis=1) / WIDTH + epsilon)


@triton.jit
def gate_keeps(
    x, y, z, facts, matrices, vectors, seen,
    ROWS: tl.constexpr, OCTAVES: tl.constexpr, COLUMNS: tl.constexpr, WIDTH: tl.constexpr,
    PADDED_WIDTH: tl.constexpr, LAYERS: tl.constexpr, LOGITS: tl.constexpr,
    PADDED_LOGITS: tl.constexpr, CONTRACTED: tl.constexpr, HALF: tl.constexpr,
):  # fmt: skip
    """The gate's decisions about positions [ROWS]."""
    u, v, w, inside = map_position(x, y, z, facts, CONTRACTED)
    u, v, w = tl.where(inside, u, 0.0), tl.where(inside, v, 0.0), tl.where(inside, w, 0.0)
    u, v, w = _once(u), _once(v), _once(w)
    inside &= _seen_at(u, v, w, seen)

    sums = tl.zeros((ROWS, PADDED_WIDTH), tl.float32)
    features, cosines = _frequencies(u, v, w, OCTAVES, COLUMNS)
    sums = _layer(cosines, matrices, sums, ROWS, COLUMNS, PADDED_WIDTH, HALF)
    matrices += COLUMNS * PADDED_WIDTH
    sums = _layer(features, matrices, sums, ROWS, COLUMNS, PADDED_WIDTH, HALF)
    matrices += COLUMNS * PADDED_WIDTH
    hidden = _activate(sums, vectors, PADDED_WIDTH, HALF)
    vectors += PADDED_WIDTH
    for _ in tl.static_range(LAYERS - 1):
        sums = tl.zeros((ROWS, PADDED_WIDTH), tl.float32)
        sums = _layer(hidden, matrices, sums, ROWS, PADDED_WIDTH, PADDED_WIDTH, HALF)
        matrices += PADDED_WIDTH * PADDED_WIDTH
        hidden = _activate(sums, vectors, PADDED_WIDTH, HALF)
        vectors += PADDED_WIDTH

    mean, spread = _norm(hidden, tl.load(facts + 11), WIDTH, PADDED_WIDTH)
    sums = tl.zeros((ROWS, PADDED_LOGITS), tl.float32)
    sums = _layer(hidden, matrices, sums, ROWS, PADDED_WIDTH, PADDED_LOGITS, HALF)
    if HALF:
        matrices += PADDED_WIDTH * PADDED_LOGITS
        sums = _layer(hidden, matrices, sums, ROWS, PADDED_WIDTH, PADDED_LOGITS, HALF)
    number = tl.arange(0, PADDED_LOGITS)
    totals = tl.load(vectors + number)[None, :]
    constants = tl.load(vectors + PADDED_LOGITS + number)[None, :]
    logits = (sums - mean[:, None] * totals) * spread[:, None] + constants
    return tl.where(inside, _occupancy(logits, number[None, :], LOGITS), 0.0) >= tl.load(facts + 10)


@triton.jit
def _occupancy(logits, number, LOGITS: tl.constexpr):
    """`gate.occupancy_from_logits`; no exponential overflows."""
    scene = tl.where((number > 0) & (number < LOGITS), logits, float("-inf"))
    highest = tl.max(scene, axis=1)
    total = tl.sum(tl.exp(scene - highest[:, None]), axis=1)
    empty = tl.sum(tl.where(number == 0, logits, 0.0), axis=1)
    logit = tl.log(total) + highest - empty
    small = tl.exp(-tl.abs(logit))
    return tl.where(logit >= 0.0, 1.0, small) / (1.0 + small)


@triton.jit(do_not_specialize=["count", "column_stride"])  # else a compilation for every kind
def _gate_kernel(
    positions, kept, count, row_stride, column_stride, facts, matrices, vectors, seen,
    ROWS: tl.constexpr, OCTAVES: tl.constexpr, COLUMNS: tl.constexpr, WIDTH: tl.constexpr,
    PADDED_WIDTH: tl.constexpr, LAYERS: tl.constexpr, LOGITS: tl.constexpr,
    PADDED_LOGITS: tl.constexpr, CONTRACTED: tl.constexpr, HALF: tl.constexpr,
):  # fmt: skip
    rows = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS)
    there = rows < count
    column_stride = column_stride.to(tl.int64)  # twice it is a billion positions' worth
    at = positions + rows * row_stride
    x = tl.load(at, mask=there, other=0.0)
    y = tl.load(at + column_stride, mask=there, other=0.0)
    z = tl.load(at + 2 * column_stride, mask=there, other=0.0)
    keep = gate_keeps(
        x, y, z, facts, matrices, vectors, seen, ROWS, OCTAVES, COLUMNS, WIDTH, PADDED_WIDTH,
        LAYERS, LOGITS, PADDED_LOGITS, CONTRACTED, HALF,
    )  # fmt: skip
    tl.store(kept + rows, keep.to(tl.uint8), mask=there)


def gate_decisions(weights: GateWeights, positions: Tensor) -> Tensor:
    """Which positions the gate keeps, in one launch.

    Args:
        weights: as `gate_weights` packs them.
        positions: float32 [N, 3] of any strides, scene units, on the device of the weights.

    Returns:
        bool [N], as `Occupancy.occupied` answers but for positions near the threshold.
    """
    kept = torch.empty(len(positions), dtype=torch.uint8, device=positions.device)
    if len(positions):
        rows = 32 if not weights.half else 64 if weights.padded_width > 64 else 128
        many_warps = weights.padded_width > 128 or not weights.half
        _gate_kernel[(triton.cdiv(len(positions), rows),)](
            positions,
            kept,
            len(positions),
            *positions.stride(),
            *weights.values,
            ROWS=rows,
            **weights.sizes,
            num_warps=8 if many_warps else 4,
            enable_fp_fusion=False,
        )
    return kept.view(torch.bool)
