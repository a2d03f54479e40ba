"""`table.md`: every contender, every failure, and every occupancy in figures."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from leco_plugin.chart.findings.learned import Learned, learned_of
from leco_plugin.chart.findings.representations import (
    Representation,
    fronts_of,
    never_held_of,
    representations_of,
)
from leco_plugin.chart.findings.settling import falls, settling
from leco_plugin.chart.findings.summary import (
    COSTS,
    LEARNING,
    Cost,
    Line,
    Versus,
    circumstances,
    common_psnr,
    lines_of,
    rivals,
)
from leco_plugin.chart.panels import cost_panel, title_of

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
"""Numbers of positions at which networks were asked."""
OCCUPANCY = (
    ("params", "parameters", 1.0),
    ("bytes", "kB", 1e-3),
    ("learn_seconds", "learned in, s", 1.0),
    ("empty_fraction", "candidates skipped, %", 100.0),
    ("image_price_db", "price, dB", 1.0),
    ("lost_surface_mass", "lost surface mass", 1.0),
    ("at_end.empty_fraction", "skipped at the end, %", 100.0),
    ("at_equal_loss.kept_reached_volume", "volume kept at 1e-3, %", 100.0),
    ("kept_surface_recall", "true surface kept, %", 100.0),
    ("free_space_skipped", "free space skipped, %", 100.0),
)
"""Figure, title and scale of the columns about a learned occupancy."""


def rows(header: Sequence[str], cells: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [header, ["---"] * len(header), *cells]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def number(value: float | None, scale: float = 1.0) -> str:
    """Three digits, or a dash where there is no number."""
    if value is None:
        return "-"
    value *= scale
    if abs(value) >= 100.0 or value == int(value):
        return f"{value:.0f}"
    return f"{value:.3g}"


def spread(
    values: Sequence[float | None],
    form: str,
    middle_of: Callable[[Sequence[float]], float] = statistics.median,
) -> str:
    """Median or mean, and the range where there are several; a dash where a seed has none."""
    known = [value for value in values if value is not None]
    if len(known) < len(values) or not known:
        return "-"
    middle = format(middle_of(known), form)
    if len(known) == 1:
        return middle
    return f"{middle} ({min(known):{form}} to {max(known):{form}})"


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
        parts.append(
            f"Ended in the warm-up of their grid, which asks all cells: {' and '.join(warming)}."
        )
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
        parts += [representations_table(held), *left_out(lines)]
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
    fronts = {cost: cost_panel(cost, lines).front() for cost in COSTS}
    cells = []
    for line in lines:
        costs = []
        for cost in COSTS:
            shown = number(line.median(cost))
            costs.append(
                f"**{shown}**" if (line.median(cost), line.psnr) in fronts[cost] else shown
            )
        cells.append(
            [
                line.name,
                str(len(line.runs)),
                spread(line.psnrs, ".2f", statistics.fmean),
                *(spread([line.mean(name)], ".3f") for name in ("ssim", "lpips")),
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
    reasons = [one["reason"].replace("|", "\\|") for one in failures]
    cells = [
        [one["name"], str(one["seed"]), f"failed: {reason}"]
        for one, reason in zip(failures, reasons)
    ]
    return rows(["method", "seed", "reason"], cells)


def occupancy_table(learned: Sequence[Learned]) -> str:
    """Occupancies: medians over the seeds in which a gate was frozen."""
    header = ["occupancy of", "frozen", "healed", *(title for _, title, _ in OCCUPANCY)]
    cells = []
    for one in learned:
        late = f", {one.guided_nothing} at the end" if one.guided_nothing else ""
        healed = "-" if one.healed is None else str(one.healed)
        figures = [number(one.median(name), scale) for name, _, scale in OCCUPANCY]
        cells.append([one.name, f"{len(one.facts)} of {one.seeds}{late}", healed, *figures])
    return rows(header, cells)


def representations_table(held: Sequence[Representation]) -> str:
    """What each keeps for its size and its learning time, and the fronts that it is on."""
    header = ["representation", "kB", "learned in, s", "of which beyond the field, s"]
    header += ["volume kept at equal loss, %", "on the front of"]
    cells = [
        [
            one.name,
            number(one.median("size")),
            spread(one.of_seeds("learn_seconds"), ".0f"),
            spread(one.of_seeds("beyond"), ".0f"),
            spread(one.of_seeds("kept"), ".1f"),
            ", ".join(fronts_of(one, held)) or "-",
        ]
        for one in held
    ]
    return rows(header, cells)


def left_out(lines: Sequence[Line]) -> list[str]:
    """Sentences about gates and grids that are not in the table of representations."""
    said = []
    if names := never_held_of(lines):
        said.append(f"Left out, for not frozen with every seed: {', '.join(names)}.")
    sizes = {
        size
        for line in lines
        for run in line.runs
        for size in ((run.get("occupancy") or {}).get("at_equal_loss") or {}).get("left_out", [])
    }
    if sizes:
        listed = ", ".join(f"{size}³" for size in sorted(sizes))
        said.append(f"Left out, for want of memory or time in some run: grid {listed}.")
    return said


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
