"""Draws `growth.json`: bytes of gate and grid, and seconds to learn, against the built area."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from leco_plugin.chart.theme import LIGHT, plain, style


def draw(path: Path, report: dict[str, Any]) -> Path:
    """Two panels with logarithmic axes; a figure that is not there is left out."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 4.2), facecolor=LIGHT.page, layout="constrained")
    FigureCanvasAgg(figure)
    memory, time = figure.subplots(1, 2)
    panels = [
        (memory, "bytes of the occupancy", [("gate_bytes", "gate"), ("grid_bytes", "grid")]),
        (time, "seconds to learn", [("seconds", "gate")]),
    ]
    for axes, label, lines in panels:
        for number, (name, what) in enumerate(lines):
            _line(axes, report, name, what, number)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xlabel("built area, square metres", color=LIGHT.ink)
        axes.set_ylabel(label, color=LIGHT.ink)
        plain(axes, LIGHT)
        if axes.get_legend_handles_labels()[1]:
            axes.legend(frameon=False)
    figure.savefig(path, dpi=120)
    return path


def _line(axes: Any, report: dict[str, Any], name: str, what: str, number: int) -> None:
    rows = [row for row in report["rows"] if row[name]]
    if not rows:
        return
    exponent = report["exponents_with_area"][name]
    label = what if exponent is None else f"{what}: grows as area to the {exponent:.2f}"
    areas = [row["area_square_metres"] for row in rows]
    axes.plot(areas, [row[name] for row in rows], label=label, **style(number, LIGHT))
