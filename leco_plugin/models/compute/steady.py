"""Numbers of rows that come again: on a CPU, a new one is compiled for.

oneDNN makes a half-precision product anew for every number of rows that it has not met, which takes
longer than the product of ten thousand rows. Samples are therefore filled up to one of few sizes.
"""

from __future__ import annotations

import torch
from torch import Tensor

SIZES_PER_OCTAVE = 16
"""Steady sizes between a power of two and the next: on average 3% of the rows are filling."""


def steady_size(count: int, device_type: str) -> int:
    """How many rows to compute for `count` of them: a few more where that saves compiling."""
    if device_type != "cpu" or not torch.is_autocast_enabled("cpu"):
        return count
    return filled_size(count)


def filled_size(count: int) -> int:
    """The least of the few sizes that is no less than `count`."""
    step = max(1, 2 ** max(count - 1, 0).bit_length() // (2 * SIZES_PER_OCTAVE))
    return -(-count // step) * step


def steadied(rows: Tensor) -> Tensor:
    """Rows [N, ...] with rows of zeros behind them, up to the steady size; to be cut off again."""
    missing = steady_size(len(rows), rows.device.type) - len(rows)
    if missing == 0:
        return rows
    return torch.cat([rows, rows.new_zeros(missing, *rows.shape[1:])])
