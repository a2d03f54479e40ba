"""What `leco shrink` says and draws: what each gate that was tried loses against its size."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from leco_plugin.capacity.references import HOLDS, LOST_DECISIONS, Rung
from leco_plugin.capacity.search import MARGIN
from leco_plugin.chart.theme import LIGHT, log_axis, new_figure, plain, themed

LEAST = 1e-6
"""Lost surface mass that is drawn for none at all."""


def line_of_original(itself: Rung, measured: bool) -> str:
    """What the original loses by the bar of smaller gates, if a reference measures it."""
    if not measured:
        return "nothing here measures what the original itself loses"
    return f"the original {_losses(itself)}"


def line_of_lowered(itself: Rung, lowered: Mapping[str, float]) -> str:
    """At which threshold the original is shrunk instead, and what it loses there."""
    return (
        f"that leaves too little to a smaller gate: the original's threshold is lowered from "
        f"{lowered['from']:.3g} to {lowered['to']:.3g}, at which it keeps "
        f"{lowered['kept_volume']:.2f} times as much of the volume, counts as all of it below, and "
        f"{_losses(itself)}"
    )


def _losses(itself: Rung) -> str:
    price = "" if itself.image_price_db is None else f", {itself.image_price_db:+.3f} dB"
    lost = f"{itself.lost_surface_mass:.1e} of the surface mass, at most {itself.bound:.1e}"
    outside = "" if itself.verdict == HOLDS else f": it {itself.verdict} by this measure"
    return f"loses {lost}{price}{outside}"


def line_of(rung: Rung) -> str:
    """A gate as a line of the table."""
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


def draw(results: Mapping[str, Any], path: Path) -> Path:
    """Draws the gates that were tried.

    Args:
        results: as `leco shrink --json` writes them.
        path: of the picture; the ending chooses its kind.
    Raises:
        OSError, ValueError: it cannot be written there, or is of no known kind.
    """
    rungs = results["rungs"]
    sizes = [rung["bytes"] / 1000 for rung in rungs]
    losses = [max(rung["lost_surface_mass"], LEAST) for rung in rungs]
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
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=140)
    return path


def headline(results: Mapping[str, Any]) -> str:
    """What came out, in a line."""
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
