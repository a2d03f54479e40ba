"""Tables of what was measured for large scenes: growth, bounds and photographs on disk."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

Report = dict[str, Any]


def growth_table(report: Report) -> str:
    """A row a city; the exponents of growth below, and whether the gates were large enough."""
    lines = [
        "| blocks a side (seed) | built, m2 | photographs | gate, kB | grid, kB | volume kept, % "
        "| learned in, s | steps | grid filled in, s | held-out PSNR |",
        "|" + "---|" * 10,
    ]
    for row in report["rows"]:
        largest = max((grid["bytes"] for grid in row["grids"]), default=0)
        grid = f"over {largest / 1000:.0f}" if row["grid_bytes"] is None else _kb(row["grid_bytes"])
        lines.append(
            f"| {row['blocks']} ({row['seed']}) | {row['area_square_metres']:,.0f} "
            f"| {row['photographs']} | {_kb(row['gate_bytes'])} | {grid} "
            f"| {100 * row['kept_reached_volume']:.1f} "
            f"| {_or_dash(row['seconds'], '.0f')} | {row['steps']} of {row['schedule']} "
            f"| {_or_dash(row['grid_seconds'], '.1f')} | {row['psnr_held_out']:.1f} dB |"
        )
    lines += [
        "",
        "| grows as a power of (each seed) | gate's bytes, by construction | grid's bytes "
        "| learning the gate, s | filling the grid, s |",
        "|" + "---|" * 5,
    ]
    for what in ("area", "volume"):
        found = report[f"exponents_with_{what}"]
        cells = (_exponent(value, name, report["rows"]) for name, value in found.items())
        lines.append(f"| {what} | {' | '.join(cells)} |")
    gate = report["exponents_with_area"]["gate_bytes"]["all"]
    unlearned = [f"{row['blocks']} ({row['seed']})" for row in report["rows"] if not row["learned"]]
    if gate is not None:
        enough = "**no**" if unlearned else "yes"
        lines += [
            "",
            "The gate's size is a rule and no finding: by construction its bytes grow as the area "
            f"to the {gate:.2f}. Measured is whether such a gate learns each city: {enough}.",
        ]
    if unlearned:
        lines += ["", f"Not learned in any schedule: {', '.join(unlearned)} blocks a side."]
    return "\n".join(lines)


def _exponent(found: dict[str, Any], name: str, rows: list[dict[str, Any]]) -> str:
    """An exponent, and of how many rows it is where some have no figure."""
    if found["all"] is None:
        return "-"
    each = ", ".join(f"{one:.2f}" for one in found["each"])
    known = sum(bool(row[name]) for row in rows)
    of = "" if known == len(rows) else f", of {known} of {len(rows)} rows"
    return f"{found['all']:.2f} ({each}){of}"


def bounds_table(report: Report) -> str:
    """A row for each way to set near and far, and the verdict."""
    lines = ["| near and far | rays cut at planes | PSNR, mean (each seed) |", "|---|---|---|"]
    groups: dict[tuple[str, bool], list[Any]] = {}
    for run in report["runs"]:
        name = "automatic" if run["range"] is None else "{:g} to {:g}".format(*run["range"])
        groups.setdefault((name, run["planes"]), []).append(run["psnr"])
    for (name, planes), values in groups.items():
        figures = "failed"
        if None not in values:
            each = ", ".join(f"{value:.2f}" for value in values)
            figures = f"{statistics.fmean(values):.2f} dB ({each})"
        lines.append(f"| {name} | {'yes' if planes else 'no'} | {figures} |")
    lines += [
        "",
        "| by hand | best | automatic | reached: at most 0.1 dB below "
        "| automatic against the best pair |",
        "|---|---|---|---|---|",
    ]
    for name, found in (report["verdict"] or {}).items():
        lines.append(
            f"| {name} | {found['best_by_hand']:.2f} dB | {found['automatic']:.2f} dB "
            f"| {'yes' if found['reached'] else '**no**'} "
            f"| {found['against_best']} |"
        )
    return "\n".join(lines)


def memory_table(report: Report) -> str:
    """What photographs take in memory, for each way to hold them."""
    lines = [
        "| way | peak beyond what is imported, MB | with a tenth of width and height, MB "
        "| photographs decoded as bytes, MB | as floats, MB |",
        "|---|---|---|---|---|",
    ]
    names = ("added_bytes", "added_on_a_tenth_bytes", "decoded_bytes", "decoded_float_bytes")
    for run in report["runs"]:
        cells = " | ".join(f"{run[name] / 1e6:,.0f}" for name in names if name in run)
        over = "**over the allowance** | | |"
        lines.append(f"| {run['way']} | {cells if run['within_allowance'] else over} |")
    return "\n".join(lines)


def _growth_note(report: Report) -> str:
    return (
        " The gate is that of the device, with so many octaves more when the side doubles, from "
        f"four blocks on: {report['settings']['octaves_per_doubling']}. Learned: "
        f"{report['settings']['kept']:.0%} of the candidates or fewer are kept where "
        f"{report['lost_surface_mass']:.1%} of the weight near surfaces is lost. The grid is filled"
        " from the same field, loses as much and keeps the same share of the volume that rays "
        f"reach; its bytes are interpolated between grids."
    )


def _bounds_note(report: Report) -> str:
    settings = report["settings"]
    return (
        f" {settings['scene']}, {settings['seconds']:g} s of training each. By hand: `near` and "
        "`far`; without planes space is contracted, as without a look at the data."
    )


def _memory_note(report: Report) -> str:
    images, width, height = report["photographs"]
    return (
        f" {images} photographs of {width} x {height}. A process may take "
        f"{report['allowance_bytes'] / 1e6:,.0f} MB beyond what it holds when everything is "
        "imported; the kernel refuses more."
    )


@dataclass(frozen=True)
class Shown:
    """How one stored result is shown."""

    title: str
    command: Callable[[Report], str]
    table: Callable[[Report], str]
    note: Callable[[Report], str]
    """What the reader of the table must know."""


def _bounds_command(report: Report) -> str:
    by_hand = [run for run in report["runs"] if run["range"] is not None]
    planes, seeds = ({str(run[name]): None for run in by_hand} for name in ("planes", "seed"))
    return (
        f"python benchmarks/bounds.py {report['settings']['scene']} "
        f"--planes {' '.join(planes)} --seeds {' '.join(seeds)}"
    )


def _memory_command(report: Report) -> str:
    return f"python benchmarks/image_memory.py --ways {' '.join(r['way'] for r in report['runs'])}"


LARGE_SCENES = {
    "growth": Shown(
        "How occupancy grows with a city",
        lambda report: "python benchmarks/growth.py",
        growth_table,
        _growth_note,
    ),
    "bounds": Shown(
        "Automatic bounds against near and far set by hand",
        _bounds_command,
        bounds_table,
        _bounds_note,
    ),
    "image-memory": Shown("Photographs on disk", _memory_command, memory_table, _memory_note),
}
"""By the names of the stored results, in the order of the page."""


def _kb(size: float) -> str:
    return f"{size / 1000:.0f}" if size >= 10_000 else f"{size / 1000:.1f}"


def _or_dash(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)
