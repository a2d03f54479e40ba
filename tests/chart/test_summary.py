"""Claims about what the runs of a chart say together."""

from __future__ import annotations

import pytest
from chart_results import results, run, slow_front
from hypothesis import given
from hypothesis import strategies as st

from leco_plugin.chart.findings.summary import (
    KEPT,
    MEMORY,
    RENDERING,
    circumstances,
    common_psnr,
    front,
    headline,
    lines_of,
)


@given(st.lists(st.tuples(st.integers(0, 8), st.integers(0, 8)), max_size=12))
def test_the_front_is_what_nothing_beats(points: list[tuple[float, float]]) -> None:
    members = front(points)
    assert {points[i] for i in members} == slow_front(points)
    costs = [points[i][0] for i in members]
    assert costs == sorted(costs)


def test_seeds_are_one_line_with_means_of_quality_and_medians_of_cost() -> None:
    runs = [
        run("A", seed, psnr, render_seconds_per_image=seconds)
        for seed, (psnr, seconds) in enumerate([(20.0, 1.0), (21.0, 9.0), (22.0, 2.0)])
    ]
    (line,) = lines_of(results(*runs))
    assert line.psnr == pytest.approx(21.0)
    assert line.median(RENDERING) == 2.0
    assert line.median(MEMORY) == pytest.approx(2.0)
    assert line.mean("lpips") is None and line.mean("ssim") == 0.5
    assert line.median(KEPT) is None


def test_the_curve_is_the_mean_and_range_of_the_seeds_at_equal_shares_of_their_training() -> None:
    one = run("A", 0, curve=[[2.0, 10.0], [8.0, 16.0]])
    other = run("A", 1, curve=[[5.0, 10.0], [10.0, 12.0]])
    seconds, mean, low, high = lines_of(results(one, other))[0].curve()
    assert (seconds[0], seconds[-1]) == (4.5, 9.0)
    assert (low[-1], mean[-1], high[-1]) == pytest.approx((12.0, 14.0, 16.0))
    assert mean[0] == pytest.approx(11.0)  # of 12 after 4 s and 10 after 5


def test_a_curve_of_one_point_is_one() -> None:
    seconds, mean, _, _ = lines_of(results(run("A", curve=[[9.0, 20.0]])))[0].curve()
    assert seconds.tolist() == [9.0] and mean.tolist() == [20.0]


def test_the_time_to_what_all_reach() -> None:
    lines = lines_of(results(run("A", psnr=20.0), run("B", psnr=22.0)))
    level = common_psnr(lines)
    assert level == 20.0
    assert lines[0].seconds_to(level) == pytest.approx(10.0)
    assert lines[1].seconds_to(level) == pytest.approx(8.0)
    assert lines[0].seconds_to(21.0) is None


def test_the_time_to_a_level_is_that_of_every_seed_and_the_level_that_of_the_last_run() -> None:
    runs = [run("A", seed, psnr) for seed, psnr in enumerate([20.0, 22.0, 23.0])]
    lines = lines_of(results(*runs, run("B", psnr=25.0)))
    assert common_psnr(lines) == 20.0
    assert lines[0].seconds_to(20.0) == pytest.approx(8.0)  # 10, 8 and 7
    assert lines[0].seconds_to(21.0) is None  # one seed never has so much


def test_the_headline_names_the_leader_and_its_lead() -> None:
    said = headline(results(run("NGP + a", psnr=20.0), run("NGP + b", psnr=21.5)))
    assert said == "b is ahead: 21.5 dB, 1.5 more than a"
    said = headline(results(run("NGP + a", psnr=20.0, warming_up=True), run("NGP + b", psnr=21.5)))
    assert said == "b is ahead: 21.5 dB, 1.5 more than a, whose grid is still in its warm-up"


def test_the_method_that_all_share_is_named_once_and_with_the_scene() -> None:
    shared = results(run("NGP + a", psnr=20.0), run("NGP + b", psnr=21.5))
    assert circumstances(shared) == "NGP on city, 10 s of training on 2 CPU cores, one seed"
    beside = shared | {"protocol": {"seconds": None, "steps": 400, "at_once": 2}}
    assert circumstances(beside) == (
        "NGP on city, 400 steps of training on 2 CPU cores, 2 runs at a time, one seed"
    )
    mixed = results(run("NGP + a"), run("LeCO, b", 1))
    assert circumstances(mixed) == (
        "city, 10 s of training on 2 CPU cores, 2 seeds: means of PSNR, medians of costs"
    )


def test_a_lead_that_a_seed_does_not_confirm_is_none() -> None:
    best = [run("A", seed, psnr) for seed, psnr in enumerate([20.0, 22.0])]
    other = [run("B", seed, psnr) for seed, psnr in enumerate([20.2, 20.4])]
    assert headline(results(*best, *other)) == "A and B are level: 21.0 and 20.3 dB"


def test_a_lead_with_every_seed_is_one_although_seeds_differ_by_more() -> None:
    best = [run("A", seed, psnr) for seed, psnr in enumerate([20.0, 22.0])]
    other = [run("B", seed, psnr) for seed, psnr in enumerate([19.0, 21.0])]
    assert headline(results(*best, *other)) == "A is ahead: 21.0 dB, 1.0 more than B"
    apart = [run("B", 2 + seed, psnr) for seed, psnr in enumerate([19.0, 21.0])]
    assert headline(results(*best, *apart)) == "A and B are level: 21.0 and 20.0 dB"
