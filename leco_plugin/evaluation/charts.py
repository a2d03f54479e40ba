"""Charts from stored runs; nothing here trains or measures."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

COLOURS = ("#0b6e8f", "#d1602b", "#6b8e23", "#7d4fa3", "#555555")
"""Told apart also in grey and by colour-blind readers, together with the markers."""
MARKERS = "osD^v"


def psnr_against_seconds(
    runs: Sequence[dict[str, Any]], path: str | Path, title: str, labels: Sequence[str] = ()
) -> Path:
    """PSNR on test images against seconds of training, the moment of freezing marked.

    Args:
        runs: as in `report.json`; `freeze_seconds` is optional.
        path: of the picture.
        title: one line over the chart.
        labels: names of the curves; the methods by default.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 4.4), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    longest = max(run["train_seconds"] for run in runs)
    ends: list[float] = []
    for i, run in enumerate(runs):
        seconds, values = zip(*run["curve"])
        colour = COLOURS[i % len(COLOURS)]
        label = labels[i] if labels else run["method"]
        axes.plot(
            seconds,
            values,
            color=colour,
            marker=MARKERS[i % len(MARKERS)],
            linewidth=2.4,
            label=label,
        )
        axes.annotate(
            f" {values[-1]:.1f} dB",
            (seconds[-1], values[-1]),
            xytext=(6, _clear_of(values[-1], ends)),
            textcoords="offset points",
            va="center",
            color=colour,
            fontsize=12,
            fontweight="bold",
        )
        ends.append(values[-1])
        frozen = run.get("freeze_seconds")
        if frozen is not None:
            axes.axvline(frozen, color=colour, linestyle="--", linewidth=1.4)
            axes.annotate(
                f"occupancy frozen\nafter {frozen:.0f} s",
                (frozen, 0.86),
                xycoords=("data", "axes fraction"),
                xytext=(6, 0),
                textcoords="offset points",
                color=colour,
                fontsize=11,
            )
    axes.set_xlim(0, 1.14 * longest)
    axes.set_xlabel("seconds of training", fontsize=12)
    axes.set_ylabel("PSNR on test images, dB", fontsize=12)
    axes.set_title(title, fontsize=13, loc="left")
    axes.grid(color="#dddddd")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=12, loc="best")
    figure.savefig(path, dpi=120, metadata={SOURCE: fingerprint(runs)})
    return Path(path)


SOURCE = "Source"
"""Under which a picture remembers of which results it is."""


def fingerprint(values: Any) -> str:
    """What tells results from others: of JSON values."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def _clear_of(value: float, others: Sequence[float]) -> int:
    """Points by which a label is moved so that it does not lie on an earlier one."""
    near = [other for other in others if abs(other - value) < 0.5]
    if not near:
        return 0
    return 9 if value >= near[-1] else -9
