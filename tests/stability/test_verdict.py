"""Claims about what runs say of a sampler."""

from __future__ import annotations

from typing import Any

import pytest

from leco_plugin.stability.verdict import judge


def run(seed: int = 0, psnr: float | None = 25.0, **measured: Any) -> dict[str, Any]:
    figures = {"lost_mass": 0.0, "kept_fraction": 0.2, "detail_psnr": None}
    figures["trivial_psnr"] = 12.0
    return {"seed": seed, "psnr": psnr, "measured": figures | measured}


def runs(*psnrs: float | None, **measured: Any) -> list[dict[str, Any]]:
    return [run(seed, psnr, **measured) for seed, psnr in enumerate(psnrs)]


DENSE = runs(25.0, 25.1, 24.9)


@pytest.mark.parametrize(
    ("psnrs", "verdict"),
    [
        ((24.81, 24.85, 24.9), "pass"),
        ((26.0, 26.0, 26.0), "pass"),
        ((24.79, 24.7, 24.9), "degraded"),
        *(((24.05,) * 3, "degraded"), ((23.95,) * 3, "fail"), ((23.9,) * 3, "fail")),
        *(((25.0, 25.0, 24.55), "pass"), ((25.0, 25.0, 24.45), "degraded")),
        *(((25.0, 25.0, 23.55), "degraded"), ((25.0, 25.0, 23.45), "fail")),
    ],
)
def test_median_and_worst_seed_are_judged(psnrs: tuple[float, ...], verdict: str) -> None:
    cell = judge(runs(*psnrs), DENSE)
    assert cell.verdict == verdict and bool(cell.reason) == (verdict != "pass")


def test_the_worst_seed_is_named() -> None:
    cell = judge(runs(25.0, 20.0, 25.0), DENSE)
    assert (cell.worst_seed, cell.worst) == (1, -5.0) and "seed 1 is 5.00 dB" in cell.reason


def test_a_surface_that_is_lost_is_a_failure_whatever_the_pictures_say() -> None:
    words = {0.0095: "pass", 0.0105: "degraded", 0.0495: "degraded", 0.0505: "fail"}
    for lost, word in words.items():
        assert judge(runs(25.0, lost_mass=lost), DENSE).verdict == word
    excused = runs(25.0, lost_mass=0.05)
    assert judge(runs(25.0, lost_mass=0.055), excused).verdict == "pass"


def test_a_wire_that_disappears_is_a_failure_though_it_costs_no_psnr() -> None:
    dense = runs(25.0, detail_psnr=20.0)
    words = {19.55: "pass", 19.45: "degraded", 18.05: "degraded", 17.95: "fail"}
    for psnr, word in words.items():
        assert judge(runs(25.0, detail_psnr=psnr), dense).verdict == word
    cell = judge(runs(25.0, detail_psnr=16.0), dense)
    assert cell.verdict == "fail" and "where it matters" in cell.reason


def test_nobody_is_held_to_a_reference_that_does_not_train() -> None:
    black = runs(12.3, 12.2, 12.4)
    assert judge(runs(11.5), black).verdict == "no reference"
    worse = judge(runs(5.0), black)
    assert worse.verdict == "degraded" and "below a dense run that does not train" in worse.reason
    assert judge(black, None).verdict == "fail"
    assert judge(runs(31.0, trivial_psnr=30.5), None).verdict == "pass"  # a sky is one colour
    for psnr, trivial, word in (
        *((13.05, 12.0, "pass"), (12.95, 12.0, "fail")),
        *((30.05, 29.5, "pass"), (29.95, 29.5, "fail"), (29.95, 28.9, "pass")),
    ):
        assert judge(runs(psnr, trivial_psnr=trivial), None).verdict == word


def test_a_run_that_ended_without_a_result_is_a_failure() -> None:
    cell = judge(runs(25.0), DENSE, ["out of memory"])
    assert cell.verdict == "fail" and cell.reason == "1 of 2 runs ended: out of memory"
    assert cell.psnr is None


def test_what_has_not_been_run_has_no_verdict() -> None:
    assert judge([], DENSE).verdict == "no reference"
    assert judge(runs(25.0), []).verdict == "no reference"


def test_a_reference_is_held_to_having_trained_only() -> None:
    cell = judge(DENSE, None)
    assert (cell.verdict, cell.gap, cell.psnr) == ("pass", None, 25.0)


@pytest.mark.parametrize(
    ("psnr", "measured", "reason"),
    [
        (None, {}, "seed 1 renders what is no number"),
        (25.0, {"lost_mass": None}, "seed 1 has no lost mass"),
        (25.0, {"detail_psnr": None}, "seed 1 has no detail psnr"),
        (25.0, {"kept_fraction": None}, "seed 1 has no kept fraction"),
    ],
)
def test_what_nobody_has_seen_is_not_passed(
    psnr: float | None, measured: dict[str, Any], reason: str
) -> None:
    dense = runs(25.0, 25.1, 24.9, detail_psnr=20.0)
    whole, other = (run(seed, detail_psnr=20.0) for seed in (0, 2))
    assert judge([whole, other], dense).verdict == "pass"
    blind = run(1, psnr, **{"detail_psnr": 20.0} | measured)
    cell = judge([whole, blind, other], dense)
    assert (cell.verdict, cell.reason, cell.seeds) == ("fail", reason, 3)


def test_where_no_surface_is_met_none_is_asked_for() -> None:
    nowhere = {"lost_mass": None}
    assert judge(runs(25.0, **nowhere), runs(25.0, **nowhere)).verdict == "pass"


def test_a_reference_that_renders_no_number_has_not_trained() -> None:
    assert judge(runs(25.0), runs(25.0, None, 25.2)).verdict == "pass"
    cell = judge(runs(25.0, 25.0, 25.0), runs(25.0, None, None))
    assert (cell.verdict, cell.gap) == ("no reference", None)
    assert judge(runs(25.0, None), None).verdict == "fail"


def test_only_the_same_seeds_are_compared() -> None:
    dense = runs(25.0, 20.0, 20.0)
    cell = judge([run(0, 24.5)], dense)
    assert (cell.verdict, cell.gap) == ("degraded", -0.5)
    cell = judge(runs(25.0, 24.7, 24.7), dense[:1])
    assert (cell.verdict, cell.gap, cell.psnr) == ("pass", 0.0, 24.7)
    assert judge([run(0, lost_mass=0.02)], [run(0), run(1, lost_mass=0.02)]).verdict == "degraded"


def test_a_reference_without_a_result_of_these_seeds_is_said_to_be_missing() -> None:
    for reference in ([], [run(1)]):
        cell = judge([run(0)], reference)
        assert (cell.verdict, cell.gap) == ("no reference", None)
        assert cell.reason == "the reference has no result"


def test_seeds_that_are_missing_are_counted() -> None:
    assert judge(runs(25.0), DENSE, missing=2).missing == 2
    assert judge([], DENSE, missing=3).missing == 3
    assert judge([], DENSE, ["out of memory"], missing=2).missing == 2


def test_only_surfaces_beyond_the_worst_seed_of_the_reference_count_as_lost() -> None:
    reference = [run(seed, 25.0, lost_mass=lost) for seed, lost in enumerate((0.0, 0.03, 0.01))]
    ours = [run(seed, 25.0, lost_mass=lost) for seed, lost in enumerate((0.035, 0.0, 0.0))]
    cell = judge(ours, reference)
    assert cell.verdict == "pass" and cell.lost_mass == 0.035
    ours[0]["measured"]["lost_mass"] = 0.045
    assert judge(ours, reference).reason == "1.5% of surfaces lost"
