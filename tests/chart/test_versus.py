"""Claims about pairs of contenders."""

from __future__ import annotations

import pytest
from chart_results import results, run

from leco_plugin.chart.drawing.table import table
from leco_plugin.chart.findings.summary import lines_of, seconds_to_pass
from leco_plugin.chart.findings.versus import rivals

CURVE = [[10.0, 18.0], [20.0, 20.0], [30.0, 19.0], [40.0, 21.0]]


@pytest.mark.parametrize(
    ("psnr", "seconds"), [(17.0, 10.0), (19.0, 15.0), (20.0, 35.0), (20.5, 37.5), (21.1, None)]
)
def test_a_curve_passes_between_its_points_to_stay_above(psnr, seconds) -> None:
    assert seconds_to_pass(CURVE, psnr) == (None if seconds is None else pytest.approx(seconds))


def of_seeds(sampler: str, psnrs: list[float], **figures: object) -> list[dict]:
    return [
        run(f"host + {sampler}", seed, psnr, sampler=sampler, **figures)
        for seed, psnr in enumerate(psnrs)
    ]


def test_seeds_are_paired_and_those_that_one_lacks_are_left_out() -> None:
    ours = of_seeds("learned-occupancy", [21.0, 22.0, 30.0], render_seconds_per_image=0.5)
    theirs = of_seeds("own", [20.0, 19.0])
    (found,) = rivals(lines_of(results(*ours, *theirs)))
    assert found.gains == (1.0, 3.0)
    assert found.passed == (9.0, 7.0)  # a decibel a second until second ten
    assert found.sooner == pytest.approx((10 / 9, 10 / 7))
    assert found.faster == (2.0, 2.0)


def test_a_last_step_beyond_the_time_that_was_given_is_nobodys_gain() -> None:
    lines = lines_of(results(*of_seeds("learned-occupancy", [21.0]), *of_seeds("own", [20.0])))
    (found,) = rivals(lines, seconds=9.0)
    assert found.passed == (9.0,) and found.sooner == (1.0,)


def test_other_methods_are_no_rivals() -> None:
    ours = of_seeds("learned-occupancy", [21.0])
    assert not rivals(lines_of(results(*ours, run("other", method="nerfacto", sampler="own"))))


def test_what_is_never_passed_is_a_dash() -> None:
    runs = of_seeds("learned-occupancy", [19.0]) + of_seeds("own", [20.0])
    text = table(results(*runs))
    (row,) = [line for line in text.splitlines() if "learned-occupancy against own" in line]
    assert row.split(" | ")[1:] == ["1", "-1.00", "-", "-", "1.0 |"]
