"""The table in words, `table.md`, and in pictures, `stability.png` and one of each failure.

In a picture colour, sign and words say the same, so that no reader depends on one of them.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from PIL import Image

from leco_plugin.chart.summary import sentence
from leco_plugin.chart.table import made_in_words, rows
from leco_plugin.chart.theme import LIGHT, Theme, new_figure, save_picture, save_whole
from leco_plugin.log import counted
from leco_plugin.stability.plan import LEARNED, QUICK

NOTHING = "nothing has been run yet"
QUICKLY = "made with --quick, which shows that everything runs and no more"
NO_VERDICT = "no verdict yet: nothing has been run beside a dense run that trains"
SIGNS = {"pass": "pass", "degraded": "degraded", "fail": "**fail**", "no reference": "-"}
ROW, HEAD, FOOT = 0.34, 1.15, 0.75
"""Heights in inches."""
NAMES, COLUMN = 2.45, 1.88
"""Widths in inches: type of 10 points is to be read where a page shows all of it."""
GAP = 0.03
VIEW = 3.4
"""Width of one picture of a failure, inches."""
DRAWN_SIGNS = {"pass": "✓", "degraded": "~", "fail": "✗", "no reference": "-"}
HOW_TO_READ = (
    "Each cell: PSNR against the dense run of the same host, and the surfaces that are lost, or "
    "how far below the median the worst seed is.  "
    "✓ within 0.2 dB and no bad seed   ~ degraded   ✗ fails   "
    "- nothing to compare with: the dense run does not train"
)
LOST = 0.005
"""Share of the surfaces from which on the picture says how much is lost."""
ON_LIGHT = {  # the ground of a cell, and the ink on it
    "pass": ("#d7f0df", "#0f5a2f"),
    "degraded": ("#fbeab8", "#6b4c00"),
    "fail": ("#f6c9c4", "#8c1d13"),
    "no reference": ("#eceef1", "#656c76"),
}
ON_DARK = {
    "pass": ("#12351f", "#86dfa6"),
    "degraded": ("#443408", "#f2d06b"),
    "fail": ("#551c17", "#ff9f95"),
    "no reference": ("#1c2128", "#9198a1"),
}
Results = Mapping[str, Any]
"""As in `stability.json`."""


def table(results: Results) -> str:
    """The whole of `table.md`."""
    reasons = [[row["title"], row["why"]] for row in results["cases"]]
    parts = ["# Stability", headline(results), verdicts(results), failures(results)]
    parts.append(rows(["case", "why it is there"], reasons))
    parts.append(made_in_words(results["made"]))
    return "\n\n".join(part for part in parts if part) + "\n"


def verdicts(results: Results) -> str:
    """A row a case, a column a sampler."""
    samplers = results["samplers"]
    cells = [
        [row["title"], *(_cell(row["cells"].get(one["name"])) for one in samplers)]
        for row in results["cases"]
    ]
    return rows(["case", *(one["title"] for one in samplers)], cells)


def failures(results: Results) -> str:
    """What fails or is degraded, and why; empty where nothing is."""
    broken = [
        [row["title"], one["title"], row["cells"][one["name"]]["reason"]]
        for row in results["cases"]
        for one in results["samplers"]
        if row["cells"].get(one["name"], {}).get("verdict") in ("fail", "degraded")
    ]
    return rows(["case", "sampler", "what failed"], broken) if broken else ""


def headline(results: Results) -> str:
    """What the table shows, in a sentence or two."""
    counted = _count_passes(results)
    return f"{QUICKLY}: {counted}" if results.get("sizes") == asdict(QUICK) else counted


def titles(results: Results) -> tuple[str, str]:
    title, _, below = headline(results).partition("; ")
    return sentence(title), sentence(below)


def _count_passes(results: Results) -> str:
    cells = [cell for row in results["cases"] for cell in row["cells"].values()]
    compared = [one for one in results["samplers"] if one["reference"] is not None]
    passed: list[tuple[str, int, int]] = []
    for one in sorted(compared, key=lambda one: one["name"] != LEARNED):
        held = [word for word in verdicts_of(results, one["name"]) if word != "no reference"]
        if held:
            passed.append((one["title"], held.count("pass"), len(held)))
    if not passed:
        return NO_VERDICT if any(cell["seeds"] for cell in cells) else NOTHING
    (first, count, of), *others = passed
    parts = [f"{first} passes {count} of {counted(of, 'case')}"]
    ours = [row["cells"].get(LEARNED, {}) for row in results["cases"] if not row["must_fail"]]
    apart = sum(cell.get("verdict") == "no reference" and cell["seeds"] > 0 for cell in ours)
    if apart:
        title = next(one["title"] for one in compared if one["name"] == LEARNED)
        who = "it" if first == title else title
        parts.append(f"for {apart} more {who} has no dense run that trains")
    parts += [f"{title} {count} of {of}" for title, count, of in others]
    if missing := sum(cell["missing"] for cell in cells):
        parts.append(counted(missing, "seed of a cell is missing", "seeds of cells are missing"))
    if is_unproven(results):
        parts.append("unproven: the case that must fail has not failed")
    return "; ".join(parts)


def verdicts_of(results: Results, sampler: str) -> list[str]:
    """Verdicts of a sampler on all cases but those that must fail; where cells are made of the same
    runs, one verdict for all of them."""
    found: dict[Any, str] = {}
    for row in results["cases"]:
        if not row["must_fail"] and sampler in row["cells"]:
            cell = row["cells"][sampler]
            runs = frozenset((row["scene"]["name"], run["name"]) for run in cell.get("runs", ()))
            found.setdefault(runs or row["name"], cell["verdict"])
    return [*found.values()]


def blind(results: Results) -> list[str]:
    """Why the suite cannot be believed, in a line each: cases that must fail, and have been run
    without failing for what is measured of them."""
    said = []
    for row in results["cases"]:
        cell = row["cells"].get(LEARNED)
        if not row["must_fail"] or cell is None or cell["verdict"] == "no reference":
            continue
        if cell["verdict"] != "fail":
            said.append(f"the case {row['name']} must fail, and its verdict is {cell['verdict']}")
        elif cell["psnr"] is None:
            said.append(f"the case {row['name']} must fail by its figures; {cell['reason']}")
    return said


def is_unproven(results: Results) -> bool:
    """Whether a case that must fail has not failed: then nobody knows what this table notices."""
    cells = [row["cells"].get(LEARNED, {}) for row in results["cases"] if row["must_fail"]]
    return bool(blind(results)) or any(cell.get("verdict") != "fail" for cell in cells)


def figures(cell: Mapping[str, Any]) -> tuple[str, str, str]:
    """A cell in short words: its PSNR; what it skips and how often it was healed; its seeds."""
    if cell["psnr"] is None:
        return "no result" if cell["verdict"] == "fail" else cell["reason"], "", ""
    first, parts = f"{cell['psnr']:.1f} dB", []
    if cell["gap"] is not None:
        first = f"{cell['gap']:+.2f} dB"
        parts.append(f"kept {cell['kept_fraction']:.0%}")
        if cell["lost_mass"] is not None:
            parts.append(f"lost {cell['lost_mass']:.1%}")
    occupancies = [run.get("occupancy") or {} for run in cell.get("runs", ())]
    if healed := max((one.get("recoveries") or 0 for one in occupancies), default=0):
        parts.append(f"healed {healed} x")
    seeds = [f"worst {cell['worst']:+.2f}"] if cell["seeds"] > 1 else []
    if cell["missing"]:
        seeds.append(f"{cell['seeds']} of {counted(cell['seeds'] + cell['missing'], 'seed')}")
    return first, ", ".join(parts), ", ".join(seeds)


def _cell(cell: Mapping[str, Any] | None) -> str:
    if cell is None:
        return ""
    first, *rest = figures(cell)
    more = ", ".join(part for part in rest if part)
    return f"{SIGNS[cell['verdict']]}: {first}" + (f" ({more})" if more else "")


def draw(results: Results, path: Path, theme: Theme = LIGHT) -> Path:
    """Draws the results of a table for a page of a theme."""
    cases, samplers = results["cases"], results["samplers"]
    width = max(NAMES + COLUMN * len(samplers) + 0.2, 8.5)
    height = HEAD + ROW * len(cases) + FOOT
    figure = new_figure((width, height), theme.page)
    axes: Any = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, width), ylim=(height, 0))
    axes.axis("off")
    title, others = titles(results)
    title, below = textwrap.fill(title, int(width * 8.6)), textwrap.fill(others, int(width * 11))
    axes.text(0.15, 0.12, title, va="top", color=theme.ink, fontsize=14, fontweight="bold")
    low = 0.12 + 0.28 * (title.count("\n") + 1)
    axes.text(0.15, low, below, va="top", color=theme.ink, fontsize=11)
    named = {"fontsize": 11.5, "color": theme.ink}
    for number, one in enumerate(samplers):
        middle = NAMES + COLUMN * (number + 0.5)
        heading = one["title"].replace(" (", "\n(")
        axes.text(middle, HEAD - 0.1, heading, ha="center", va="bottom", **named)
    for number, row in enumerate(cases):
        top = HEAD + ROW * number
        axes.text(0.15, top + ROW / 2, row["title"], va="center", **named)
        for column, one in enumerate(samplers):
            cell = row["cells"].get(one["name"])
            if cell is not None:
                colours = (ON_LIGHT if theme is LIGHT else ON_DARK)[cell["verdict"]]
                _draw_cell(axes, cell, NAMES + COLUMN * column, top, *colours)
    explained = textwrap.fill(HOW_TO_READ, int(width * 11))
    axes.text(0.15, height - FOOT + 0.12, explained, va="top", fontsize=10.5, color=theme.ink)
    return save_picture(figure, path, results, dpi=140)


def _draw_cell(
    axes: Any, cell: Mapping[str, Any], left: float, top: float, ground: str, ink: str
) -> None:
    from matplotlib.patches import FancyBboxPatch

    corner, size = (left + GAP, top + GAP), (COLUMN - 2 * GAP, ROW - 2 * GAP)
    look: Any = {"boxstyle": "round,pad=0,rounding_size=0.04", "edgecolor": "none"}
    axes.add_patch(FancyBboxPatch(corner, *size, facecolor=ground, **look))
    first, middle = figures(cell)[0], top + ROW / 2
    for x, text, size_of_type, side in (
        (left + 0.16, DRAWN_SIGNS[cell["verdict"]], 12, "center"),
        (left + 0.3, first, 11, "left"),
        (left + COLUMN - 0.08, _wrong(cell), 9.5, "right"),
    ):
        axes.text(x, middle, text, ha=side, va="center", fontsize=size_of_type, color=ink)


def _wrong(cell: Mapping[str, Any]) -> str:
    """What a cell that does not pass suffers from, in two words."""
    if cell["psnr"] is None or cell["verdict"] in ("pass", "no reference"):
        return ""
    if cell["gap"] is not None and (cell["lost_mass"] or 0.0) >= LOST:
        return f"lost {cell['lost_mass']:.0%}"
    return f"worst {cell['worst']:+.1f}" if cell["seeds"] > 1 else ""


def draw_side_by_side(pictures: Mapping[str, Path], title: str, path: Path) -> None:
    """Draws pictures in a row, each under its name."""
    figure = new_figure((VIEW * len(pictures), 0.75 * VIEW + 0.75))
    figure.text(0.01, 0.985, title, va="top", fontsize=11, fontweight="bold")
    for number, (name, picture) in enumerate(pictures.items()):
        left = number / len(pictures)
        axes = figure.add_axes((left + 0.008, 0.02, 1 / len(pictures) - 0.016, 0.78))
        with Image.open(picture) as image:
            shown = image.convert("RGBA")
        white = Image.new("RGBA", shown.size, "white")
        axes.imshow(Image.alpha_composite(white, shown), interpolation="nearest")
        axes.set_title(name, fontsize=10, loc="left", pad=4)
        axes.axis("off")
    save_whole(figure, path, dpi=110)
