"""nerfstudio's hash encoding on a CPU: the same function of the same table, in fewer passes.

Where tiny-cuda-nn is not installed, nerfstudio computes its hash grids in plain torch, point by
point through all levels; that is most of a CPU's training step. Here `hash_grids.c` computes them
where there is a C compiler. Elsewhere the levels follow one another, so that the part of the table
that is looked up fits a cache, corners are hashed in int32 and summed by one call, and the table's
gradient is a histogram. Names of parameters, their values, and what comes out stay as they are, up
to the order of sums.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import torch
from nerfstudio.field_components.encodings import HashEncoding
from torch import Tensor

from leco_plugin.models.compute.native import has_native, hash_gradients, hash_sums
from leco_plugin.models.encodings import PRIMES, sum_by_row

if TYPE_CHECKING:
    from torch import nn

POINTS_AT_ONCE = 1 << 20
"""A point of 16 levels takes a kilobyte for a while, and `embedding_bag` counts what it looks up in
int32, which wraps around without a word."""


def speed_up_hash_encodings(model: nn.Module) -> None:
    """Puts a `CpuHashEncoding` wherever a model holds one that nerfstudio computes in torch. Names
    in the state dict stay; what else holds the old one shares its table and its hooks."""
    made: dict[nn.Module, CpuHashEncoding] = {}
    for parent in list(model.modules()):
        for name, child in list(parent._modules.items()):
            if type(child) is HashEncoding and child.tcnn_encoding is None:
                fast = made.setdefault(child, CpuHashEncoding.__new__(CpuHashEncoding))
                vars(fast).update(vars(child))
                setattr(parent, name, fast)


class CpuHashEncoding(HashEncoding):
    """`HashEncoding` with another way to compute it; made by `speed_up_hash_encodings`."""

    def pytorch_fwd(self, in_tensor: Tensor) -> Tensor:
        """[..., 3] positions in [0, 1] to [..., levels * features]; differentiable in both. What is
        not float32 on a CPU is left to nerfstudio."""
        table = self.hash_table
        if in_tensor.device.type != "cpu" or {in_tensor.dtype, table.dtype} != {torch.float32}:
            return super().pytorch_fwd(in_tensor)
        parts = in_tensor.reshape(-1, 3).split(POINTS_AT_ONCE)
        flat = torch.cat([_Interpolated.apply(part, table, self) for part in parts])
        return flat.view(*in_tensor.shape[:-1], flat.shape[-1])


class _Interpolated(torch.autograd.Function):
    """Features [N, levels * features] of positions [N, 3]."""

    @staticmethod
    def forward(ctx: Any, positions: Tensor, table: Tensor, encoding: CpuHashEncoding) -> Tensor:
        ctx.encoding = encoding
        if has_native():
            ctx.save_for_backward(positions, table)
            return hash_sums(positions, encoding.scalings, table, corners=8)
        rows, weights = _rows_and_weights(positions, encoding)
        ctx.save_for_backward(positions, table, rows, weights)
        summed = torch.nn.functional.embedding_bag(
            rows, table, per_sample_weights=weights, mode="sum"
        )
        by_level = summed.view(encoding.num_levels, -1, encoding.features_per_level)
        return by_level.transpose(0, 1).flatten(1)

    @staticmethod
    def backward(  # type: ignore[override]
        ctx: Any, gradient: Tensor
    ) -> tuple[Tensor | None, Tensor | None, None]:
        positions, table, *looked_up = ctx.saved_tensors
        encoding: CpuHashEncoding = ctx.encoding
        if torch.is_grad_enabled():  # somebody wants to differentiate the gradient
            encoded = HashEncoding.pytorch_fwd(encoding, positions)  # of which any can be had
            return _gradients(encoded, positions, table, gradient)
        of_positions = of_table = None
        if not looked_up and ctx.needs_input_grad[1]:
            of_table = hash_gradients(positions, encoding.scalings, gradient, len(table), corners=8)
            if not ctx.needs_input_grad[0]:
                return None, of_table, None
        rows, weights = looked_up or _rows_and_weights(positions, encoding)
        by_point = gradient.view(-1, encoding.num_levels, encoding.features_per_level)
        by_level = by_point.transpose(0, 1).flatten(0, 1)
        if ctx.needs_input_grad[0]:
            of_positions = _of_positions(positions, table, rows, by_level, encoding.scalings)
        if ctx.needs_input_grad[1] and of_table is None:
            of_table = sum_by_row(rows, weights, by_level, len(table))
        return of_positions, of_table, None


def _rows_and_weights(positions: Tensor, encoding: HashEncoding) -> tuple[Tensor, Tensor]:
    """Rows of the table that the corners of the cells around positions [N, 3] hash to, int32, and
    their trilinear weights: both [levels * N, 8]."""
    size = len(encoding.scalings), len(positions), 8
    all_rows, all_weights = torch.empty(size, dtype=torch.int32), torch.empty(size)
    primes = torch.tensor(PRIMES, dtype=torch.int32)[:, None]
    levels = zip(encoding.scalings, encoding.hash_offset.tolist(), all_rows, all_weights)
    for scaling, offset, rows, weights in levels:
        low, fractions = _cells(positions, scaling)
        lower = low.to(torch.int32).mul_(primes)
        _at_corners(lower, lower + primes, torch.bitwise_xor, rows)
        rows.bitwise_and_(encoding.hash_table_size - 1).add_(offset)
        _at_corners(1.0 - fractions, fractions, torch.mul, weights)
    return all_rows.view(-1, 8), all_weights.view(-1, 8)


def _cells(positions: Tensor, scaling: Tensor) -> tuple[Tensor, Tensor]:
    """Lower corners and places in them, both [3, N], of positions [N, 3] at one level."""
    scaled = positions.detach().t() * scaling
    low = scaled.floor()
    return low, scaled.sub_(low)


def _at_corners(
    lower: Tensor, upper: Tensor, combine: Callable[[Tensor, Tensor], Tensor], out: Tensor
) -> None:
    """What the sides [3, N] of cells along x, y and z make together at their corners: [N, 8], whose
    last dimension is by sides in y, z and x, lower ones first."""
    x, y, z = zip(lower, upper)
    in_y_and_z = [combine(at_y, at_z) for at_y in y for at_z in z]
    torch.stack([combine(beside, at_x) for beside in in_y_and_z for at_x in x], dim=-1, out=out)


def _of_positions(
    positions: Tensor, table: Tensor, rows: Tensor, gradient: Tensor, scalings: Tensor
) -> Tensor:
    """Gradient [N, 3] of the positions; gradient is [levels * N, features]."""
    columns, size = table.t().contiguous(), len(positions)
    total = torch.zeros(3, size)
    for scaling, *parts in zip(scalings, rows.split(size), gradient.split(size)):
        _, (x, y, z) = _cells(positions, scaling)
        by_x = _worth(columns, *parts).t().reshape(2, 2, 2, size).movedim(2, 0)
        by_y = _between(by_x, x)
        by_z = _between(by_y, y)
        of_x = _between(_between(by_x[1] - by_x[0], y), z)
        of_y = _between(by_y[1] - by_y[0], z)
        of_z = by_z[1] - by_z[0]
        total.addcmul_(torch.stack([of_x, of_y, of_z]), scaling)
    return total.t()


def _between(sides: Tensor, places: Tensor) -> Tensor:
    """What lies between the sides of cells [2, ...], at places in [0, 1] from the lower one."""
    return torch.lerp(sides[0], sides[1], places)


def _worth(columns: Tensor, rows: Tensor, gradient: Tensor) -> Tensor:
    """What the features of each corner, whole, would add to the loss: [N, 8], of columns [features,
    rows] of the table, rows [N, 8] of the corners, and gradients [N, features]."""
    flat, worth = rows.view(-1), torch.zeros(rows.shape)
    for column, of_column in zip(columns, gradient.unbind(dim=-1)):
        worth.addcmul_(column.index_select(0, flat).view_as(rows), of_column[:, None])
    return worth


def _gradients(
    encoded: Tensor, positions: Tensor, table: Tensor, gradient: Tensor
) -> tuple[Tensor | None, Tensor | None, None]:
    """Gradients that can be differentiated again, of what requires one."""
    wanted = [part for part in (positions, table) if part.requires_grad]
    found = iter(torch.autograd.grad(encoded, wanted, gradient, create_graph=True))
    of_positions = next(found) if positions.requires_grad else None
    return of_positions, next(found) if table.requires_grad else None, None
