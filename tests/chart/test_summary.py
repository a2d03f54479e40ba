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
    Representation,
    circumstances,
    common_psnr,
    front,
    fronts_of,
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


def test_the_method_that_all_share_is_named_once_and_with_the_scene() -> None:
    shared = results(run("NGP + a", psnr=20.0), run("NGP + b", psnr=21.5))
    assert circumstances(shared) == "NGP on city, 10 s of training on 2 CPU cores, one seed"
    beside = shared | {"protocol": {"seconds": None, "steps": 400, "at_once": 2}}
    assert circumstances(beside) == (
        "NGP on city, 400 steps of training on 2 CPU cores, 2 runs at a time, one seed"
    )
    mixed = results(run("NGP + a"), run("LeCO, b", 1))
    assert circumstances(mixed) == (
        "city, 10 s of training on 2 CPU cores, mean of 2 seeds (bands: least to most)"
    )


def test_a_lead_within_the_spread_of_the_seeds_is_none() -> None:
    best = [run("A", seed, psnr) for seed, psnr in enumerate([20.0, 22.0])]
    other = [run("B", seed, psnr) for seed, psnr in enumerate([20.2, 20.4])]
    assert headline(results(*best, *other)) == "A and B are level at 21.0 dB"


GRIDS = [
    {"resolution": 64, "bytes": 32768, "update_seconds": 2.0, "kept_reached_volume": 0.3},
    {"resolution": 128, "bytes": 262144, "update_seconds": 4.0, "kept_reached_volume": 0.2},
]


def gates(*found: tuple[str, str, int, float, float]) -> list[Representation]:
    """Of name, sampler, bytes, seconds of learning and share kept."""
    runs = [
        run(name, sampler=sampler, learn_seconds=seconds, occupancy=occupancy(size, kept))
        for name, sampler, size, seconds, kept in found
    ]
    return representations_of(lines_of(results(*runs)))


def test_grids_stand_beside_the_gates_of_whose_field_they_were_made() -> None:
    ours = run("MLP (ours)", occupancy=occupancy(50_000, 0.1, GRIDS))
    other = run("hash grid", sampler="learned-occupancy-hash", occupancy=occupancy(4_000_000, 0.2))
    plain = run("never frozen", occupancy=None)
    held = representations_of(lines_of(results(ours, other, plain)))
    assert [(one.name, one.size) for one in held] == [
        ("MLP (ours)", 50.0),
        ("grid 64³", 32.768),
        ("grid 128³", 262.144),
        ("hash grid", 4000.0),
    ]
    assert [one.learn_seconds for one in held] == [3.0, 5.0, 7.0, 3.0]
    assert [one.kept for one in held] == pytest.approx([10.0, 30.0, 20.0, 20.0])
    assert [one.ours for one in held] == [True, False, False, False]
    assert verdict(held) == (
        "MLP (ours) is on both fronts: what keeps less space is larger and takes longer to learn"
    )


def test_a_grid_that_did_not_fit_the_memory_once_is_known_from_the_other_seeds() -> None:
    runs = [run("A", seed, occupancy=occupancy(50_000, 0.1, GRIDS)) for seed in (0, 1)]
    runs[1]["occupancy"]["at_equal_loss"]["grids"] = GRIDS[:1]
    names = [one.name for one in representations_of(lines_of(results(*runs)))]
    assert names == ["A", "grid 64³", "grid 128³"]


def test_what_was_measured_in_the_whole_box_is_not_compared() -> None:
    before = occupancy(50_000, 0.1)
    before["at_equal_loss"] = {"kept_volume": 0.1, "kept_candidates": 0.1, "grids": []}
    other = run("B", sampler="learned-occupancy-hash", occupancy=before)
    assert representations_of(lines_of(results(run("A", occupancy=before), other))) == []


def test_gates_of_one_kind_are_no_comparison_of_representations() -> None:
    runs = [run(name, occupancy=occupancy(50_000, 0.1)) for name in ("identity", "none")]
    assert representations_of(lines_of(results(*runs))) == []


def test_it_is_said_where_ours_is_not_on_the_front_and_what_beats_it() -> None:
    ours = ("MLP (ours)", "learned-occupancy", 50_000, 9.0, 0.1)
    faster = ("hash grid", "learned-occupancy-hash", 4_000_000, 3.0, 0.05)
    smaller = ("K-planes", "learned-occupancy-k-planes", 40_000, 10.0, 0.1)
    said = verdict(gates(faster, ours))  # whatever comes first
    assert said == (
        "MLP (ours) is on the front of size only: it is beaten in learning time by hash grid"
    )
    assert verdict(gates(ours, faster, smaller)) == (
        "MLP (ours) is on neither front: it is beaten in size by K-planes and in learning time by "
        "hash grid"
    )
    assert verdict(gates(faster, smaller)) == "our own gate has no figures here"


def test_equals_do_not_beat_one_another() -> None:
    held = gates(*[(name, name, 50_000, 9.0, 0.1) for name in "AB"])
    assert [fronts_of(one, held) for one in held] == [["size", "learning time"]] * 2


@given(st.lists(st.tuples(*[st.integers(1, 5)] * 3), min_size=1, max_size=8))
def test_fronts_are_those_of_the_definition(rows: list[tuple[int, int, int]]) -> None:
    held = [Representation(str(i), *map(float, row)) for i, row in enumerate(rows)]
    for one, (size, seconds, kept) in zip(held, rows):
        by_size = (size, -kept) in slow_front([(a, -k) for a, _, k in rows])
        by_time = (seconds, -kept) in slow_front([(b, -k) for _, b, k in rows])
        expected = ["size"] * by_size + ["learning time"] * by_time
        assert fronts_of(one, held) == expected
