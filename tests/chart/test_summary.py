"""Claims about what the runs of a chart say together."""

from __future__ import annotations

import pytest
from chart_results import occupancy, results, run
from hypothesis import given
from hypothesis import strategies as st

from leco_plugin.chart.summary import (
    KEPT,
    MEMORY,
    RENDERING,
    common_psnr,
    front,
    headline,
    lines_of,
    representations_of,
    verdict,
)


def slow_front(points: list[tuple[float, float]]) -> set[tuple[float, float]]:
    """Points that no other one matches in both and beats in one."""
    return {
        (cost, gain)
        for cost, gain in points
        if not any(c <= cost and g >= gain and (c < cost or g > gain) for c, g in points)
    }


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


def test_the_curve_is_the_mean_and_range_of_the_seeds_where_all_have_one() -> None:
    one = run("A", 0, curve=[[2.0, 10.0], [8.0, 16.0]])
    other = run("A", 1, curve=[[4.0, 10.0], [10.0, 10.0]])
    seconds, mean, low, high = lines_of(results(one, other))[0].curve()
    assert (seconds[0], seconds[-1]) == (4.0, 8.0)
    assert (low[-1], mean[-1], high[-1]) == pytest.approx((10.0, 13.0, 16.0))
    assert mean[0] == pytest.approx(11.0)


def test_a_curve_of_one_point_is_one() -> None:
    seconds, mean, _, _ = lines_of(results(run("A", curve=[[9.0, 20.0]])))[0].curve()
    assert seconds.tolist() == [9.0] and mean.tolist() == [20.0]


def test_the_time_to_what_all_reach() -> None:
    lines = lines_of(results(run("A", psnr=20.0), run("B", psnr=22.0)))
    level = common_psnr(lines)
    assert level == 20.0
    assert lines[0].seconds_to(level) == pytest.approx(10.0)
    assert lines[1].seconds_to(level) == pytest.approx(8.0, abs=0.1)
    assert lines[0].seconds_to(21.0) is None


def test_the_headline_names_the_leader_and_its_lead() -> None:
    said = headline(results(run("NGP + a", psnr=20.0), run("NGP + b", psnr=21.5)))
    assert said == "b is ahead: 21.5 dB, 1.5 more than a"


def test_a_lead_within_the_spread_of_the_seeds_is_none() -> None:
    best = [run("A", seed, psnr) for seed, psnr in enumerate([20.0, 22.0])]
    other = [run("B", seed, psnr) for seed, psnr in enumerate([20.2, 20.4])]
    assert headline(results(*best, *other)) == "A and B are level at 21.0 dB"


GRIDS = [{"resolution": 64, "bytes": 32768, "update_seconds": 2.0, "kept_volume": 0.3}]


def test_grids_stand_beside_the_gates_of_whose_field_they_were_made() -> None:
    ours = run("MLP (ours)", occupancy=occupancy(50_000, 0.1, GRIDS))
    other = run("hash grid", occupancy=occupancy(4_000_000, 0.2))
    plain = run("never frozen", occupancy=None)
    held = representations_of(lines_of(results(ours, other, plain)))
    assert [(one.name, one.size) for one in held] == [
        ("MLP (ours)", 50.0),
        ("grid 64³", 32.768),
        ("hash grid", 4000.0),
    ]
    assert [one.learn_seconds for one in held] == [3.0, 5.0, 3.0]
    assert [one.kept for one in held] == pytest.approx([10.0, 30.0, 20.0])
    assert verdict(held).startswith("MLP (ours) is on both fronts")


def test_it_is_said_where_ours_is_not_on_the_front() -> None:
    ours = run("MLP (ours)", occupancy=occupancy(50_000, 0.1), learn_seconds=9.0)
    faster = run("hash grid", occupancy=occupancy(4_000_000, 0.05))
    held = representations_of(lines_of(results(ours, faster)))
    assert verdict(held) == "MLP (ours) is not on the front of learning time"
