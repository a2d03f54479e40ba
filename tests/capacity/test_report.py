"""Claims about what the file of a shrunk gate declares."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from ball_occupancy import ball_of_the_tiny_scene

from leco_plugin.capacity import references, search, shrink
from leco_plugin.capacity.evidence import Evidence
from leco_plugin.occupancy import Occupancy


def reported(
    original: Occupancy,
    smaller: Occupancy,
    rung: references.Rung,
    is_untrained: bool = False,
    lowered: dict[str, float] | None = None,
    checked: dict[str, Any] | None = None,
    mixture: Any = None,
) -> dict[str, Any]:
    """What the file of a smaller gate declares, measured on three rays of one or two fields."""
    nothing = torch.zeros(0)
    part = references.Part(Evidence(nothing, nothing, nothing, nothing, nothing, rays=3))
    known = references.Reference(references.NOW, mixture, 0.0, 0.0, 0.0, part, part)
    fields = [known] if mixture is None else [known, known._replace(name="another")]
    here = references.Ground(original, part.evidence, fields)
    return shrink._report_of(here, smaller, rung, is_untrained, lowered, checked)


VERIFIED = {
    **{"lost_surface_mass": 1e-4, "lost_surface_mass_bound": 2e-4, "lost_mass": 3e-4},
    **{"image_price_db": 0.04, "empty_fraction": 0.5, "kept_candidates_dropped": 0.06},
}
"""Of a rung, all of them different."""


@pytest.mark.parametrize("lower", [0.2, None])
def test_the_kept_volume_is_of_the_file_that_was_shrunk_whatever_its_threshold_became(
    lower: float | None,
) -> None:
    given = ball_of_the_tiny_scene()
    original = given if lower is None else given.with_threshold(lower)
    smaller = original.with_threshold(0.05)
    of_given, of_original, of_smaller = map(search.kept_of_box, (given, original, smaller))
    lowered = {"from": given.threshold, "to": original.threshold}
    lowered["kept_volume"] = of_original / of_given
    rung = references.Rung("", 1, 2, of_smaller / of_original, 0.0, None, "chosen", 0.0, VERIFIED)
    said = None if lower is None else lowered
    kept = reported(original, smaller, rung, lowered=said)["kept_volume_of_the_original"]
    assert kept == pytest.approx(of_smaller / of_given, abs=1e-4) and kept > 1.01


@pytest.mark.parametrize("is_untrained", [True, False])
@pytest.mark.parametrize("held_out", [True, False, None])
def test_every_figure_is_declared_by_its_name_and_held_out_where_both_were(
    is_untrained: bool, held_out: bool | None
) -> None:
    given = ball_of_the_tiny_scene()
    given.report = {"near": 0.05, "frame": given.report["frame"], "lost_surface_mass": 1e-5}
    given.report |= {} if held_out is None else {"held_out": held_out}
    rung = references.Rung("", 7, 14, 0.9, 0.0, None, "chosen", 0.0, VERIFIED)
    smaller, field = given.with_threshold(0.05), object()
    report = reported(given, smaller, rung, is_untrained, mixture=field)
    assert report == {
        "near": 0.05,
        "frame": given.report["frame"],
        "params": 7,
        "threshold": pytest.approx(0.05),
        "kept_candidates_dropped": 0.06,
        "shrunk_from_params": given.num_params,
        "kept_volume_of_the_original": 0.9,
        "lost_surface_mass": 2e-4,
        "lost_mass": 3e-4,
        "image_price_db": 0.04,
        "empty_fraction": 0.5,
        "calibration_rays": 3,
        "held_out": is_untrained and held_out is True,
        "loss_measured_against": f"{references.NOW}; another",
    }
    alone = reported(given, smaller, rung, is_untrained)
    assert {name: alone[name] for name in alone if alone[name] != report.get(name)} == {
        "lost_decisions": 2e-4,
        "lost_surface_mass": None,
        "lost_mass": None,
        "loss_measured_against": references.NOW,
    }
    for lost in (1e-4, 5e-4):
        tested = reported(given, smaller, rung, checked={"lost_surface_mass": lost}, mixture=field)
        assert tested["lost_surface_mass"] == max(lost, 2e-4)
        assert tested["verified_lost_surface_mass"] == 2e-4
        assert tested["lost_on_test_photographs"] == lost
