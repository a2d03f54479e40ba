"""`table.md`: every contender, every failure, and every occupancy in figures."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from leco_plugin.chart.settling import settling
from leco_plugin.chart.summary import (
    COSTS,
    KEPT,
    LEARNING,
    Cost,
    Line,
    Representation,
    circumstances,
    common_psnr,
    front,
    fronts_of,
    headline,
    lines_of,
    representations_of,
    sentence,
    verdict,
)
from leco_plugin.chart.versus import Versus, rivals

STEPS = Cost("steps", "steps", "")
STEP_SECONDS = Cost("step_seconds", "a step", "ms", 1e3)
TRAIN_QUERIES = Cost("train_queries.field", "field queries in training", "M", 1e-6)
LEARN_QUERIES = Cost("train_queries.learning", "", "M", 1e-6)
PROPOSALS = Cost("proposal_queries_per_ray", "proposal queries a ray", "")


def write_table(results: Mapping[str, Any], path: Path) -> Path:
    """Writes the table; results without any run give a table without rows."""
    path.write_text(table(results))
    return path


def table(results: Mapping[str, Any]) -> str:
    """The whole of `table.md`."""
    made = results["made"]
    parts = [
        f"# {results['scene']['name']}" + (f": {results['suite']}" if results["suite"] else ""),
        *([results["question"]] if results["question"] else []),
    ]
    lines = lines_of(results) if results["runs"] else []
    if lines:
        parts += [f"{sentence(headline(results))}. {circumstances(results)}.", runs_table(lines)]
    duels = rivals(lines)
    if duels:
        parts.append(versus_table(duels))
    if results["suite"] and lines and results["protocol"]["seconds"] is not None:
        parts.append(settling(lines))
    if results["failures"]:
        parts.append(failures_table(results["failures"]))
    if any(run.get("occupancy") for line in lines for run in line.runs):
        parts.append(occupancy_table(lines))
    held = representations_of(lines)
    if len(held) > 1:
        parts += [representations_table(held), f"{sentence(verdict(held))}.{left_out(lines)}"]
    commit = f" at {made['commit']}" if made["commit"] else ""
    reused = sum(bool(run.get("reused")) for run in results["runs"])
    taken = f" {reused} of the runs were made for other charts." if reused else ""
    said = f"`{made['command']}`, {made['date']}, leco_plugin {made['version']}{commit}."
    parts.append(said + taken)
    return "\n\n".join(parts) + "\n"


def runs_table(lines: Sequence[Line]) -> str:
    """Means of quality and medians of cost over seeds; bold is on the front of its column."""
    level = common_psnr(lines)
    header = [
        *("method", "seeds", "PSNR, dB", "SSIM", "LPIPS", f"s to {level:.1f} dB", "steps"),
        "ms a step",
        "of which learning, s",
        *(f"{cost.title}{f', {cost.unit}' if cost.unit else ''}" for cost in COSTS),
        *("proposal queries a ray", "field queries in training, M"),
    ]
    bold = {cost.key: _on_front(lines, cost) for cost in COSTS}
    rows = []
    for line in lines:
        ssim, lpips, reached = line.mean("ssim"), line.mean("lpips"), line.seconds_to(level)
        costs = []
        for cost in COSTS:
            shown = _number(line.median(cost))
            costs.append(f"**{shown}**" if line.name in bold[cost.key] else shown)
        asked = [line.median(TRAIN_QUERIES), line.median(LEARN_QUERIES)]
        rows.append(
            [
                line.name,
                str(len(line.runs)),
                _psnr(line),
                "-" if ssim is None else f"{ssim:.3f}",
                "-" if lpips is None else f"{lpips:.3f}",
                _number(reached),
                _number(line.median(STEPS)),
                _number(line.median(STEP_SECONDS)),
                _number(line.median(LEARNING)),
                *costs,
                _number(line.median(PROPOSALS)),
                _number(sum(value or 0.0 for value in asked)),
            ]
        )
    return _rows(header, rows)


def versus_table(duels: Sequence[Versus]) -> str:
    """What learned occupancies gain: medians over seeds, and the least and the most."""
    header = [
        *("against", "seeds", "PSNR, dB", "passes its last PSNR after, s"),
        *("sooner by, x", "renders faster by, x"),
    ]
    rows = [
        [
            f"{duel.ours} against {duel.theirs}",
            str(len(duel.gains)),
            _spread(duel.gains, "+.2f"),
            _spread(duel.passed, ".0f"),
            _spread(duel.sooner, ".2f"),
            _spread(duel.faster, ".1f"),
        ]
        for duel in duels
    ]
    return _rows(header, rows)


def failures_table(failures: Sequence[Mapping[str, Any]]) -> str:
    """Runs that ended without a result."""
    rows = [[f["name"], str(f["seed"]), f"failed: {_cell(f['reason'])}"] for f in failures]
    return _rows(["method", "seed", "reason"], rows)


def occupancy_table(lines: Sequence[Line]) -> str:
    """What was learned, and what it costs: medians over seeds."""
    columns = (
        Cost("occupancy.params", "parameters", ""),
        Cost("occupancy.bytes", "kB", "", 1e-3),
        Cost("occupancy.learn_seconds", "learned in, s", ""),
        Cost("occupancy.empty_fraction", "candidates skipped, %", "", 100.0),
        Cost("occupancy.image_price_db", "price, dB", ""),
        Cost("occupancy.lost_surface_mass", "lost surface mass", ""),
        Cost(KEPT.key, "volume kept at 1e-3, %", "", 100.0),
        Cost("occupancy.kept_surface_recall", "true surface kept, %", "", 100.0),
        Cost("occupancy.free_space_skipped", "free space skipped, %", "", 100.0),
    )
    rows = [
        [line.name, *(_number(line.median(column)) for column in columns)]
        for line in lines
        if all(run.get("occupancy") for run in line.runs)
    ]
    return _rows(["occupancy of", *(column.title for column in columns)], rows)


def representations_table(held: Sequence[Representation]) -> str:
    """What each keeps for its size and its learning time, and where nothing else beats it."""
    header = ["representation", "kB", "learned in, s", "volume kept at equal loss, %"]
    rows = [
        [
            one.name,
            _number(one.size),
            _number(one.learn_seconds),
            f"{one.kept:.1f}",
            ", ".join(fronts_of(one, held)) or "-",
        ]
        for one in held
    ]
    return _rows([*header, "on the front of"], rows)


def left_out(lines: Sequence[Line]) -> str:
    """Grids that were to be made from a field and were not, in a sentence after another."""
    sizes = {
        str(size)
        for line in lines
        for run in line.runs
        for size in ((run.get("occupancy") or {}).get("at_equal_loss") or {}).get("left_out", [])
    }
    if not sizes:
        return ""
    listed = ", ".join(f"{size}³" for size in sorted(sizes, key=int))
    return f" Not in every run, for want of memory or time: grid {listed}."


def _on_front(lines: Sequence[Line], cost: Cost) -> set[str]:
    known = [(line, line.median(cost)) for line in lines]
    points = [(line, value) for line, value in known if value is not None]
    members = front([(value, line.psnr) for line, value in points])
    return {points[i][0].name for i in members}


def _psnr(line: Line) -> str:
    if len(line.runs) == 1:
        return f"{line.psnr:.2f}"
    return f"{line.psnr:.2f} ({min(line.psnrs):.2f} to {max(line.psnrs):.2f})"


def _spread(values: Sequence[float | None], form: str) -> str:
    """Median, and where there are several, least and most; a dash where a seed has none."""
    known = [value for value in values if value is not None]
    if len(known) < len(values) or not known:
        return "-"
    middle = format(statistics.median(known), form)
    if len(known) == 1:
        return middle
    return f"{middle} ({min(known):{form}} to {max(known):{form}})"


def _number(value: float | None) -> str:
    """Three digits, or a dash where there is no number."""
    if value is None:
        return "-"
    if abs(value) >= 100.0 or value == int(value):
        return f"{value:.0f}"
    return f"{value:.3g}"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def _rows(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)
