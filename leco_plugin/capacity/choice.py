"""What `leco capacity` and `leco shrink` say and draw."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from leco_plugin.capacity.references import HOLDS, LOST_DECISIONS, Rung
from leco_plugin.capacity.search import MARGIN
from leco_plugin.chart.theme import (
    LIGHT,
    Theme,
    log_axis,
    new_figure,
    plain,
    save_picture,
    save_whole,
    style,
    themed,
)
from leco_plugin.evaluation.report import describe_cores
from leco_plugin.log import counted

Row = Mapping[str, Any]
"""What was measured of a representation."""

VOLUMES = (0.01, 0.015, 0.02, 0.03, 0.04, 0.06, 0.08, 0.11, 0.15, 0.2, 0.3, 0.45)
"""Kept volumes at which the loss is noted."""
TOLERANCE = 1.05
"""Kept volume that counts as no more than another's."""
TOLD_APART = 1.2
"""A representation certainly keeps more than another from this ratio of kept volumes on: all is
measured with one field and one seed."""
WORTH_TEN_TIMES = 2 / 3
"""Ten times the bytes must leave at most this share of the kept volume. The largest nearly always
keep a little less, and a scene would otherwise need the last one that is tried."""
USUAL_GRID = 128
"""Cells along an axis of the grids that hosts have by default, which any of them can afford."""
LEAST = 1e-5
"""Lost surface mass that is drawn for less, and for none at all."""
NAMES = {
    "frequency": "gate on frequencies",
    "hash": "gate on a hash grid",
    "vm": "gate on TensoRF's products",
    "k-planes": "gate on K-planes",
    "grid": "occupancy grid",
}


def stored_bytes(row: Row) -> int:
    """Of a gate, or of a grid as an octree, where that is known."""
    return max(1, row.get("octree_bytes", row["bytes"]))


def choose(rows: Sequence[Row]) -> Row:
    """The representation beside which no other keeps so much less that its bytes pay. One that
    keeps all is chosen only if all do."""
    power = -math.log10(WORTH_TEN_TIMES)

    def worth(row: Row) -> tuple[bool, float, int]:
        size = stored_bytes(row)
        return _keeps_all(row), row["kept_volume"] * size**power, size

    return min(rows, key=worth)


def _keeps_all(row: Row) -> bool:
    return bool(row["kept_volume"] >= 1.0)


def best_gate(rows: Sequence[Row]) -> Row | None:
    """The same of the gates alone; None without any."""
    gates = [row for row in rows if row["family"] != "grid"]
    return choose(gates) if gates else None


def smallest_grid(rows: Sequence[Row], chosen: Row, times: float = TOLERANCE) -> Row | None:
    """The smallest grid that keeps at most `times` the chosen volume; None where none does."""
    limit = times * chosen["kept_volume"]
    enough = [row for row in rows if row["family"] == "grid" and row["kept_volume"] <= limit]
    return min(enough, key=stored_bytes, default=None)


def grid_that_suffices(rows: Sequence[Row], times: float = TOLERANCE) -> Row | None:
    """A grid of a usual size that keeps at most `times` the chosen volume; None where none does."""
    grid = smallest_grid(rows, choose(rows), times)
    return grid if grid is not None and int(grid["size"]) <= USUAL_GRID else None


def answer(rows: Sequence[Row]) -> tuple[str, str]:
    """What the scene needs: in ten words at most, and in a sentence or two."""
    chosen = choose(rows)
    if _keeps_all(chosen):
        title = "At this loss nothing can be skipped"
        said = f"{title}: all keep the whole volume. Let the field learn longer (--learn-steps), or"
        return title, f"{said} allow a larger --lost-surface-mass; both in a new --out."
    size, kept = kilobytes(chosen), f"keeps {chosen['kept_volume']:.1%} of the volume"
    if chosen["family"] == "grid":
        title = f"A grid suffices: {_of_cells(chosen)}"
        said = f"{title}, {kept}"
        if gate := best_gate(rows):
            said += f"; the gate that pays most, {kilobytes(gate)}, {gate['kept_volume']:.1%}"
        return title.replace("^3", "³"), f"{said}."
    title, named = f"A gate of {size} suffices", f"a {NAMES[chosen['family']]} {kept}"
    said = f"This scene needs {size}: {named}."
    sizes = [int(row["size"]) for row in rows if row["family"] == "grid"]
    if grid := grid_that_suffices(rows):
        said = f"A grid suffices: {_of_cells(grid)}. With {size} {named}, as little."
        title += f", or {grid['size']}³ cells"
    elif nearly := grid_that_suffices(rows, TOLD_APART):
        said += f" A grid of {_of_cells(nearly)}, keeps {nearly['kept_volume']:.1%}: with one field"
        said += " the two are not told apart, and a grid may suffice."
        title += "; perhaps a grid"
    elif large := smallest_grid(rows, chosen):
        times = f"{stored_bytes(large) / stored_bytes(chosen):.1f} times as many bytes"
        times += " as an octree" if "octree_bytes" in large else ""
        said += f" A grid that keeps as little takes {large['size']}^3 cells, {times}."
    elif sizes:
        said += f" No grid up to {max(sizes)}^3 keeps as little."
    return title, said


def _of_cells(grid: Row) -> str:
    octree = " as an octree" if "octree_bytes" in grid else ""
    return f"{grid['size']}^3 cells, {kilobytes(grid)}{octree}"


def common_volume(rows: Sequence[Row]) -> int:
    """Number of the volume of `VOLUMES` at which losses are compared: what the chosen one keeps."""
    kept = max(choose(rows)["kept_volume"], VOLUMES[0])
    return min(range(len(VOLUMES)), key=lambda i: abs(VOLUMES[i] / kept - 1.0))


def kilobytes(row: Row) -> str:
    """The bytes of a representation, for people."""
    size = stored_bytes(row)
    return f"{size / 1000:.1f} kB" if size < 1e6 else f"{size / 1e6:.1f} MB"


def draw(results: Mapping[str, Any], path: Path, theme: Theme = LIGHT) -> Path:
    """Draws two panels over the bytes: volume kept at equal loss, loss at equal volume."""
    rows = [row for row in results["representations"] if not _keeps_all(row)]
    rows = rows or results["representations"]
    volume = common_volume(rows)
    kept = [100.0 * row["kept_volume"] for row in rows]
    lost = [max(row["lost_at_volumes"][volume], LEAST) for row in rows]
    with themed(theme):
        figure = new_figure((11, 5.9), theme.page)
        title, found = answer(rows)
        figure.text(0.015, 0.975, title, va="top", fontsize=17, fontweight="bold")
        lines = found.replace("^3", "³"), circumstances(results)
        said = "\n".join(textwrap.fill(line, 138) for line in lines)
        figure.text(0.015, 0.9, said, va="top", fontsize=11, parse_math=False)
        panels = [figure.add_axes((0.065 + 0.485 * i, 0.2, 0.435, 0.5)) for i in range(2)]
        share = results["lost_surface_mass"]
        titles = (
            f"volume kept, %, when {share:.1%} of the surface mass is lost",
            f"surface mass lost when {VOLUMES[volume]:.1%} of the volume is kept",
        )
        for panel, values, heading in zip(panels, (kept, lost), titles):
            _draw_panel(panel, rows, values, theme)
            panel.set_title(heading, fontsize=12, loc="left")
        handles, labels = panels[0].get_legend_handles_labels()
        below: Any = {"loc": "lower center", "ncols": len(labels), "frameon": False, "fontsize": 10}
        figure.legend(handles, labels, **below)
        return save_picture(figure, path, results, dpi=150)


def _draw_panel(panel: Any, rows: Sequence[Row], values: list[float], theme: Theme) -> None:
    beside = {"textcoords": "offset points", "ha": "center"}
    chosen = choose(rows)
    for number, (family, name) in enumerate(NAMES.items()):
        points = sorted(
            (stored_bytes(row) / 1000, value, row["size"])
            for row, value in zip(rows, values)
            if row["family"] == family
        )
        if not points:
            continue
        sizes, heights, _ = zip(*points)
        look = {**style(number, theme), "linestyle": (0, (4, 2)) if family == "grid" else "-"}
        panel.plot(sizes, heights, markersize=8, linewidth=1.8, label=name, **look)
        for kilobytes, value, cells in (points[0], points[-1]) if family == "grid" else ():
            place = (kilobytes, value)
            panel.annotate(f"{cells}$^3$", place, xytext=(0, 10), fontsize=10, **beside)
    place = next((stored_bytes(row) / 1000, v) for row, v in zip(rows, values) if row is chosen)
    ring = {"markerfacecolor": "none", "markeredgecolor": theme.ink, "markeredgewidth": 2}
    panel.plot(*place, marker="o", markersize=19, **ring)
    bold = {"fontsize": 11, "fontweight": "bold"}
    panel.annotate("chosen", place, xytext=(0, -24), **bold, **beside)
    panel.set(yscale="log", xlabel="kB")
    log_axis(panel, "x", (1.0,))
    if min(values) > 2 * LEAST and max(values) > 1.0:
        log_axis(panel, "y", (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0))
    panel.tick_params(axis="y", which="minor", labelleft=False)
    panel.margins(x=0.1, y=0.16)
    plain(panel, theme)


def circumstances(results: Mapping[str, Any]) -> str:
    machine, scene = results["machine"], results["scene"]
    rows = results["representations"]
    full = [row["size"] for row in rows if _keeps_all(row)]
    drawn = len(full) in (0, len(rows))  # all of them
    left_out = "" if drawn else f" (not drawn, as they keep all: {', '.join(full)})"
    where = describe_cores(machine) if machine["device"] == "cpu" else machine["device"]
    return (
        f"{scene['name']}, {scene['train_images']} photographs; one field of "
        f"{counted(results['learn_steps'], 'step')} teaches all; {results['rays']} held-out rays; "
        f"{where}. "
        f"Gates in bfloat16, grids as octrees{left_out}; down and left is better. "
        "Chosen: what has ten times the bytes does not keep a third less."
    )


LEAST_OF_A_GATE = 1e-6
"""Lost surface mass that is drawn for none at all."""


def line_of_lowered(itself: Rung, lowered: Mapping[str, float]) -> str:
    """At which threshold the original is shrunk instead, and what it loses there."""
    return (
        f"that leaves too little to a smaller gate: the original's threshold is lowered from "
        f"{lowered['from']:.3g} to {lowered['to']:.3g}, at which it keeps "
        f"{lowered['kept_volume']:.2f} times as much of the volume, counts as all of it below, and "
        f"{losses_in_words(itself)}"
    )


def losses_in_words(itself: Rung) -> str:
    """What the original loses by the bar of smaller gates."""
    price = "" if itself.image_price_db is None else f", {itself.image_price_db:+.3f} dB"
    lost = f"{itself.lost_surface_mass:.1e} of the surface mass, at most {itself.bound:.1e}"
    outside = "" if itself.verdict == HOLDS else f": it {itself.verdict} by this measure"
    return f"loses {lost}{price}{outside}"


def line_of(rung: Rung) -> str:
    price = "     -" if rung.image_price_db is None else f"{rung.image_price_db:+6.3f}"
    return (
        f"{rung.name:<28}{rung.params:>8} values {rung.bytes / 1000:>7.1f} kB  loses "
        f"{rung.lost_surface_mass:.1e}  {price} dB  keeps {rung.kept_volume:>6.1%} of the "
        f"original's volume  {rung.verdict}"
    )


def summary(results: Mapping[str, Any], out: Path) -> list[str]:
    """The outcome in a few lines, for the terminal."""
    before, after, checked = results["from"], results["to"], results["checked"]
    lines = []
    if results["original"]["verdict"] != HOLDS:
        lines.append("the original is not within these bounds: this is the same gate")
    elif not _is_chosen(results):
        lines.append("no smaller gate holds these bounds: this is the same gate")
    lines.append(
        f"{out}: {before['bytes'] / 1000:.1f} kB before, {after['bytes'] / 1000:.1f} kB now; asked "
        f"{results['query_speedup']:.1f} times faster"
    )
    lost, price = after.get("lost_surface_mass"), after.get("image_price_db")
    if lost is not None:
        cost = "" if price is None else f" and {price:+.3f} dB"
        lines.append(f"declares {lost:.2e} of the surface mass{cost}, the original's included")
    elif (lost := after.get(LOST_DECISIONS)) is not None:
        lines.append(
            f"drops {lost:.2e} of what the original keeps; no field was at hand, and neither "
            "surface mass nor image price was measured"
        )
    if "loss_measured_against" in after:
        lines.append(f"measured against {after['loss_measured_against']}")
    if checked is not None:
        found = checked["lost_surface_mass"]
        found = checked[LOST_DECISIONS] if found is None else found
        lines.append(f"{checked['rays']} rays of test photographs lose {found:.2e}")
        verified = after.get("verified_lost_surface_mass", lost) or 0.0
        if found > verified:
            lines.append(
                f"WARNING: that is more than the {verified:.2e} that other rays vouch for, and "
                "what the file declares: these photographs show too little of the scene. Learn "
                "from more of them or for longer, or keep the original"
            )
    return lines


def draw_gates(results: Mapping[str, Any], path: Path) -> Path:
    """Draws the gates that were tried; an ending of no known kind raises `ValueError`."""
    rungs = results["rungs"]
    sizes = [rung["bytes"] / 1000 for rung in rungs]
    losses = [max(rung["lost_surface_mass"], LEAST_OF_A_GATE) for rung in rungs]
    with themed(LIGHT):
        figure = new_figure((8.5, 5), layout="constrained")
        axes: Any = figure.subplots()
        axes.plot(sizes, losses, color=LIGHT.faint, linewidth=2, zorder=1)
        beside = {"textcoords": "offset points", "fontsize": 9.5}
        for rung, place in zip(rungs, zip(sizes, losses)):
            marker, size, colour = ("*", 18, 2) if rung["verdict"] == "chosen" else ("o", 8, 1)
            axes.plot(*place, marker, markersize=size, color=LIGHT.colours[colour])
            is_plain = rung["verdict"] == "loses too much"
            text = rung["name"] if is_plain else f"{rung['name']}: {rung['verdict']}"
            # turned, so that those of neighbours stand beside one another
            turned = {"rotation": 60, "rotation_mode": "anchor"}
            axes.annotate(text, place, xytext=(7, 7), **turned, **beside)
        allowed = results["bounds"]["lost_surface_mass"]
        for share, said in ((1.0, "may be declared"), (MARGIN, "may be lost in the search")):
            axes.axhline(share * allowed, color=LIGHT.ink, linestyle="--", linewidth=1)
            at_right = {"xycoords": ("axes fraction", "data"), "xytext": (-4, 4), "ha": "right"}
            axes.annotate(said, (1.0, share * allowed), **at_right, **beside)
        axes.set_xlim(0.7 * min(sizes, default=1.0), 4.0 * max(sizes, default=1.0))
        unknown = results["to"].get("lost_surface_mass") is None
        of_what = "lost decisions" if unknown else "lost surface mass"
        axes.set(yscale="log", xlabel="kB of weights", ylabel=of_what)
        axes.set_ylim(min([*losses, allowed]) / 3.0, 30.0 * max([*losses, allowed]))
        log_axis(axes, "x", (1.0,))
        plain(axes, LIGHT)
        axes.set_title(headline(results), loc="left", fontsize=13, fontweight="bold")
        return save_whole(figure, path, dpi=140)


def headline(results: Mapping[str, Any]) -> str:
    before, after = results["from"], results["to"]
    if not _is_chosen(results):
        return f"{before['bytes'] / 1000:.1f} kB, and nothing smaller holds the bounds"
    checked = after.get("lost_on_test_photographs")
    more = checked is not None and checked > after["verified_lost_surface_mass"]
    warned = f", but test photographs lose {checked:.1e}" if more else ""
    return (
        f"{before['bytes'] / 1000:.0f} kB to {after['bytes'] / 1000:.1f} kB, "
        f"{results['query_speedup']:.1f} times faster{warned}"
    )


def _is_chosen(results: Mapping[str, Any]) -> bool:
    return any(rung["verdict"] == "chosen" for rung in results["rungs"])
