"""Moving rows of samples about, with backwards that know no row is taken twice.

autograd's own backward of indexing adds rows up, which is several times slower than moving them.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


def permute_rows(rows: Tensor, order: Tensor, inverse: Tensor) -> Tensor:
    """Rows [N, D] in another order; `inverse` undoes `order`, both [N] int64."""
    moved: Tensor = _Permute.apply(rows, order, inverse)
    return moved


def select_rows(rows: Tensor, chosen: Tensor) -> Tensor:
    """Rows [M, D] of [N, D]; the chosen numbers [M] int64 must differ from each other."""
    selected: Tensor = _Select.apply(rows, chosen)
    return selected


class _Permute(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rows: Tensor, order: Tensor, inverse: Tensor) -> Tensor:
        ctx.inverse = inverse
        return rows.index_select(0, order)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        return gradient.index_select(0, ctx.inverse), None, None


class _Select(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rows: Tensor, chosen: Tensor) -> Tensor:
        ctx.chosen, ctx.count = chosen, len(rows)
        return rows.index_select(0, chosen)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        whole = gradient.new_zeros(ctx.count, *gradient.shape[1:])
        return whole.index_copy_(0, ctx.chosen, gradient), None
