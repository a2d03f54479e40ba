"""Charts from stored runs; nothing here trains or measures."""

from __future__ import annotations

import hashlib
import json
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from leco_plugin.chart.drawing.theme import LIGHT, Theme, plain, style, themed

COLOURS = ("#0b6e8f", "#d1602b", "#6b8e23", "#7d4fa3", "#555555")
"""Told apart also in grey and by colour-blind readers."""
NAME_WIDTH = 18
"""Letters in a line of a curve's name."""
LINE_HEIGHT = 0.065
"""Of a line of text, as a share of the axes."""


def psnr_against_seconds(
    runs: Sequence[dict[str, Any]],
    path: str | Path,
    title: str,
    circumstances: str,
    labels: Sequence[str] = (),
    theme: Theme = LIGHT,
) -> Path:
    """PSNR on test images against seconds of training, the moment of freezing marked.

    Args:
        runs: as in `report.json`; `freeze_seconds` is optional.
        path: of the picture.
        title: what the chart shows, in one line.
        circumstances: of the runs, in another.
        labels: names of the curves; the methods by default.
        theme: of the page it is meant for.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with themed(theme):
        figure = Figure(figsize=(8, 4.4), layout="constrained", facecolor=theme.page)
        FigureCanvasAgg(figure)
        figure.suptitle(title, fontsize=14, fontweight="bold", x=0.01, ha="left")
        axes = figure.add_subplot()
        axes.set_title(circumstances, fontsize=11.5, loc="left")
        for i, run in enumerate(runs):
            _draw_run(axes, run, style(i, theme))
        axes.margins(y=0.12)
        _name_ends(axes, runs, labels or [str(run["method"]) for run in runs], theme)
        axes.set_xlim(0, 1.04 * max(run["train_seconds"] for run in runs))
        axes.set_xlabel("seconds of training")
        axes.set_ylabel("PSNR on unseen photographs, dB\n(more is better)")
        plain(axes, theme)
        figure.savefig(path, dpi=120, metadata={SOURCE: fingerprint(runs)})
    return Path(path)


def _draw_run(axes: Any, run: dict[str, Any], look: dict[str, Any]) -> None:
    """A curve and the moment of its freezing."""
    seconds, values = zip(*run["curve"])
    axes.plot(seconds, values, linewidth=2.6, markersize=7, **look)
    frozen = run.get("freeze_seconds")
    if frozen is not None:
        axes.axvline(frozen, color=look["color"], linestyle="--", linewidth=1.4)
        axes.annotate(
            f"what is empty\nis known after {frozen:.0f} s",
            (frozen, 0.06),
            xycoords=("data", "axes fraction"),
            xytext=(6, 0),
            textcoords="offset points",
            color=look["color"],
            fontsize=11,
        )


def _name_ends(
    axes: Any, runs: Sequence[dict[str, Any]], labels: Sequence[str], theme: Theme
) -> None:
    """The names of the curves right of their ends, from above down and clear of one another."""
    low, high = axes.get_ylim()
    last = [run["curve"][-1] for run in runs]
    beneath = high
    for i in sorted(range(len(runs)), key=lambda i: -last[i][1]):
        seconds, value = last[i]
        text = textwrap.fill(f"{labels[i]}: {value:.1f} dB", NAME_WIDTH)
        height = (high - low) * LINE_HEIGHT * (1 + text.count("\n"))
        beneath = min(value + height / 2.0, beneath) - height
        axes.annotate(
            text,
            (seconds, beneath + height / 2.0),
            xytext=(14, 0),
            textcoords="offset points",
            va="center",
            color=style(i, theme)["color"],
            fontweight="bold",
        )


SOURCE = "Source"
"""Under which a picture remembers of which results it is."""


def fingerprint(values: Any) -> str:
    """What tells results from others: of JSON values."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()
