"""Tables of what was measured for large scenes: bounds and photographs on disk."""

from __future__ import annotations

import json
import statistics
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import checkout  # noqa: F401
from page_parts import table

from leco_plugin.chart.summary import Verdict, compare
from leco_plugin.log import counted

Report = dict[str, Any]
Run = dict[str, Any]
MAY_LOSE = 0.1
"""dB by which automatic bounds may be below the best pair."""


def bounds_table(report: Report) -> str:
    """A row for each way to set near and far, and the verdict."""
    groups: dict[tuple[str, bool], list[float | None]] = {}
    for run in report["runs"]:
        name = "automatic" if run["range"] is None else "{:g} to {:g}".format(*run["range"])
        groups.setdefault((name, run["planes"]), []).append(run["psnr"])
    cells = []
    for (name, planes), values in groups.items():
        known = [value for value in values if value is not None]
        figures = f"failed with {len(values) - len(known)} of {counted(len(values), 'seed')}"
        if len(known) == len(values):
            each = ", ".join(f"{value:.2f}" for value in known)
            figures = f"{statistics.fmean(known):.2f} dB ({each})"
        cells.append((name, "yes" if planes else "no", figures))
    head = "near and far | rays cut at planes | PSNR, mean (each seed)"
    return "\n".join([*table(head, cells), "", *bounds_verdict(report["runs"])])


def bounds_verdict(runs: Sequence[Run]) -> list[str]:
    """A table of automatic bounds against the best pair, without planes and with them, as far as
    there are runs.

    The best of several means is above its own expectation, which favours the pair.
    """
    cells = []
    automatic = [*_by_seed(run for run in runs if run["range"] is None)["null"].values()]
    for name, by_hand in ((name, _by_seed(some)) for name, some in ways_of(runs).items()):
        if by_hand:
            pairs = ([*values.values()] for values in by_hand.values())
            best = max(pairs, key=statistics.fmean)
            found = compare(automatic, best)
            means = [f"{statistics.fmean(psnrs):.2f} dB" for psnrs in (best, automatic)]
            cells.append([name, *means, reached(found), found.said()])
    head = f"by hand | best | automatic | reached: at most {MAY_LOSE:g} dB below "
    return table(f"{head}| automatic against the best pair", cells)


def reached(found: Verdict) -> str:
    """Whether no more than `MAY_LOSE` is lost: undecided where the interval holds that too."""
    if found.margin is None:
        return "no verdict"
    if found.difference - found.margin >= -MAY_LOSE:
        return "yes"
    return "**no**" if found.difference + found.margin < -MAY_LOSE else "undecided"


def ways_of(runs: Sequence[Run]) -> dict[str, list[Run]]:
    """Runs with near and far set by hand, by what else was known."""
    by_hand = [run for run in runs if run["range"] is not None]
    ways = {"near and far alone": False, "near and far, planes from the data": True}
    found = {name: [run for run in by_hand if run["planes"] == on] for name, on in ways.items()}
    return {name: some for name, some in found.items() if some}


def _by_seed(runs: Iterable[Run]) -> dict[str, dict[int, float]]:
    """PSNR by range and seed; a range with which a run has failed is left out."""
    found: dict[str, dict[int, float]] = {}
    failed = set()
    for run in runs:
        name = json.dumps(run["range"])
        found.setdefault(name, {})[run["seed"]] = run["psnr"]
        if run["psnr"] is None:
            failed.add(name)
    return {name: values for name, values in found.items() if name not in failed}


def memory_table(report: Report) -> str:
    """What photographs take in memory, for each way to hold them."""
    names = ("added_bytes", "added_on_a_tenth_bytes", "decoded_bytes", "decoded_float_bytes")
    cells = []
    for run in report["runs"]:
        known = [f"{run[name] / 1e6:,.0f}" if name in run else "-" for name in names]
        over = ["**over the allowance**", "-", "-", "-"]
        cells.append([run["way"], *(known if run["within_allowance"] else over)])
    head = (
        "way | peak beyond what is imported, MB | with a tenth of width and height, MB "
        "| photographs decoded as bytes, MB | as floats, MB"
    )
    return "\n".join(table(head, cells))


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
    "bounds": Shown(
        "Automatic bounds against near and far set by hand",
        _bounds_command,
        bounds_table,
        _bounds_note,
    ),
    "image-memory": Shown("Photographs on disk", _memory_command, memory_table, _memory_note),
}
"""By the names of the stored results, in the order of the page."""
