"""Where a matrix of answers is true, column by column: how the march packs what it keeps.

Rays are columns and candidates rows, so packed samples are the true entries in the order of
columns. What is kept of a ray lies together: on a CPU, where finding true entries takes longer than
anything else of the march, most runs of rows are passed over at once. Elsewhere each search would
wait for the device, so there is only one.
"""

from __future__ import annotations

import torch
from torch import Tensor

RUN_BITS = 4
RUN = 1 << RUN_BITS
"""Rows of a run: long enough to work on at once, short enough to waste little."""


def by_column(wanted: Tensor) -> tuple[Tensor, Tensor]:
    """Columns and rows of what is true in bool [n, m], int64, by column, then row."""
    n = len(wanted)
    chosen = _true(wanted)
    columns = chosen.div(n, rounding_mode="floor")
    return columns, chosen - columns * n


def places_by_column(wanted: Tensor) -> tuple[Tensor, Tensor]:
    """Columns of what is true in bool [n, m], and its places in the flat matrix, in that order."""
    columns, rows = by_column(wanted)
    return columns, torch.add(columns, rows, alpha=wanted.shape[1])


def places_by_column_in_runs(wanted: Tensor) -> tuple[Tensor, Tensor]:
    """The same, faster on a CPU if few runs of rows are not all false."""
    if wanted.device.type != "cpu":
        return places_by_column(wanted)
    n, m = wanted.shape
    if n % RUN:
        wanted = torch.cat([wanted, wanted.new_zeros(-n % RUN, m)])
    some = wanted.view(torch.uint8).unflatten(0, (-1, RUN)).amax(dim=1)
    columns, runs = by_column(some)
    first = torch.add(columns, runs, alpha=RUN * m)
    places = (first[:, None] + torch.arange(RUN) * m).view(-1)
    chosen = wanted.view(-1).index_select(0, places).nonzero()[:, 0]
    return columns.index_select(0, chosen >> RUN_BITS), places.index_select(0, chosen)


def _true(wanted: Tensor) -> Tensor:
    """Indices of what is true in the transposed matrix; waits for the device."""
    return wanted.T.contiguous().view(-1).nonzero()[:, 0]
