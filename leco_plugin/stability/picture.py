"""`stability.png`: the table as a picture, to be read from across a room.

Colour, sign and words say the same, so that no reader depends on one of them.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from leco_plugin.chart.theme import LIGHT, SOURCE, Theme, fingerprint
from leco_plugin.stability.table import figures, headline

ROW, HEAD, FOOT = 0.36, 1.0, 0.7
"""Heights in inches."""
NAMES, COLUMN = 2.75, 2.0
"""Widths in inches."""
GAP = 0.03
SIGNS = {"pass": "✓", "degraded": "~", "fail": "✗", "no reference": "-"}
HOW_TO_READ = (
    "Each cell: PSNR against the dense run of the same host; samples kept, surfaces lost.  "
    "✓ within 0.2 dB and no bad seed   ~ degraded   ✗ fails   "
    "- nothing to compare with: the dense run does not train"
)


@dataclass(frozen=True)
class Tints:
    """Colours of cells on one kind of page: their ground, and the ink on it."""

    grounds: Mapping[str, str]
    inks: Mapping[str, str]


ON_LIGHT = Tints(
    {"pass": "#d7f0df", "degraded": "#fbeab8", "fail": "#f6c9c4", "no reference": "#eceef1"},
    {"pass": "#0f5a2f", "degraded": "#6b4c00", "fail": "#8c1d13", "no reference": "#656c76"},
)
ON_DARK = Tints(
    {"pass": "#12351f", "degraded": "#443408", "fail": "#551c17", "no reference": "#1c2128"},
    {"pass": "#86dfa6", "degraded": "#f2d06b", "fail": "#ff9f95", "no reference": "#9198a1"},
)


def draw(results: Mapping[str, Any], path: Path, theme: Theme = LIGHT) -> Path:
    """Draws the results of a table.

    Args:
        results: as in `stability.json`.
        path: of the picture.
        theme: of the page it is meant for.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows, samplers = results["cases"], results["samplers"]
    width = max(NAMES + COLUMN * len(samplers) + 0.2, 8.5)
    height = HEAD + ROW * len(rows) + FOOT
    figure = Figure(figsize=(width, height), facecolor=theme.page)
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_xlim(0, width)
    axes.set_ylim(height, 0)
    axes.axis("off")
    sentence = textwrap.fill(headline(results), int(width * 8.6))
    lines = sentence.count("\n") + 1
    size = 14 if lines < 3 else 11.5
    axes.text(0.15, 0.12, sentence, va="top", fontsize=size, fontweight="bold", color=theme.ink)
    for number, one in enumerate(samplers):
        middle = NAMES + COLUMN * (number + 0.5)
        axes.text(
            middle,
            HEAD - 0.1,
            one["title"],
            ha="center",
            va="bottom",
            fontsize=10.5,
            color=theme.ink,
        )
    for number, row in enumerate(rows):
        top = HEAD + ROW * number
        axes.text(0.15, top + ROW / 2, row["title"], va="center", fontsize=10.5, color=theme.ink)
        for column, one in enumerate(samplers):
            cell = row["cells"].get(one["name"])
            if cell is not None:
                _draw_cell(axes, cell, NAMES + COLUMN * column, top, theme)
    explained = textwrap.fill(HOW_TO_READ, int(width * 13))
    axes.text(0.15, height - FOOT + 0.12, explained, va="top", fontsize=9, color=theme.ink)
    figure.savefig(path, dpi=140, metadata={SOURCE: fingerprint(results)})
    return path


def _draw_cell(axes: Any, cell: Mapping[str, Any], left: float, top: float, theme: Theme) -> None:
    from matplotlib.patches import FancyBboxPatch

    tints = ON_LIGHT if theme is LIGHT else ON_DARK
    verdict = cell["verdict"]
    axes.add_patch(
        FancyBboxPatch(
            (left + GAP, top + GAP),
            COLUMN - 2 * GAP,
            ROW - 2 * GAP,
            boxstyle="round,pad=0,rounding_size=0.04",
            facecolor=tints.grounds[verdict],
            edgecolor="none",
        )
    )
    ink = tints.inks[verdict]
    first, second, seeds = figures(cell)
    middle = top + ROW / 2
    offset = 0.065 if second else 0.0
    axes.text(left + 0.17, middle, SIGNS[verdict], ha="center", va="center", fontsize=12, color=ink)
    axes.text(left + 0.33, middle - offset, first, va="center", fontsize=9.5, color=ink)
    right = left + COLUMN - 0.08
    axes.text(right, middle - offset, seeds, ha="right", va="center", fontsize=7, color=ink)
    if second:
        axes.text(left + 0.33, middle + 0.085, second, va="center", fontsize=7, color=ink)
