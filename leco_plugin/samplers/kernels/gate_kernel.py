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

from leco_plugin.samplers.kernels.encoding_kernel import frequencies, look_up
from leco_plugin.samplers.kernels.gate_weights import FREQUENCY, GateWeights
from leco_plugin.seen import CELLS

INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"
"""Whether kernels run in Triton's interpreter; decided when Triton was imported."""

_INTERPRETED, _FREQUENCY = tl.constexpr(INTERPRETED), tl.constexpr(FREQUENCY)
_CELLS = tl.constexpr(CELLS)


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
    features,
    matrices,
    sums,
    ROWS: tl.constexpr,
    IN: tl.constexpr,
    OUT: tl.constexpr,
    HALF: tl.constexpr,
):
    """sums + features [ROWS, IN] times a matrix [IN, OUT], 64 rows of which are held at a time."""
    if IN == 256:
        low, high = _halves(features, ROWS, IN)
        sums = _half_layer(low, matrices, sums, ROWS, IN // 2, OUT, HALF)
        return _half_layer(high, matrices + IN // 2 * OUT, sums, ROWS, IN // 2, OUT, HALF)
    return _half_layer(features, matrices, sums, ROWS, IN, OUT, HALF)


@triton.jit
def _half_layer(
    features,
    matrices,
    sums,
    ROWS: tl.constexpr,
    IN: tl.constexpr,
    OUT: tl.constexpr,
    HALF: tl.constexpr,
):
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
    x,
    y,
    z,
    facts,
    matrices,
    vectors,
    tables,
    grids,
    seen,
    ROWS: tl.constexpr,
    KIND: tl.constexpr,
    OCTAVES: tl.constexpr,
    LEVELS: tl.constexpr,
    FEATURES: tl.constexpr,
    MASK: tl.constexpr,
    COLUMNS: tl.constexpr,
    WIDTH: tl.constexpr,
    PADDED_WIDTH: tl.constexpr,
    LAYERS: tl.constexpr,
    LOGITS: tl.constexpr,
    PADDED_LOGITS: tl.constexpr,
    CONTRACTED: tl.constexpr,
    HALF: tl.constexpr,
):
    """The gate's decisions about positions [ROWS]."""
    u, v, w, inside = map_position(x, y, z, facts, CONTRACTED)
    u, v, w = tl.where(inside, u, 0.0), tl.where(inside, v, 0.0), tl.where(inside, w, 0.0)
    u, v, w = _once(u), _once(v), _once(w)
    inside &= _seen_at(u, v, w, seen)

    sums = tl.zeros((ROWS, PADDED_WIDTH), tl.float32)
    if KIND == _FREQUENCY:
        features, cosines = frequencies(u, v, w, OCTAVES, COLUMNS)
        sums = _layer(cosines, matrices, sums, ROWS, COLUMNS, PADDED_WIDTH, HALF)
        matrices += COLUMNS * PADDED_WIDTH
    else:
        features = look_up(u, v, w, tables, grids, COLUMNS, KIND, LEVELS, FEATURES, MASK)
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
    positions,
    kept,
    count,
    row_stride,
    column_stride,
    facts,
    matrices,
    vectors,
    tables,
    grids,
    seen,
    ROWS: tl.constexpr,
    KIND: tl.constexpr,
    OCTAVES: tl.constexpr,
    LEVELS: tl.constexpr,
    FEATURES: tl.constexpr,
    MASK: tl.constexpr,
    COLUMNS: tl.constexpr,
    WIDTH: tl.constexpr,
    PADDED_WIDTH: tl.constexpr,
    LAYERS: tl.constexpr,
    LOGITS: tl.constexpr,
    PADDED_LOGITS: tl.constexpr,
    CONTRACTED: tl.constexpr,
    HALF: tl.constexpr,
):
    rows = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS)
    there = rows < count
    column_stride = column_stride.to(tl.int64)  # twice it is a billion positions' worth
    at = positions + rows * row_stride
    x = tl.load(at, mask=there, other=0.0)
    y = tl.load(at + column_stride, mask=there, other=0.0)
    z = tl.load(at + 2 * column_stride, mask=there, other=0.0)
    keep = gate_keeps(
        x,
        y,
        z,
        facts,
        matrices,
        vectors,
        tables,
        grids,
        seen,
        ROWS,
        KIND,
        OCTAVES,
        LEVELS,
        FEATURES,
        MASK,
        COLUMNS,
        WIDTH,
        PADDED_WIDTH,
        LAYERS,
        LOGITS,
        PADDED_LOGITS,
        CONTRACTED,
        HALF,
    )
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
