"""`table.md`: every contender, every failure, and every occupancy in figures."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, TypeVar

from leco_plugin.chart import summary
from leco_plugin.chart.learned import Learned, falls, learned_of, not_always_frozen, settling
from leco_plugin.chart.panels import cost_panel, finding_of
from leco_plugin.chart.representations import (
    Representation,
    fronts_of,
    keeps_all,
    representations_of,
)
from leco_plugin.chart.summary import Cost, Line, Versus

T = TypeVar("T")

SPENT = {
    "steps": Cost("steps", "steps", ""),
    "trained, s": Cost("train_seconds", "trained", "s"),
    "of which learning, s": summary.LEARNING,
    "ms a step": Cost("step_seconds", "a step", "ms", 1e3),
}
QUALITIES = {
    "mean PSNR of images": ("image_psnr", ".2f"),
    "SSIM": ("ssim", ".3f"),
    "FLIP": ("flip", ".3f"),
    "LPIPS": ("lpips", ".3f"),
}
"""Title, key in a run and form of figures that are left out where no run has them."""
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
    ("at_end.image_price_db", "price at the end, dB", 1.0),
    ("at_end.lost_surface_mass", "lost at the end", 1.0),
    ("at_equal_loss.kept_reached_volume", "volume kept at 1e-3, %", 100.0),
    ("kept_surface_recall", "true surface kept, %", 100.0),
    ("free_space_skipped", "free space skipped, %", 100.0),
)
"""Figure, title and scale of the columns about a learned occupancy."""


def rows(header: Sequence[str], cells: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [header, ["---"] * len(header), *cells]
    escaped = [[str(cell).replace("|", "\\|") for cell in line] for line in lines]
    return "\n".join(f"| {' | '.join(line)} |" for line in escaped)


def table_of(things: Sequence[T], columns: Mapping[str, Callable[[T], str]]) -> str:
    """A row for each thing, with a cell by each column."""
    return rows(list(columns), [[cell(one) for cell in columns.values()] for one in things])


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
    is_bound: Sequence[bool] = (),
    sign: str = "",
) -> str:
    """Median or mean, and the range where there are several; a dash where a seed has none. Where
    some values are bounds, a sign stands before each figure that may be less ("≤") or more ("≥").
    """
    known = [value for value in values if value is not None]
    if len(known) < len(values) or not known:
        return "-"
    bounds = [value for value, bound in zip(known, is_bound) if bound]
    middle = statistics.median_high if sign == "≥" else statistics.median_low
    said = _marked(format(middle_of(known), form), middle(known), bounds, sign)
    if len(known) == 1:
        return said
    ends = (_marked(format(end, form), end, bounds, sign) for end in (min(known), max(known)))
    return f"{said} ({' to '.join(ends)})"


def _marked(said: str, value: float, bounds: Sequence[float], sign: str) -> str:
    """A figure with the sign, if the true value behind a bound may be on its other side."""
    is_open = any(bound >= value if sign == "≤" else bound <= value for bound in bounds)
    return f"{sign} {said}" if is_open else said


def table(results: Mapping[str, Any]) -> str:
    """The whole of `table.md`; results without any run give one without rows."""
    parts = [
        f"# {results['scene']['name']}" + (f": {results['suite']}" if results["suite"] else ""),
        *([results["question"]] if results["question"] else []),
    ]
    lines = summary.lines_of(results) if results["runs"] else []
    if missing := results.get("missing", 0):
        made = len(results["runs"])
        parts.append(f"**{made} of {made + missing} runs so far**: what is said here may change.")
    if lines:
        parts += [f"{finding_of(results)}. {summary.circumstances(results)}.", runs_table(lines)]
    if warming := [line.name for line in lines if line.warming_up]:
        parts.append(
            f"Ended in the warm-up of their grid, which asks all cells: {' and '.join(warming)}."
        )
    if duels := summary.rivals(lines, results["protocol"]["seconds"]):
        parts.append(versus_table(duels))
    if len(lines) > 1 and results["protocol"]["seconds"] is not None:
        parts.append(settling(lines, results.get("rates_held")))
    if fallen := falls(lines):
        parts.append(f"{summary.sentence(fallen)}.")
    if failures := results["failures"]:
        cells = [[one["name"], str(one["seed"]), f"failed: {one['reason']}"] for one in failures]
        parts.append(rows(["method", "seed", "reason"], cells))
    if learned := learned_of(lines):
        parts.append(occupancy_table(learned))
    if held := representations_of(lines):
        parts += [representations_table(held), *left_out(lines)]
    if lines:
        parts.append(queries_table(lines))
    parts.append(provenance(results))
    return "\n\n".join(parts) + "\n"


def runs_table(lines: Sequence[Line]) -> str:
    """Means of quality and medians of cost over seeds, bold on the front of its column; and a line
    on figures of quality that no run has."""
    level = summary.common_psnr(lines)
    runs = [run for line in lines for run in line.runs]
    measured, missing = {}, []
    for title, (key, form) in QUALITIES.items():
        if any(run.get(key) is not None for run in runs):
            measured[title] = lambda line, key=key, form=form: spread([line.mean(key)], form)
        else:
            missing.append(title)
    fronts = {cost: cost_panel(cost, lines).front() for cost in summary.COSTS}

    def with_front(cost: Cost, line: Line) -> str:
        is_on_front = (line.median(cost), line.psnr) in fronts[cost]
        return f"**{_median(cost, line)}**" if is_on_front else _median(cost, line)

    found = table_of(
        lines,
        {
            "method": lambda line: line.name,
            "seeds": lambda line: str(len(line.runs)),
            "PSNR, dB": lambda line: spread(line.psnrs, ".2f", statistics.fmean),
            **measured,
            f"s to {level:.1f} dB": partial(_seconds_to, level),
            **{title: partial(_median, cost) for title, cost in SPENT.items()},
            **{cost.titled: partial(with_front, cost) for cost in summary.COSTS},
        },
    )
    return f"{found}\n\nNot measured: {', '.join(missing)}." if missing else found


def _median(cost: Cost, line: Line) -> str:
    return number(line.median(cost))


def _seconds_to(psnr: float, line: Line) -> str:
    """The median over its runs."""
    known = [after for after in line.seconds_to_each(psnr) if after is not None]
    said = number(line.seconds_to(psnr))
    if said == "-":
        return said
    bounds = [after for after, first in zip(known, line.first_evaluations) if after == first]
    return _marked(said, statistics.median_low(known), bounds, "≤")


def versus_table(duels: Sequence[Versus]) -> str:
    """What learned occupancies gain: the verdict on PSNR, medians of times and of ratios, and the
    least and the most."""

    def bounded(values: Sequence[float | None], form: str, duel: Versus, sign: str) -> str:
        return spread(values, form, is_bound=duel.at_first, sign=sign)

    return table_of(
        duels,
        {
            "against": lambda duel: f"{duel.ours} against {duel.theirs}",
            "PSNR": lambda duel: duel.psnr.said(),
            "passes its last PSNR after, s": lambda duel: bounded(duel.passed, ".0f", duel, "≤"),
            "sooner by, x": lambda duel: bounded(duel.sooner, ".2f", duel, "≥"),
            "renders faster by, x": lambda duel: spread(duel.faster, ".1f"),
        },
    )


def queries_table(lines: Sequence[Line]) -> str:
    """How often which network was asked, in rendering and in all of the training: medians."""
    shown = [cost for cost in ASKED if any(line.median(cost) for line in lines)]
    figures = {cost.titled: partial(_median, cost) for cost in shown}
    return table_of(lines, {"positions asked of": lambda line: line.name, **figures})


def occupancy_table(learned: Sequence[Learned]) -> str:
    """Occupancies: medians over the seeds in which a gate was frozen. Size and true surface kept
    are of the gate at the end, which may be smaller than the one that was frozen."""

    def frozen(one: Learned) -> str:
        late = f", {one.guided_nothing} at the end" if one.guided_nothing else ""
        return f"{len(one.facts)} of {one.seeds}{late}"

    def median(name: str, scale: float, one: Learned) -> str:
        return number(one.figure(name), scale)

    return table_of(
        learned,
        {
            "occupancy of": lambda one: one.name,
            "frozen": frozen,
            "healed": lambda one: "-" if one.healed is None else str(one.healed),
            **{title: partial(median, name, scale) for name, title, scale in OCCUPANCY},
        },
    )


def representations_table(held: Sequence[Representation]) -> str:
    """What each keeps for its size and its learning time, and the fronts that it is on."""
    return table_of(
        held,
        {
            "representation": lambda one: one.name,
            "kB": lambda one: number(one.median("size")),
            "learned in, s": lambda one: spread(one.of_seeds("learn_seconds"), ".0f"),
            "of which beyond the field, s": lambda one: spread(one.of_seeds("beyond"), ".0f"),
            "volume kept at equal loss, %": lambda one: spread(one.of_seeds("kept"), ".1f"),
            "on the front of": lambda one: ", ".join(fronts_of(one, held)) or "-",
        },
    )


def left_out(lines: Sequence[Line]) -> list[str]:
    """Sentences about gates and grids that are not in the table of representations."""
    said = []
    if names := not_always_frozen(lines):
        said.append(f"Left out, for not frozen with every seed: {', '.join(names)}.")
    measured = summary.at_equal_loss(lines)
    sizes = {size for one in measured for size in one.get("left_out", ())}
    others = [row for one in measured for row in one.get("others", ())]
    if full := {row["name"] for row in others if keeps_all(row)}:
        said.append(f"Left out, for keeping all space in some run: {', '.join(sorted(full))}.")
    if sizes:
        listed = ", ".join(f"{size}³" for size in sorted(sizes))
        said.append(f"Left out, for want of memory or time in some run: grid {listed}.")
    return said


def made_in_words(made: Mapping[str, Any]) -> str:
    """By which command, when and by which code results were made."""
    commit = f" at {made['commit']}" if made["commit"] else ""
    return f"`{made['command']}`, {made['date']}, leco_plugin {made['version']}{commit}."


def provenance(results: Mapping[str, Any]) -> str:
    """When, how and by which code the runs were made, and whether it was the same for all."""
    said, runs = made_in_words(results["made"]), results["runs"]
    spent = [run.get("wall_seconds") for run in runs]
    if all(spent) and (minutes := sum(spent) / 60.0):
        at_once = results["protocol"].get("at_once", 1)
        said += f" All runs together took {minutes / at_once:.0f} min."
    if reused := sum(bool(run.get("reused")) for run in runs):
        said += f" {reused} of the runs were made for other charts."
    by_code: dict[str, dict[str, None]] = {}  # its names, each once and in order
    for run in runs:
        by_code.setdefault(str(run.get("code")), {})[run["name"]] = None
    if len(by_code) > 1:
        of_each = "; ".join(f"{code}: {', '.join(names)}" for code, names in by_code.items())
        said += f" Not all of them are of the same code, nor made in turns ({of_each})."
    return said
