"""Claims about what the file of a shrunk gate holds and declares."""

from __future__ import annotations

import copy
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from ball_occupancy import ball_of_the_tiny_scene

from leco_plugin.capacity import references, search, shrink, sources
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


@pytest.mark.parametrize("model", [None, object()])
def test_photographs_that_decided_nothing_say_the_worst_of_all_references(
    model: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    shares, seen = {"one": 0.1, "another": 0.3, "a third": 0.2}, [SimpleNamespace(truth=[0] * 7)]
    monkeypatch.setattr(sources, "draw_test_rays", lambda *given: seen[0])
    monkeypatch.setattr(references, "measure_shares_lost", lambda *given: shares)
    given: Any = sources.Source(None, model), None, None
    worst = {"lost_surface_mass": None if model is None else 0.3}
    worst |= {"lost_decisions": 0.3} if model is None else {}
    assert shrink._check_on_test_photographs(*given) == {"rays": 7, **worst, "against": shares}
    shares.clear()
    assert shrink._check_on_test_photographs(*given) is None
    seen[0] = None
    assert shrink._check_on_test_photographs(*given) is None


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
@pytest.mark.parametrize(
    ("verdict", "looks", "look"),
    [
        ("holds", [], 1),
        ("holds", [None, 2, 4, None], 5),
        ("is not within the bounds", None, 1),  # and nothing smaller is looked for
        ("holds", [3], None),  # nothing measures it
    ],
)
def test_an_original_that_is_stored_again_is_verified_by_one_look_more(
    verdict: str,
    looks: list[int | None] | None,
    look: int | None,
    precision: Any,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    original = copy.deepcopy(ball_of_the_tiny_scene())
    original.precision = precision
    before = copy.deepcopy(original.gate.state_dict())
    itself = references.Rung("", 1, 2, 1.0, 0.0, None, verdict, 0.0)

    def searched(*given: Any, **more: Any) -> search.Found:
        assert looks is not None
        return search.Found(None, [SimpleNamespace(look=one) for one in looks])  # type: ignore[misc]

    asked: list[Any] = []
    monkeypatch.setattr(shrink, "search", searched)
    monkeypatch.setattr(references, "verify", lambda *given: asked.append(given[1:]))
    ground: Any = SimpleNamespace(original=original, measures_original=look is not None)
    bounds = references.Bounds()
    found = shrink._find_smaller(ground, bounds, itself, lambda rung: None)
    assert found == (original, itself)
    assert asked == ([] if look is None else [(original, bounds, itself, look)])
    for name, now in original.gate.state_dict().items():
        is_rounded = precision == "bfloat16" and name.startswith("hidden.")
        was = before[name].bfloat16().float() if is_rounded else before[name]
        assert torch.equal(now, was), name
