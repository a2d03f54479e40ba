"""What `leco shrink` says in the terminal."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from leco_plugin.shrink.references import LOST_DECISIONS
from leco_plugin.shrink.rungs import Rung
from leco_plugin.shrink.verifying import HOLDS


def line_of_original(itself: Rung, measured: bool) -> str:
    """What the original loses by the bar of smaller ones.

    Args:
        measured: whether a reference measures the original itself.
    """
    if not measured:
        return "nothing here measures what the original itself loses"
    return f"the original {_losses(itself)}"


def line_of_lowered(itself: Rung, facts: dict[str, float]) -> str:
    """At which threshold the original is shrunk instead, and what it loses there."""
    return (
        f"that leaves too little to a smaller gate: the original's threshold is lowered from "
        f"{facts['from']:.3g} to {facts['to']:.3g}, at which it keeps {facts['kept_volume']:.2f} "
        f"times as much of the volume, counts as all of it below, and {_losses(itself)}"
    )


def _losses(itself: Rung) -> str:
    price = "" if itself.image_price_db is None else f", {itself.image_price_db:+.3f} dB"
    lost = f"{itself.lost_surface_mass:.1e} of the surface mass, at most {itself.bound:.1e}"
    outside = "" if itself.verdict == HOLDS else f": it {itself.verdict} by this measure"
    return f"loses {lost}{price}{outside}"


def line_of(rung: Rung) -> str:
    """A rung as a line of the table."""
    price = "     -" if rung.image_price_db is None else f"{rung.image_price_db:+6.3f}"
    return (
        f"{rung.name:<28}{rung.params:>8} values {rung.bytes / 1000:>7.1f} kB  loses "
        f"{rung.lost_surface_mass:.1e}  {price} dB  keeps {rung.kept_volume:>6.1%} of the "
        f"original's volume  {rung.verdict}"
    )


def summary(results: dict[str, Any], out: Path) -> list[str]:
    """The outcome in a few lines, for the terminal."""
    before, after, checked = results["from"], results["to"], results["checked"]
    lines = []
    if results["original"]["verdict"] != HOLDS:
        lines.append("the original is not within these bounds: this is the same gate")
    elif not any(rung["verdict"] == "chosen" for rung in results["rungs"]):
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
        verified = after.get("verified_lost_surface_mass", lost)
        if found > (verified or 0.0):
            lines.append(
                f"WARNING: that is more than the {verified or 0.0:.2e} that other rays vouch for, "
                "and what the file declares: these photographs show too little of the scene. Learn "
                "from more of them or for longer, or keep the original"
            )
    return lines
