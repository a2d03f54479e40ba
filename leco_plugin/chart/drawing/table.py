"""`table.md`: every contender, every failure, and every occupancy in figures."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from leco_plugin.chart.drawing.cells import cell, number, rows, spread
from leco_plugin.chart.drawing.occupancy_tables import (
    left_out,
    never_held,
    occupancy_table,
    representations_table,
)
from leco_plugin.chart.drawing.title import title_of
from leco_plugin.chart.findings.learned import learned_of
from leco_plugin.chart.findings.representations import representations_of
from leco_plugin.chart.findings.settling import falls, settling
from leco_plugin.chart.findings.summary import (
    COSTS,
    LEARNING,
    Cost,
    Line,
    circumstances,
    common_psnr,
    front,
    lines_of,
)
from leco_plugin.chart.findings.versus import Versus, rivals

STEPS = Cost("steps", "steps", "")
TRAINED = Cost("train_seconds", "trained", "s")
STEP_SECONDS = Cost("step_seconds", "a step", "ms", 1e3)
ASKED = (
    Cost("field_queries_per_ray", "field, a ray", ""),
    Cost("proposal_queries_per_ray", "proposals, a ray", ""),
    Cost("gate_queries_per_ray", "frozen gate, a ray", ""),
    Cost("train_queries.field", "field in training", "M", 1e-6),
    Cost("train_queries.learning", "field that learns first", "M", 1e-6),
    Cost("train_queries.proposal", "proposals in training", "M", 1e-6),
    Cost("train_queries.gate", "frozen gate in training", "M", 1e-6),
)
"""Positions at which a network was asked."""


def write_table(results: Mapping[str, Any], path: Path) -> Path:
    """Writes the table; results without any run give a table without rows."""
    path.write_text(table(results))
    return path


def table(results: Mapping[str, Any]) -> str:
    """The whole of `table.md`."""
    parts = [
        f"# {results['scene']['name']}" + (f": {results['suite']}" if results["suite"] else ""),
        *([results["question"]] if results["question"] else []),
    ]
    lines = lines_of(results) if results["runs"] else []
    if missing := results.get("missing", 0):
        made = len(results["runs"])
        parts.append(f"**{made} of {made + missing} runs so far**: what is said here may change.")
    if lines:
        parts += [f"{title_of(results)}. {circumstances(results)}.", runs_table(lines)]
    if warming := [line.name for line in lines if line.warming_up]:
        parts.append(f"Ended in the warm-up of their grid, which asks all cells: {_and(warming)}.")
    duels = rivals(lines, results["protocol"]["seconds"])
    if duels:
        parts.append(versus_table(duels))
    if len(lines) > 1 and results["protocol"]["seconds"] is not None:
        parts.append(settling(lines))
    if fallen := falls(lines):
        parts.append(fallen)
    if results["failures"]:
        parts.append(failures_table(results["failures"]))
    if learned := learned_of(lines):
        parts.append(occupancy_table(learned))
    if held := representations_of(lines):
        parts.append(representations_table(held))
        parts += [said for said in (never_held(lines), left_out(lines)) if said]
    if lines:
        parts.append(queries_table(lines))
    parts.append(provenance(results))
    return "\n\n".join(parts) + "\n"


def runs_table(lines: Sequence[Line]) -> str:
    """Means of quality and medians of cost over seeds; bold is on the front of its column."""
    level = common_psnr(lines)
    header = [
        *("method", "seeds", "PSNR, dB", "SSIM", "LPIPS", f"s to {level:.1f} dB", "steps"),
        *("trained, s", "of which learning, s", "ms a step"),
        *(cost.titled for cost in COSTS),
    ]
    bold = {cost.key: _on_front(lines, cost) for cost in COSTS}
    cells = []
    for line in lines:
        costs = []
        for cost in COSTS:
            shown = number(line.median(cost))
            costs.append(f"**{shown}**" if line.name in bold[cost.key] else shown)
        cells.append(
            [
                line.name,
                str(len(line.runs)),
                _psnr(line),
                *(_quality(line.mean(name)) for name in ("ssim", "lpips")),
                number(line.seconds_to(level)),
                *(number(line.median(one)) for one in (STEPS, TRAINED, LEARNING, STEP_SECONDS)),
                *costs,
            ]
        )
    return rows(header, cells)


def versus_table(duels: Sequence[Versus]) -> str:
    """What learned occupancies gain: means of PSNR over seeds, medians of times and of ratios, and
    the least and the most."""
    header = [
        *("against", "seeds", "PSNR, dB", "passes its last PSNR after, s"),
        *("sooner by, x", "renders faster by, x"),
    ]
    cells = [
        [
            f"{duel.ours} against {duel.theirs}",
            str(len(duel.gains)),
            spread(duel.gains, "+.2f", statistics.fmean),
            spread(duel.passed, ".0f"),
            spread(duel.sooner, ".2f"),
            spread(duel.faster, ".1f"),
        ]
        for duel in duels
    ]
    return rows(header, cells)


def queries_table(lines: Sequence[Line]) -> str:
    """How often which network was asked, in rendering and in all of the training: medians."""
    shown = [cost for cost in ASKED if any(line.median(cost) for line in lines)]
    cells = [[line.name, *(number(line.median(cost)) for cost in shown)] for line in lines]
    return rows(["positions asked of", *(cost.titled for cost in shown)], cells)


def failures_table(failures: Sequence[Mapping[str, Any]]) -> str:
    """Runs that ended without a result."""
    cells = [[f["name"], str(f["seed"]), f"failed: {cell(f['reason'])}"] for f in failures]
    return rows(["method", "seed", "reason"], cells)


def provenance(results: Mapping[str, Any]) -> str:
    """When, how and by which code the runs were made, and whether it was the same for all."""
    made, runs = results["made"], results["runs"]
    commit = f" at {made['commit']}" if made["commit"] else ""
    said = f"`{made['command']}`, {made['date']}, leco_plugin {made['version']}{commit}."
    if minutes := sum(run.get("wall_seconds") or 0.0 for run in runs) / 60.0:
        said += (
            f" All runs together took {minutes / results['protocol'].get('at_once', 1):.0f} min."
        )
    if reused := sum(bool(run.get("reused")) for run in runs):
        said += f" {reused} of the runs were made for other charts."
    by_code: dict[str, list[str]] = {}
    for run in runs:
        names = by_code.setdefault(str(run.get("code")), [])
        names += [run["name"]] if run["name"] not in names else []
    if len(by_code) > 1:
        of_each = "; ".join(f"{code}: {', '.join(names)}" for code, names in by_code.items())
        said += f" Not all of them are of the same code, nor made in turns ({of_each})."
    return said


def _on_front(lines: Sequence[Line], cost: Cost) -> set[str]:
    known = [(line, line.median(cost)) for line in lines]
    points = [(line, value) for line, value in known if value is not None]
    members = front([(value, line.psnr) for line, value in points])
    return {points[i][0].name for i in members}


def _psnr(line: Line) -> str:
    if len(line.runs) == 1:
        return f"{line.psnr:.2f}"
    return f"{line.psnr:.2f} ({min(line.psnrs):.2f} to {max(line.psnrs):.2f})"


def _quality(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _and(names: Sequence[str]) -> str:
    return " and ".join(names)
