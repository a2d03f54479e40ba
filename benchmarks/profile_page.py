"""The part of `docs/measurements.md` that says where the time of a step goes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from page_parts import machine_line, made_line, table

PARTS = (
    *("data", "candidates", "sampling", "gate", "encoding", "experts", "field", "colour"),
    *("weights", "front to back", "loss", "optimizer", "rest"),
)
"""In the order of a step; others stand behind them."""
BUSY = 0.5
"""Mean processes that ran when it began, from which on figures are not to be trusted."""
VIEW = 480 * 360
"""Pixels of the view that rendering is told of."""


def profile_sections(report: dict[str, Any]) -> list[str]:
    """What was profiled, a table for each scene and method."""
    rows = [row for methods in report["scenes"].values() for row in methods.values()]
    parts = [
        "## Where the time of a step goes\n",
        "`python benchmarks/profile_steps.py --data SCENE --methods METHOD ...`; "
        f"{machine_line(report)}. Rows {made_line(rows)}.\n",
        "Milliseconds of a training step, forward + backward, and of a rendered view of 480 x 360. "
        "A backward operation belongs to the part whose forward has made its node. The *floor* is "
        "what a part's bytes and operations take at the speed at which this machine copies and "
        "multiplies matrices, each value moved once: a part far above its floor has room. "
        "What fits a cache may be faster. *Front to back* is one routine in C for encoding, "
        "experts, colour and weights of a view.\n",
    ]
    for scene, methods in report["scenes"].items():
        for method, row in methods.items():
            parts += [f"### {method} on {scene}\n", f"{_sentence(row)}\n", *_table(row), ""]
    return parts


def _phases(row: dict[str, Any]) -> list[str]:
    return [phase for phase in ("learning", "guided", "rendering") if phase in row]


def _sentence(row: dict[str, Any]) -> str:
    """Which two parts take most of a guided step, and what the machine can do."""
    guided = row["guided"]
    taken = {part: each["forward"] + each["backward"] for part, each in guided["parts"].items()}
    first, second = sorted(taken, key=lambda part: -taken[part])[:2]
    share = (taken[first] + taken[second]) / guided["ms"]
    back = sum(each["backward"] for each in guided["parts"].values()) / guided["ms"]
    speed = row["ceilings"]
    busy = ""
    if row["load"] >= BUSY:
        busy = f" **Other processes ran meanwhile (load {row['load']}): times are too long.**"
    return (
        f"{first.capitalize()} and {second} take {share:.0%} of a guided step, the backward pass "
        f"{back:.0%}. A test view is rendered at {row['rendering']['rays_a_second']:,} rays a "
        f"second: {VIEW / row['rendering']['rays_a_second']:.3g} s for 480 x 360. The machine "
        f"copies at {speed['bytes_per_second'] / 1e9:.3g} GB/s and multiplies matrices at "
        f"{speed['operations_per_second'] / 1e9:.3g} GFLOP/s.{busy}"
    )


def _table(row: dict[str, Any]) -> list[str]:
    phases = _phases(row)
    header = " | ".join(["part", *(f"{phase} | floor" for phase in phases)])
    return table(header, _rows(row, phases))


def _rows(row: dict[str, Any], phases: list[str]) -> Iterator[list[str]]:
    scales = {phase: 1.0 for phase in phases} | {"rendering": VIEW / row["rendering"]["rays"]}
    there = [part for phase in phases for part in row[phase]["parts"]]
    for part in dict.fromkeys([*(part for part in PARTS if part in there), *there]):
        cells = [part]
        for phase in phases:
            each = row[phase]["parts"].get(part)
            cells += ["-", "-"] if each is None else _cells(each, scales[phase])
        yield cells
    totals = {phase: row[phase]["ms"] * scales[phase] for phase in phases}
    yield ["all", *(cell for ms in totals.values() for cell in (f"**{ms:,.0f}**", ""))]
    unprofiled = [row[phase].get("unprofiled_ms") for phase in phases]
    shown = ("-" if ms is None else f"{ms:,.0f}" for ms in unprofiled)
    yield ["without the profiler", *(cell for ms in shown for cell in (ms, ""))]
    for name in ("rays", "samples"):
        counts = (row[phase][name] * scales[phase] for phase in phases)
        yield [name, *(cell for count in counts for cell in (f"{count:,.0f}", ""))]


def _cells(each: dict[str, float], scale: float) -> list[str]:
    """Time and floor of one part: forward, and backward where there is any."""
    cells = []
    for names in (("forward", "backward"), ("forward_floor", "backward_floor")):
        values = [each[name] * scale for name in names]
        cells.append(" + ".join(_digits(value) for value in values if value) or "-")
    return cells


def _digits(ms: float) -> str:
    """Three digits at most, none of them behind a hundredth."""
    return f"{ms:,.0f}" if ms >= 100 else f"{ms:.1f}" if ms >= 10 else f"{ms:.2f}"
