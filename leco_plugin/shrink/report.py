"""What a smaller occupancy says of itself: the original's report, its losses measured anew."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from leco_plugin.occupancy import BACKDROP_PRICE
from leco_plugin.shrink.references import LOST_DECISIONS, names_of
from leco_plugin.shrink.rungs import Found, Ground, Rung
from leco_plugin.shrink.verifying import is_measured

COPIED = (
    *("step", "train_seconds", "bounds", "near", "far", "step_size", "cone_angle", "aabb"),
    *("frame", "data_frame", "cameras", BACKDROP_PRICE),
)
"""What a smaller occupancy's report takes over from the original's."""


def report_of(
    ground: Ground, found: Found, itself: Rung, untrained: bool, kept_more: float = 1.0
) -> dict[str, Any]:
    """What the smaller occupancy declares: the original's loss and, on top, its own.

    Args:
        itself: the original, which is stored again where nothing smaller holds.
        untrained: whether nothing was trained on the pixels of the ground's rays.
        kept_more: times the volume that the original keeps at its own threshold, which the ground's
            keeps.
    """
    original = ground.original
    report = {name: original.report[name] for name in COPIED if name in original.report}
    if "cameras" in report:
        report["cameras"] = [[round(float(x), 4) for x in row] for row in report["cameras"]]
    if found.occupancy is None:
        report = {**original.report, **report, "threshold": original.threshold}
        return report | (_measured(ground, itself, untrained) if is_measured(ground) else {})
    rung = found.rungs[-1]
    return (
        report
        | _measured(ground, rung, untrained)
        | {
            "params": rung.params,
            "threshold": found.occupancy.threshold,
            "kept_candidates_dropped": rung.verified["kept_candidates_dropped"],
            "shrunk_from_params": original.num_params,
            "kept_volume_of_the_original": round(kept_more * rung.kept_volume, 4),
        }
    )


def with_test_photographs(
    report: dict[str, Any], checked: Mapping[str, Any] | None
) -> dict[str, Any]:
    """A report that declares no less than what rays of test photographs have lost.

    Args:
        checked: what those have lost, None where there are none. They have chosen nothing; what
            holds without them stays beside it.
    """
    lost = None if checked is None else checked["lost_surface_mass"]
    verified = report.get("lost_surface_mass")
    if lost is None or verified is None:
        return report
    return report | {
        "lost_surface_mass": max(verified, lost),
        "verified_lost_surface_mass": verified,
        "lost_on_test_photographs": lost,
    }


def _measured(ground: Ground, rung: Rung, untrained: bool) -> dict[str, Any]:
    """Of a report, what was measured on rays that the search did not see."""
    measured, first = rung.verified, ground.references[0]
    alone = first.model is None
    return {
        **lost_by_name(alone, measured["lost_surface_mass_bound"]),
        "lost_mass": None if alone else measured["lost_mass"],
        "image_price_db": measured["image_price_db"],
        "empty_fraction": measured["empty_fraction"],
        "calibration_rays": first.verify.evidence.rays,
        "held_out": untrained and bool(ground.original.report.get("held_out", False)),
        "loss_measured_against": names_of(ground.references),
    }


def lost_by_name(alone: bool, share: float | None) -> dict[str, float | None]:
    """A loss by its name: without a field it is one of decisions, and that of surfaces unknown."""
    if alone:
        return {"lost_surface_mass": None, LOST_DECISIONS: share}
    return {"lost_surface_mass": share}
