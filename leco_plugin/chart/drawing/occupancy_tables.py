"""The tables of `table.md` that are about occupancies."""

from __future__ import annotations

from collections.abc import Sequence

from leco_plugin.chart.drawing.cells import number, rows, spread
from leco_plugin.chart.findings.fronts import fronts_of
from leco_plugin.chart.findings.learned import Learned
from leco_plugin.chart.findings.representations import Representation, never_held_of
from leco_plugin.chart.findings.summary import Line

COLUMNS = (
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
"""Figure, title and scale."""


def occupancy_table(learned: Sequence[Learned]) -> str:
    """What was learned and what it costs: medians over the seeds in which a gate was frozen."""
    header = ["occupancy of", "frozen", "healed", *(title for _, title, _ in COLUMNS)]
    cells = [
        [
            one.name,
            f"{len(one.facts)} of {one.seeds}" + _at_the_end(one),
            "-" if one.healed is None else str(one.healed),
            *(_scaled(one.median(name), scale) for name, _, scale in COLUMNS),
        ]
        for one in learned
    ]
    return rows(header, cells)


def _at_the_end(one: Learned) -> str:
    return f", {one.guided_nothing} at the end" if one.guided_nothing else ""


def _scaled(value: float | None, scale: float) -> str:
    return number(None if value is None else value * scale)


def representations_table(held: Sequence[Representation]) -> str:
    """What each keeps for its size and its learning time, and where nothing else beats it."""
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


def never_held(lines: Sequence[Line]) -> str:
    """Whose gate is not in the table, in a sentence; or nothing."""
    names = never_held_of(lines)
    return f"Left out, for not frozen with every seed: {', '.join(names)}." if names else ""


def left_out(lines: Sequence[Line]) -> str:
    """Grids that were to be made from each field and were not, in a sentence; or nothing."""
    sizes = {
        str(size)
        for line in lines
        for run in line.runs
        for size in ((run.get("occupancy") or {}).get("at_equal_loss") or {}).get("left_out", [])
    }
    if not sizes:
        return ""
    listed = ", ".join(f"{size}³" for size in sorted(sizes, key=int))
    return f"Left out, for want of memory or time in some run: grid {listed}."
