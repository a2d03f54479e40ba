"""The verdict on automatic bounds."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "benchmarks"))

from bounds import verdict


@pytest.mark.parametrize(("automatic", "reached"), [(20.0, True), (19.8, False), (19.91, True)])
def test_automatic_bounds_may_lose_a_tenth_of_a_decibel_to_the_best_pair(
    automatic: float, reached: bool
) -> None:
    rows = [
        {"range": range_, "psnr": psnr + spread}
        for range_, psnr in (([0.1, 2.0], 20.0), ([0.1, 9.0], 17.0), (None, automatic))
        for spread in (-0.5, 0.5)
    ]
    found = verdict(rows)
    assert found["best_by_hand"] == pytest.approx(20.0)
    assert found["reached"] is reached
