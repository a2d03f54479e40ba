"""The arithmetic of `growth.py`: exponents, and the grid that keeps as little as a gate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

GROWING = ("gate_bytes", "grid_bytes", "seconds", "grid_seconds")


def slope(sizes: Sequence[float], values: Sequence[float | None]) -> float | None:
    """The exponent p of values ~ sizes^p by least squares in logarithms; None from one value."""
    pairs = [(math.log(s), math.log(v)) for s, v in zip(sizes, values) if v is not None and v > 0]
    if len({size for size, _ in pairs}) < 2:
        return None
    middle_x = sum(x for x, _ in pairs) / len(pairs)
    middle_y = sum(y for _, y in pairs) / len(pairs)
    across = sum((x - middle_x) * (y - middle_y) for x, y in pairs)
    return across / sum((x - middle_x) ** 2 for x, _ in pairs)


def grid_for(volume: float, grids: Sequence[dict[str, Any]]) -> dict[str, Any] | None:
    """The smallest of the measured grids that keeps no more than this share of the volume."""
    enough = [row for row in grids if row["kept_reached_volume"] <= volume]
    return min(enough, key=lambda row: row["bytes"], default=None)


def bytes_for(volume: float, grids: Sequence[dict[str, Any]]) -> float | None:
    """Bytes of the grid that keeps this share of the volume, between those measured.

    Interpolated in logarithms between the next grid and, of those with fewer bytes, the one that
    keeps least: a single cell that must not be lost can make a grid in between keep nearly all.
    None where no grid keeps so little; the smallest grid's bytes where all do.
    """
    more = grid_for(volume, grids)
    if more is None:
        return None
    coarser = [row for row in grids if row["bytes"] < more["bytes"]]
    if not coarser:
        return float(more["bytes"])
    less = min(coarser, key=lambda row: row["kept_reached_volume"])
    span = math.log(less["kept_reached_volume"] / max(more["kept_reached_volume"], 1e-9))
    along = math.log(less["kept_reached_volume"] / max(volume, 1e-9)) / span
    low, high = math.log(less["bytes"]), math.log(more["bytes"])
    return math.exp(low + along * (high - low))


def exponents(
    rows: Sequence[dict[str, Any]], with_what: str
) -> dict[str, dict[str, float | list[float] | None]]:
    """Growth of each figure with a column of the rows: over all of them, and for each seed."""

    def of(some: Sequence[dict[str, Any]], name: str) -> float | None:
        return slope([row[with_what] for row in some], [row[name] for row in some])

    seeds = sorted({row["seed"] for row in rows})
    found: dict[str, dict[str, float | list[float] | None]] = {}
    for name in GROWING:
        each = [of([row for row in rows if row["seed"] == seed], name) for seed in seeds]
        found[name] = {"all": of(rows, name), "each": [one for one in each if one is not None]}
    return found
