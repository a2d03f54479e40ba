"""The frontier that `leco shrink` walked: what each gate loses against its size."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from leco_plugin.chart.theme import LIGHT, Theme, plain, themed
from leco_plugin.shrink.search import MARGIN

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
            plain_to_see = rung["verdict"] == "loses too much"
            axes.annotate(
                rung["name"] if plain_to_see else f"{rung['name']}: {rung['verdict']}",
                (size, lost),
                xytext=(7, 7),
                textcoords="offset points",
                rotation=60,  # so that those of neighbours stand beside one another
                rotation_mode="anchor",
                fontsize=9.5,
            )
        allowed = results["bounds"]["lost_surface_mass"]
        for share, said in ((1.0, "may be declared"), (MARGIN, "may be lost in the search")):
            axes.axhline(share * allowed, color=theme.ink, linestyle="--", linewidth=1)
            axes.annotate(
                said,
                (1.0, share * allowed),
                xycoords=("axes fraction", "data"),
                xytext=(-4, 4),
                textcoords="offset points",
                ha="right",
                fontsize=9.5,
            )
        axes.set_xlim(0.7 * min(sizes, default=1.0), 4.0 * max(sizes, default=1.0))
        unknown = results["to"].get("lost_surface_mass") is None
        of_what = "lost decisions" if unknown else "lost surface mass"
        axes.set(xscale="log", yscale="log", xlabel="kB of weights", ylabel=of_what)
        heights = [*losses, allowed]
        axes.set_ylim(min(heights) / 3.0, 30.0 * max(heights))
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
    if not any(rung["verdict"] == "chosen" for rung in results["rungs"]):
        return f"{before['bytes'] / 1000:.1f} kB, and nothing smaller holds the bounds"
    checked = after.get("lost_on_test_photographs")
    more = checked is not None and checked > after["verified_lost_surface_mass"]
    warned = f", but test photographs lose {checked:.1e}" if more else ""
    return (
        f"{before['bytes'] / 1000:.0f} kB to {after['bytes'] / 1000:.1f} kB, "
        f"{results['query_speedup']:.1f} times faster{warned}"
    )
