"""Charts from stored runs; nothing here trains or measures."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from leco_plugin.chart.theme import LIGHT, Theme, plain, style, themed

COLOURS = ("#0b6e8f", "#d1602b", "#6b8e23", "#7d4fa3", "#555555")
"""Told apart also in grey and by colour-blind readers."""
NEAR = 0.5
"""Decibels between two ends of curves from which their names are kept apart."""


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
        ends: list[float] = []
        for i, run in enumerate(runs):
            label = labels[i] if labels else str(run["method"])
            _draw_run(axes, run, label, style(i, theme), ends)
        axes.set_xlim(0, 1.04 * max(run["train_seconds"] for run in runs))
        axes.margins(y=0.12)
        axes.set_xlabel("seconds of training")
        axes.set_ylabel("PSNR on unseen photographs, dB\n(more is better)")
        plain(axes, theme)
        figure.savefig(path, dpi=120, metadata={SOURCE: fingerprint(runs)})
    return Path(path)


def _draw_run(
    axes: Any, run: dict[str, Any], label: str, look: dict[str, Any], ends: list[float]
) -> None:
    """A curve with its name at its end, clear of the ends of those before it, and its freezing."""
    seconds, values = zip(*run["curve"])
    axes.plot(seconds, values, linewidth=2.6, markersize=7, **look)
    below = any(0.0 <= end - values[-1] < NEAR for end in ends)
    ends.append(values[-1])
    axes.annotate(
        f"{label}: {values[-1]:.1f} dB",
        (seconds[-1], values[-1]),
        xytext=(4, -16 if below else 11),
        textcoords="offset points",
        ha="right",
        va="center",
        color=look["color"],
        fontweight="bold",
    )
    frozen = run.get("freeze_seconds")
    if frozen is not None:
        axes.axvline(frozen, color=look["color"], linestyle="--", linewidth=1.4)
        axes.annotate(
            f"what is empty\nis known after {frozen:.0f} s",
            (frozen, 0.82),
            xycoords=("data", "axes fraction"),
            xytext=(6, 0),
            textcoords="offset points",
            color=look["color"],
            fontsize=11,
        )


SOURCE = "Source"
"""Under which a picture remembers of which results it is."""


def fingerprint(values: Any) -> str:
    """What tells results from others: of JSON values."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()
