"""Which representation a scene needs, and the sentence that says so."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from leco_plugin.capacity.measuring import VOLUMES

TOLERANCE = 1.05
"""Kept volume that counts as no more than another's."""
TOLD_APART = 1.2
"""Times the kept volume from which on another certainly keeps more: all is measured with one field
and one seed."""
WORTH_TEN_TIMES = 2 / 3
"""Of the kept volume: what ten times the bytes must leave at most, to be worth them. The largest
nearly always keep a little less, and a scene would need whatever is the last to be tried."""
USUAL_GRID = 128
"""Cells along an axis of the grids that hosts have by default: what any of them can afford."""
NAMES = {
    "frequency": "gate on frequencies",
    "hash": "gate on a hash grid",
    "vm": "gate on TensoRF's products",
    "k-planes": "gate on K-planes",
    "grid": "occupancy grid",
}


def choose(rows: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
    """The one beside which no other keeps so much less at the same loss that its bytes pay."""
    power = -math.log10(WORTH_TEN_TIMES)
    return min(rows, key=lambda row: (row["kept_volume"] * row["bytes"] ** power, row["bytes"]))


def smallest_grid(
    rows: Sequence[Mapping[str, Any]], chosen: Mapping[str, Any], times: float = TOLERANCE
) -> Mapping[str, Any] | None:
    """The smallest grid that keeps no more than so many times what was chosen; None where none
    does."""
    limit = times * chosen["kept_volume"]
    enough = [row for row in rows if row["family"] == "grid" and row["kept_volume"] <= limit]
    return min(enough, key=lambda row: row["bytes"], default=None)


def grid_that_suffices(rows: Sequence[Mapping[str, Any]]) -> Mapping[str, Any] | None:
    """A grid of a usual size that keeps no more than what was chosen; None where none does."""
    grid = smallest_grid(rows, choose(rows))
    return grid if grid is not None and int(grid["size"]) <= USUAL_GRID else None


def grid_that_nearly_suffices(rows: Sequence[Mapping[str, Any]]) -> Mapping[str, Any] | None:
    """A grid of a usual size that keeps more, but not so much that one field tells them apart."""
    if grid_that_suffices(rows) is not None:
        return None
    grid = smallest_grid(rows, choose(rows), TOLD_APART)
    return grid if grid is not None and int(grid["size"]) <= USUAL_GRID else None


def verdict(rows: Sequence[Mapping[str, Any]]) -> str:
    """What the scene needs, in a sentence or two."""
    chosen = choose(rows)
    kept = f"keeps {chosen['kept_volume']:.1%} of the volume"
    if chosen["family"] == "grid":
        return f"A grid suffices: {_of_cells(chosen)}, {kept}; no gate keeps as little for less."
    gate = f"a {NAMES[chosen['family']]} {kept}"
    said = f"This scene needs {kilobytes(chosen)}: {gate}."
    if not any(row["family"] == "grid" for row in rows):
        return said
    nearly = grid_that_nearly_suffices(rows)
    if nearly is not None:
        return (
            f"{said} A grid of {_of_cells(nearly)}, keeps {nearly['kept_volume']:.1%}: with one "
            "field the two are not told apart, and a grid may suffice."
        )
    grid = smallest_grid(rows, chosen)
    if grid is None:
        finest = max((int(row["size"]) for row in rows if row["family"] == "grid"), default=0)
        return f"{said} No grid up to {finest}^3 keeps as little."
    if grid_that_suffices(rows) is not None:
        return f"A grid suffices: {_of_cells(grid)}. With {kilobytes(chosen)} {gate}, as little."
    return (
        f"{said} A grid that keeps as little takes {grid['size']}^3 cells, "
        f"{grid['bytes'] / chosen['bytes']:.0f} times as many bytes."
    )


def _of_cells(grid: Mapping[str, Any]) -> str:
    return f"{grid['size']}^3 cells, {kilobytes(grid)}"


def common_volume(rows: Sequence[Mapping[str, Any]]) -> int:
    """Number of the volume of `VOLUMES` at which losses are compared: what the chosen one keeps."""
    kept = choose(rows)["kept_volume"]
    return min(range(len(VOLUMES)), key=lambda i: abs(VOLUMES[i] / kept - 1.0))


def kilobytes(row: Mapping[str, Any]) -> str:
    """Bytes as they are read."""
    size = row["bytes"]
    return f"{size / 1000:.1f} kB" if size < 1e6 else f"{size / 1e6:.1f} MB"
