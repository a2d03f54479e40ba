"""Draws `growth.json`: bytes of gate and grid, and seconds to learn, against the built area."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from leco_plugin.chart.theme import LIGHT, SOURCE, Theme, fingerprint, plain, style, themed

PANELS = (
    (
        "bytes of the occupancy",
        (("gate_bytes", "gate, by its rule"), ("grid_bytes", "grid, a bit a cell")),
    ),
    (
        "seconds",
        (("seconds", "learning the gate"), ("grid_seconds", "filling the grid from that field")),
    ),
)


def draw(path: Path, report: dict[str, Any], theme: Theme = LIGHT) -> Path:
    """Two panels with logarithmic axes; a figure that is not there is left out.

    Args:
        path: of the picture.
        report: as in `growth.json`.
        theme: of the page it is meant for.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with themed(theme, 11.5):
        figure = Figure(figsize=(10.0, 4.4), facecolor=theme.page, layout="constrained")
        FigureCanvasAgg(figure)
        for axes, (label, lines) in zip(figure.subplots(1, 2), PANELS):
            for number, (name, what) in enumerate(lines):
                _line(axes, report, name, what, number, theme)
            axes.set_xscale("log")
            axes.set_yscale("log")
            axes.set_xlabel("built area, square metres")
            axes.set_ylabel(label)
            plain(axes, theme)
            if axes.get_legend_handles_labels()[1]:
                axes.legend(frameon=False, loc="lower left", bbox_to_anchor=(0.0, 1.0))
        figure.savefig(path, dpi=140, metadata={SOURCE: fingerprint(report)})
    return path


def _line(
    axes: Any, report: dict[str, Any], name: str, what: str, number: int, theme: Theme
) -> None:
    rows = [row for row in report["rows"] if row[name]]
    if not rows:
        return
    exponent = report["exponents_with_area"][name]["all"]
    of = "" if len(rows) == len(report["rows"]) else f", in {len(rows)} of {len(report['rows'])}"
    label: str | None = what
    if exponent is not None:
        label = f"{what}: as area to the {exponent:.2f}{of}"
    for seed in sorted({row["seed"] for row in rows}):
        points = [(row["area_square_metres"], row[name]) for row in rows if row["seed"] == seed]
        axes.plot(*zip(*points), label=label, **style(number, theme))
        label = None
    if name == "grid_bytes":
        _without_a_grid(axes, report, number, theme)


def _without_a_grid(axes: Any, report: dict[str, Any], number: int, theme: Theme) -> None:
    """Arrows from the largest grid that was tried, where none keeps as little as the gate."""
    missing = [
        (row["area_square_metres"], max(grid["bytes"] for grid in row["grids"]))
        for row in report["rows"]
        if row["grid_bytes"] is None and row["grids"]
    ]
    colour = theme.colours[number % len(theme.colours)]
    for place, (area, most) in enumerate(missing):
        arrow = {"arrowstyle": "<-", "color": colour, "linewidth": 1.6}
        axes.annotate("", (area, most), (area, 3.0 * most), arrowprops=arrow)
        said = None if place else "no grid up to here keeps as little"
        axes.plot([area], [most], "_", color=colour, markersize=12, label=said)
        axes.plot([area], [4.0 * most], alpha=0.0)
