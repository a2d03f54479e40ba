"""What is true is found in the order of columns, in runs and without."""

from __future__ import annotations

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from leco_plugin.samplers.marching.columns import (
    RUN,
    by_column,
    places_by_column,
    places_by_column_in_runs,
)


def slow_by_column(wanted) -> list[tuple[int, int]]:
    n, m = wanted.shape
    return [(column, row) for column in range(m) for row in range(n) if wanted[row, column]]


@settings(deadline=None, max_examples=40)
@given(
    n=st.integers(1, 3 * RUN),
    m=st.integers(0, 9),
    share=st.sampled_from([0.0, 0.05, 0.5, 1.0]),
    seed=st.integers(0, 2**16),
)
def test_true_entries_come_by_column_then_row(n, m, share, seed):
    wanted = torch.rand(n, m, generator=torch.Generator().manual_seed(seed)) < share
    expected = slow_by_column(wanted)
    columns, rows = by_column(wanted)
    assert columns.dtype == rows.dtype == torch.int64
    assert list(zip(columns.tolist(), rows.tolist(), strict=True)) == expected
    for function in (places_by_column, places_by_column_in_runs):
        columns, places = function(wanted)
        assert columns.dtype == places.dtype == torch.int64
        assert columns.tolist() == [column for column, _ in expected]
        assert places.tolist() == [row * m + column for column, row in expected]
