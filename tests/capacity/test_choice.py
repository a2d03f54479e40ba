"""Claims about what a scene is said to need."""

from __future__ import annotations

from typing import Any

import pytest

from leco_plugin.capacity.choice import choose, common_volume, kilobytes, smallest_grid, verdict
from leco_plugin.capacity.measuring import VOLUMES


def row(family: str, size: str, bytes: int, kept: float) -> dict[str, Any]:
    lost = [0.02 / (1 + i) for i in range(len(VOLUMES))]
    found = {"family": family, "size": size, "bytes": bytes, "kept_volume": kept}
    return found | {"lost_at_volumes": lost}


LARGE_GATE = row("hash", "8-16", 2_000_000, 0.060)
SMALL_GATE = row("frequency", "5-16-2", 3_000, 0.062)
COARSE, FINE = row("grid", "32", 4_096, 0.15), row("grid", "256", 2_097_152, 0.0625)


def test_fewest_bytes_among_those_that_keep_as_little() -> None:
    rows = [LARGE_GATE, SMALL_GATE, COARSE, FINE]
    assert choose(rows) is SMALL_GATE
    assert smallest_grid(rows, SMALL_GATE) is FINE
    said = verdict(rows)
    assert "gate on frequencies of 3.0 kB" in said and "256^3 cells, 699 times" in said


def test_a_grid_that_suffices_is_named() -> None:
    enough = row("grid", "16", 512, 0.061)
    assert choose([SMALL_GATE, LARGE_GATE, enough, FINE]) is enough
    assert verdict([SMALL_GATE, LARGE_GATE, enough, FINE]).startswith("A grid suffices: 16^3 cells")


def test_grids_that_never_keep_as_little_are_named() -> None:
    assert "No grid up to 32^3" in verdict([SMALL_GATE, COARSE])
    assert "grid" not in verdict([SMALL_GATE])


def test_losses_are_compared_at_about_the_volume_of_the_chosen_one() -> None:
    assert VOLUMES[common_volume([SMALL_GATE, COARSE])] == pytest.approx(0.062, rel=0.2)
    assert kilobytes(FINE) == "2.1 MB"
