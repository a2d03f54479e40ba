"""Stores what each expert got while an occupancy was learned, from the history that a run has left,
and draws it.

ns-train leco-occupancy --data SCENE --pipeline.model.schedule.steps-per-record 8
python benchmarks/learning.py outputs/SCENE/leco-occupancy
"""

from __future__ import annotations

import argparse
import datetime
import math
import statistics
from pathlib import Path
from typing import Any

import checkout  # noqa: F401

from leco_plugin.chart.theme import LIGHT, SOURCE, Theme, fingerprint, plain, themed
from leco_plugin.cli_occupancy import occupancy_of
from leco_plugin.evaluation.history_picture import OPAQUE
from leco_plugin.evaluation.report import describe_machine
from leco_plugin.learning.history import FILE_NAME, GateHistory, as_learned
from leco_plugin.occupancy import Occupancy
from leco_plugin.scenes.whole_files import write_json

OUT = Path(__file__).resolve().parent / "results" / "learning.json"
LATE = 0.5
"""Share of the steps from which on means are taken: the distortion loss has come in by then."""


def report_of(history: GateHistory, scene: str, date: str) -> dict[str, Any]:
    """Steps, shares of points and mean densities of each expert, the empty-space one first."""
    return {
        "format": 1,
        "scene": scene,
        "date": date,
        "machine": describe_machine(),
        "steps": history.steps,
        "shares": [[round(float(x), 4) for x in row] for row in history.all("shares")],
        "densities": [
            [round(min(float(x), OPAQUE), 4) for x in row] for row in history.all("densities")
        ],
    }


def together(shares: list[list[float]], values: list[list[float]]) -> list[float | None]:
    """Mean over the points of all scene experts of what their own means are; None without any."""
    return [
        sum(a * b for a, b in zip(share[1:], value[1:])) / sum(share[1:])
        if sum(share[1:])
        else None
        for share, value in zip(shares, values)
    ]


def without_none(report: dict[str, Any]) -> list[list[float]]:
    """The densities, not a number where an expert gets no point."""
    return [
        [density if share else math.nan for share, density in zip(*rows)]
        for rows in zip(report["shares"], report["densities"])
    ]


def late_means(report: dict[str, Any]) -> tuple[float, float, float]:
    """Share of points at the empty-space expert, and the median densities, per half extent, of
    what it and what the scene experts get, over the later looks."""
    first = next(i for i, step in enumerate(report["steps"]) if step >= LATE * report["steps"][-1])
    shares, densities = report["shares"][first:], report["densities"][first:]
    return (
        statistics.fmean(share[0] for share in shares),
        statistics.median(density[0] for density in densities),
        statistics.median(x for x in together(shares, densities) if x is not None),
    )


def headline(report: dict[str, Any]) -> str:
    """The finding in ten words at most."""
    return f"The empty-space expert takes {late_means(report)[0]:.0%} of the points"


def sentence(report: dict[str, Any]) -> str:
    """What the picture shows, with two digits."""
    _, empty, scene = late_means(report)
    if not empty:
        return f"{headline(report)}, which have no density"
    times = float(f"{scene / empty:.2g}")
    return f"{headline(report)}; they are about {times:,.4g} times less dense than the rest"


def draw(path: Path, report: dict[str, Any], theme: Theme = LIGHT) -> Path:
    """Share of points and mean density of each expert against steps.

    Args:
        path: of the picture.
        report: as in `learning.json`.
        theme: of the page it is meant for.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with themed(theme, 11.5):
        figure = Figure(figsize=(10.0, 4.4), facecolor=theme.page, layout="constrained")
        FigureCanvasAgg(figure)
        figure.suptitle(headline(report), fontsize=15, fontweight="bold", x=0.01, ha="left")
        shares, densities = figure.subplots(1, 2)
        steps = report["steps"]
        known = {"shares": report["shares"], "densities": without_none(report)}
        for axes, name, factor in ((shares, "shares", 100.0), (densities, "densities", 1.0)):
            for expert in range(1, len(report["shares"][0])):
                each = [factor * row[expert] for row in known[name]]
                label = "each scene expert" if expert == 1 else None
                axes.plot(steps, each, color=theme.colours[1], alpha=0.35, label=label)
            look = {"linewidth": 3.0, "color": theme.colours[1], "label": "all scene experts"}
            whole = together(report["shares"], report["densities"])
            if axes is shares:
                whole = [factor * sum(row[1:]) for row in report["shares"]]
            axes.plot(steps, whole, **look)
            look |= {"color": theme.colours[0], "label": "empty-space expert"}
            axes.plot(steps, [factor * row[0] for row in known[name]], **look)
        shares.set_title("share of the points, %", fontsize=11.5, loc="left")
        shares.set_ylim(0.0, 100.0)
        densities.set_title("mean density of their points (10⁴: opaque)", fontsize=11.5, loc="left")
        densities.set_yscale("log")
        densities.set_ylim(1e-2, 2.0 * OPAQUE)
        for axes in (shares, densities):
            axes.set_xlabel("step of learning")
            axes.set_xlim(0, report["steps"][-1])
            plain(axes, theme)
        handles, names = shares.get_legend_handles_labels()
        figure.legend(
            handles[::-1], names[::-1], loc="outside lower center", ncols=3, frameon=False
        )
        figure.savefig(path, dpi=140, metadata={SOURCE: fingerprint(report)})
    return path


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).split("\n\n")[0])
    parser.add_argument("run", type=Path, help="folder of runs, the newest of which is taken")
    file = occupancy_of(parser.parse_args().run)
    history = file.parent / FILE_NAME
    date = datetime.date.fromtimestamp(history.stat().st_mtime).isoformat()
    found = GateHistory.load(history, as_learned(Occupancy.load(file)).gate)
    write_json(OUT, report_of(found, file.resolve().parents[2].name, date))
    print(f"wrote {OUT}")


if __name__ == "__main__":
    main()
