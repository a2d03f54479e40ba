"""The frontier that `leco shrink` walked: what each gate loses against its size."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from leco_plugin.chart.theme import LIGHT, Theme, plain, themed

LEAST = 1e-6
"""Lost surface mass that is drawn for none at all."""


def draw(results: Mapping[str, Any], path: Path, theme: Theme = LIGHT) -> Path:
    """Draws the gates that were tried.

    Args:
        results: as `leco shrink --json` writes them.
        path: of the picture; the ending chooses its kind.
        theme: of the page that it is meant for.
    Raises:
        OSError, ValueError: it cannot be written there, or is of no known kind.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import NullFormatter, StrMethodFormatter

    rungs = results["rungs"]
    with themed(theme):
        figure = Figure(figsize=(8.5, 5), facecolor=theme.page, layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots()
        sizes = [rung["bytes"] / 1000 for rung in rungs]
        losses = [max(rung["lost_surface_mass"], LEAST) for rung in rungs]
        axes.plot(sizes, losses, color=theme.faint, linewidth=2, zorder=1)
        for rung, size, lost in zip(rungs, sizes, losses):
            chosen = rung["verdict"] == "chosen"
            axes.plot(
                *(size, lost),
                marker="*" if chosen else "o",
                markersize=18 if chosen else 8,
                color=theme.colours[2] if chosen else theme.colours[1],
            )
            axes.annotate(
                f"{rung['name']}: {rung['verdict']}",
                (size, lost),
                xytext=(10, 6),
                textcoords="offset points",
                fontsize=9.5,
            )
        allowed = results["bounds"]["lost_surface_mass"]
        axes.axhline(allowed, color=theme.ink, linestyle="--", linewidth=1)
        axes.annotate(
            "allowed",
            (1.0, allowed),
            xycoords=("axes fraction", "data"),
            xytext=(-4, 4),
            textcoords="offset points",
            ha="right",
        )
        axes.set(xscale="log", yscale="log", xlabel="kB of weights", ylabel="lost surface mass")
        axes.set_xlim(0.7 * min(sizes), 3.5 * max(sizes))
        axes.margins(y=0.12)
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
        plain(axes, theme)
        axes.set_title(headline(results), loc="left", fontsize=13, fontweight="bold")
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=140)
    return path


def headline(results: Mapping[str, Any]) -> str:
    """What came out, in a line."""
    before, after = results["from"], results["to"]
    return (
        f"{before['bytes'] / 1000:.0f} kB to {after['bytes'] / 1000:.1f} kB, "
        f"{results['query_speedup']:.1f} times faster"
    )
