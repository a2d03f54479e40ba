"""`capacity.png`: what each representation keeps and loses for its bytes."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from leco_plugin.capacity.choice import NAMES, choose, common_volume, verdict
from leco_plugin.capacity.measuring import FAMILIES, VOLUMES
from leco_plugin.chart.theme import LIGHT, SOURCE, Theme, fingerprint, plain, style, themed

LEAST = 1e-5
"""Lost surface mass that is drawn for less, and for none at all."""


def draw(results: Mapping[str, Any], path: Path, theme: Theme = LIGHT) -> Path:
    """Draws two panels over the bytes: volume kept at equal loss, loss at equal volume.

    Args:
        results: as in `results.json`.
        path: of the picture.
        theme: of the page that it is meant for.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = results["representations"]
    volume = common_volume(rows)
    kept = [100.0 * row["kept_volume"] for row in rows]
    lost = [max(row["lost_at_volumes"][volume], LEAST) for row in rows]
    with themed(theme):
        figure = Figure(figsize=(11, 5.9), facecolor=theme.page)
        FigureCanvasAgg(figure)
        title = textwrap.fill(verdict(rows), 84)
        figure.text(0.015, 0.975, title, va="top", fontsize=15, fontweight="bold")
        figure.text(0.015, 0.862, circumstances(results), va="top", fontsize=11)
        panels = [figure.add_axes((0.065 + 0.485 * i, 0.2, 0.435, 0.55)) for i in range(2)]
        share = results["lost_surface_mass"]
        titles = (
            f"volume kept, %, when {share:.1%} of the surface mass is lost",
            f"surface mass lost when {VOLUMES[volume]:.1%} of the volume is kept",
        )
        for panel, values, heading in zip(panels, (kept, lost), titles):
            _draw_panel(panel, rows, values, theme)
            panel.set_title(heading, fontsize=12, loc="left")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(
            *(handles, labels), loc="lower center", ncols=len(labels), frameon=False, fontsize=10
        )
        figure.savefig(path, dpi=150, metadata={SOURCE: fingerprint(results)})
    return path


def _draw_panel(panel: Any, rows: Any, values: list[float], theme: Theme) -> None:
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    chosen = choose(rows)
    for number, family in enumerate(FAMILIES):
        points = sorted(
            (row["bytes"] / 1000, value)
            for row, value in zip(rows, values)
            if row["family"] == family
        )
        if points:
            dashes = (0, (4, 2)) if family == "grid" else "-"
            panel.plot(
                *zip(*points),
                **style(number, theme),
                linestyle=dashes,
                markersize=8,
                linewidth=1.8,
                label=NAMES[family],
            )
        if points and family == "grid":
            sizes = [int(row["size"]) for row in rows if row["family"] == family]
            for place, size in ((points[0], min(sizes)), (points[-1], max(sizes))):
                panel.annotate(
                    f"{size}$^3$",
                    place,
                    xytext=(0, 10),
                    textcoords="offset points",
                    ha="center",
                    fontsize=10,
                )
    for row, value in zip(rows, values):
        if row is chosen:
            place = (row["bytes"] / 1000, value)
            panel.plot(
                *place,
                marker="o",
                markersize=19,
                markerfacecolor="none",
                markeredgecolor=theme.ink,
                markeredgewidth=2,
            )
            panel.annotate(
                "chosen",
                place,
                xytext=(0, -24),
                textcoords="offset points",
                ha="center",
                fontsize=11,
                fontweight="bold",
            )
    panel.set(xscale="log", yscale="log", xlabel="kB")
    panel.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    panel.xaxis.set_minor_formatter(NullFormatter())
    if min(values) > 2 * LEAST and max(values) > 1.0:
        panel.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        panel.yaxis.set_minor_locator(LogLocator(subs=(2.0, 5.0)))
        panel.yaxis.set_minor_formatter(StrMethodFormatter("{x:g}"))
        panel.tick_params(axis="y", which="minor", labelsize=9)
    else:
        panel.yaxis.set_minor_formatter(NullFormatter())
    panel.margins(x=0.1, y=0.16)
    plain(panel, theme)


def circumstances(results: Mapping[str, Any]) -> str:
    """What was measured, in a line or two."""
    machine, scene = results["machine"], results["scene"]
    where = f"{machine['cores']} CPU cores" if machine["device"] == "cpu" else machine["device"]
    return (
        f"{scene['name']}, {scene['train_images']} photographs; one field of "
        f"{results['learn_steps']} steps teaches all; {results['rays']} held-out rays; {where}.\n"
        "Gates in bfloat16, grids one bit a cell; down and left is better. Ten times the bytes of "
        "the chosen save less than a third."
    )
