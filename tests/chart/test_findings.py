"""Claims about what the runs of a chart say together, in pairs by a rule, and at last."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from chart_results import results, run, slow_front
from hypothesis import given, settings
from hypothesis import strategies as st
from page_text import figure_text
from scipy import stats

from leco_plugin.chart.learned import falls, last_gain, settling, still_rising
from leco_plugin.chart.page import write_page
from leco_plugin.chart.summary import (
    KEPT,
    MEMORY,
    RENDERING,
    best_so_far,
    circumstances,
    common_psnr,
    compare,
    describe_seeds,
    front,
    headline,
    lines_of,
    rivals,
    seconds_to_pass,
)
from leco_plugin.chart.table import table


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


def of(name: str, *psnrs: float, **figures: object) -> list[dict]:
    return [run(name, seed, psnr, **figures) for seed, psnr in enumerate(psnrs)]


def test_the_headline_names_the_leader_and_its_lead_beyond_the_spread_of_seeds() -> None:
    best, other = of("NGP + b", 21.4, 21.5, 21.6), of("NGP + a", 20.0, 20.1, 19.9)
    said = headline(results(*other, *best))
    assert said == "b is ahead: 21.5 dB, 1.50 ± 0.23 more than a (3 seeds)"
    cold = of("NGP + a", 20.0, 20.1, 19.9, warming_up=True)
    assert headline(results(*cold, *best)) == f"{said}, whose grid is still in its warm-up"
    noisy = of("NGP + a", 18.0, 22.0, 20.0)
    assert headline(results(*noisy, *best)) == (
        "b and a are undecided: 21.5 and 20.0 dB, 1.50 ± 4.95 apart (3 seeds)"
    )
    assert headline(results(*noisy, *best), short=True) == "undecided: 21.5 dB for b, 20.0 next"
    assert headline(results(*other[:1], *best)) == "b 21.5 dB, a 20.0 dB (one seed: no verdict)"


def test_where_two_that_learn_are_level_the_headline_says_what_they_lead_the_others_by() -> None:
    both = of("A", 21.4, 21.5, 21.6) + of("B", 21.3, 21.5, 21.6)
    dense, grid = {"sampler": "dense"}, {"sampler": "own"}
    ahead = results(*both, *of("C", 20.0, 20.1, 19.9, **dense), *of("D", 19.0, 19.1, 18.9, **grid))
    said = "two methods with learned occupancy lead by 1.47 ± 0.31 dB"  # B, the second
    assert headline(ahead, short=True) == said
    assert headline(ahead).endswith("; C, the best of the others, is 1.47 ± 0.31 behind B")
    third = results(*ahead["runs"], *of("E", 21.2, 21.3, 21.4))
    said = "three methods with learned occupancy lead by 1.30 ± 0.23 dB"  # E, the third
    assert headline(third, short=True) == said
    close = results(*both, *of("C", 18.0, 22.0, 23.0, **dense))
    assert headline(close, short=True) == "A is level with the next best"
    assert "behind" not in headline(close)
    alone = of("A", 21.4, 21.5, 21.6) + of("B", 19.0, 24.0, 21.0)
    only_the_first = results(*alone, *of("C", 20.0, 20.1, 19.9, **dense))
    assert headline(only_the_first, short=True) == "undecided: 21.5 dB for A, 21.3 next"
    assert "C" not in headline(only_the_first)
    one_run = results(*both, *of("C", 20.0, **dense))
    assert headline(one_run, short=True) == "A is level with the next best"


def test_the_method_that_all_share_is_named_once_and_with_the_scene() -> None:
    shared = results(run("NGP + a", psnr=20.0), run("NGP + b", psnr=21.5))
    assert circumstances(shared) == "NGP on city, 10 s of training on 2 CPU cores, one seed"
    beside = shared | {"protocol": {"seconds": None, "steps": 400, "at_once": 2}}
    beside["machine"] = {"cores": 2, "threads": 1, "device": "cpu"}  # threads are of each run
    assert circumstances(beside) == (
        "NGP on city, 400 steps of training on one CPU core a run, one seed"
    )
    mixed = results(*(run(name, seed) for name in ("NGP + a", "LeCO, b") for seed in (0, 1)))
    assert circumstances(mixed) == (
        "city, 10 s of training on 2 CPU cores, 2 seeds: means of PSNR, medians of costs"
    )


def test_seeds_are_counted_for_each_contender_and_failed_runs_beside_them(tmp_path: Path) -> None:
    failures = [
        {"name": "B", "method": "b", "sampler": "own", "seed": seed, "reason": "no memory"}
        for seed in (2, 3, 4)
    ]
    fewer = results(*of("A", *[20.0] * 5), *of("B", 18.0, 19.0), failures=failures)
    assert describe_seeds(fewer) == "2 to 5 seeds; 3 runs failed"
    said = "10 s of training on 2 CPU cores, 2 to 5 seeds; 3 runs failed: means of PSNR"
    assert said in circumstances(fewer)
    assert said in table(fewer) and said in figure_text(write_page(fewer, tmp_path / "chart.html"))
    assert describe_seeds(results(run("A"), run("B", 1))) == "one seed"
    one = results(run("A"), failures=failures[:1])
    assert circumstances(one).endswith(", one seed; 1 run failed")


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


def test_runs_are_held_against_the_mean_and_median_of_the_rival_not_against_a_seed() -> None:
    ours = of_seeds("learned-occupancy", [21.0, 22.0, 30.0], render_seconds_per_image=0.5)
    theirs = of_seeds("own", [20.0, 19.0])
    theirs[0] |= {"render_seconds_per_image": 2.0, "train_seconds": 12.0}
    (found,) = rivals(lines_of(results(*ours, *theirs)))
    assert found.psnr.difference == pytest.approx(73.0 / 3 - 19.5)
    assert (found.psnr.word, found.psnr.seeds) == ("undecided", (3, 2))
    assert found.passed == (8.5, 7.5, 5.0)  # 19.5 dB: a decibel a second until second ten
    assert found.sooner == pytest.approx((10 / 8.5, 10 / 7.5, 2.0))
    assert found.faster == (3.0, 3.0, 3.0)


def test_of_three_rivals_the_middle_ones_times_count_and_the_mean_of_their_psnrs() -> None:
    ours = of_seeds("learned-occupancy", [24.0], render_seconds_per_image=0.5)
    theirs = of_seeds("own", [20.0, 19.0, 24.0])
    for one, end, seconds in zip(theirs, (10.0, 12.0, 20.0), (1.0, 2.0, 9.0), strict=True):
        curve = [[1.0, 10.0], [end, one["psnr"]]]
        one |= {"curve": curve, "render_seconds_per_image": seconds}
    (found,) = rivals(lines_of(results(*ours, *theirs)))
    assert found.passed == (7.0,) and found.sooner == (12.0 / 7.0,) and found.faster == (4.0,)


def test_a_last_step_beyond_the_time_that_was_given_is_nobodys_gain() -> None:
    lines = lines_of(results(*of_seeds("learned-occupancy", [21.0]), *of_seeds("own", [20.0])))
    (found,) = rivals(lines, seconds=9.0)
    assert found.passed == (9.0,) and found.sooner == (1.0,)


def test_the_front_of_accuracy_is_the_best_mean_so_far() -> None:
    slow = run("A", curve=[[2.0, 10.0], [10.0, 26.0]])
    quick = run("B", curve=[[1.0, 12.0], [4.0, 18.0], [6.0, 17.0]])
    times, reached = best_so_far(lines_of(results(slow, quick)))
    assert (times[0], times[-1]) == (1.0, 10.0) and (times[1:] > times[:-1]).all()
    for seconds, psnr in ((1.0, 12.0), (2.5, 15.0), (4.0, 18.0), (5.5, 18.0), (8.0, 22.0)):
        assert np.interp(seconds, times, reached) == pytest.approx(psnr, abs=0.1)


def test_the_time_that_a_grid_took_is_a_share_of_the_time_of_training() -> None:
    figures = {"sampler": "occupancy-grid-64", "train_seconds": 8.0}
    runs = [run("grid", seed, learn_seconds=s, **figures) for seed, s in enumerate((1.0, 7.0, 2.0))]
    runs[0]["train_seconds"] = 20.0
    (line,) = lines_of(results(*runs))
    assert line.kept_up == 2.0 / 8.0


def test_the_machine_and_how_many_runs_shared_it_are_said() -> None:
    said = results(run("A"), protocol={"seconds": 10.0, "steps": None, "at_once": 3})
    said["machine"] = {"cores": 4, "threads": 2, "device": "H200"}
    assert circumstances(said) == "city, 10 s of training on H200, 3 runs at a time, one seed"


def test_other_methods_are_no_rivals() -> None:
    ours = of_seeds("learned-occupancy", [21.0])
    assert not rivals(lines_of(results(*ours, run("other", method="nerfacto", sampler="own"))))


def test_what_is_never_passed_is_a_dash() -> None:
    runs = of_seeds("learned-occupancy", [19.0]) + of_seeds("own", [20.0])
    text = table(results(*runs))
    (row,) = [line for line in text.splitlines() if "learned-occupancy against own" in line]
    assert row.split(" | ")[1:] == ["-1.00 dB, one seed: no verdict", "-", "-", "1.0 |"]


STILL = [[3.0, 18.0], [6.0, 20.0], [9.0, 20.2]]
RISING = [[3.0, 15.0], [6.0, 18.0], [9.0, 21.0]]


def test_the_gain_of_the_last_third_is_between_two_thirds_of_the_time_and_its_end() -> None:
    still, rising = lines_of(results(run("A", curve=STILL), run("B", curve=RISING)))
    assert last_gain(still) == pytest.approx(0.2)
    assert last_gain(rising) == pytest.approx(3.0)
    (both,) = lines_of(results(run("A", curve=STILL), run("A", 1, curve=RISING)))
    assert last_gain(both) == pytest.approx(1.6)  # the mean over seeds
    begun_late = lines_of(results(run("C", curve=[[8.0, 15.0], [9.0, 17.0]])))[0]
    assert last_gain(begun_late) is None


def test_who_rises_or_may_rise_is_named_and_nobody_is_said_to_have_had_enough() -> None:
    lines = lines_of(results(run("A", curve=STILL), run("B", curve=RISING)))
    said = settling(lines)
    assert "A +0.2 dB, B +3.0 dB. Still rising: B; rates" in said
    assert "A +0.2 dB. Rates fall to a tenth over the time" in settling(lines[:1])
    cooled = settling(lines, held=0.6)
    assert "rates are full for 60% of the time that is given, and then fall to zero," in cooled
    assert "Still rising: all of them;" in settling(lines[1:])
    late = lines_of(results(run("A", curve=STILL), run("C", curve=[[9.0, 17.0]])))
    assert "C unknown. Still rising: C;" in settling(late)


@pytest.mark.parametrize(("end", "rising"), [(20.34, []), (20.36, ["A"])])
def test_more_than_three_tenths_of_a_decibel_are_a_rise(end: float, rising: list[str]) -> None:
    curve = [[3.0, 18.0], [6.0, 20.0], [9.0, end]]
    assert still_rising(lines_of(results(run("A", curve=curve)))) == rising


def test_a_grid_that_has_skipped_nothing_yet_is_still_rising() -> None:
    cold = run("grid", curve=STILL, warming_up=True)
    assert still_rising(lines_of(results(run("A", curve=STILL), cold))) == ["grid"]


def test_a_grid_that_took_the_time_of_training_is_named() -> None:
    fine = run(
        "fine", curve=STILL, train_seconds=9.0, learn_seconds=8.0, sampler="occupancy-grid-9"
    )
    gate = run("gate", curve=STILL, train_seconds=9.0, learn_seconds=8.0)
    lines = lines_of(results(gate, fine))
    assert still_rising(lines) == ["fine"]
    assert "Updated its grid instead of training: fine for 89% of its time." in settling(lines)
    for seconds, names in ((3.5, []), (3.7, ["fine"])):  # 39% of nine seconds, and 41%
        spent = lines_of(results(gate, fine | {"learn_seconds": seconds}))
        assert still_rising(spent) == names and ("instead" in settling(spent)) == bool(names)


def test_tables_of_runs_of_equal_time_say_it_and_no_others() -> None:
    both = [run("A", curve=STILL), run("B", curve=RISING)]
    suite = {"suite": "freeze", "question": "Why?"}
    steps = {"protocol": {"seconds": None, "steps": 400}}
    assert "last third" in table(results(*both, **suite))
    assert "last third" in table(results(*both))
    assert "last third" not in table(results(*both, **suite, **steps))


def test_runs_that_end_below_their_best_point_are_named_on_table_and_page(tmp_path: Path) -> None:
    fell = run("B", curve=[[3.0, 18.0], [6.0, 20.0], [9.0, 18.0]])
    both = results(run("A", curve=STILL), fell)
    said = "B fell by 2.0 dB from its best"
    assert falls(lines_of(both)) == said
    page = write_page(both, tmp_path / "chart.html")
    assert f"\n\n{said}.\n" in table(both) and said in figure_text(page)
    one = [*(run("B", seed=seed, curve=STILL) for seed in (0, 1)), fell | {"seed": 2}]
    assert falls(lines_of(results(*one))) == f"{said} in 1 of 3 runs"
    early = run("B", 3, curve=[[3.0, 21.0], [6.0, 19.0], [9.0, 19.6]])
    assert falls(lines_of(results(*one, early))) == (
        "B fell by up to 2.0 dB from its best in 2 of 4 runs"
    )
    for end, said in ((19.75, None), (19.71, None), (19.69, "B fell by 0.3 dB from its best")):
        hardly = run("B", curve=[[3.0, 18.0], [6.0, 20.0], [9.0, end]])
        assert falls(lines_of(results(run("A", curve=STILL), hardly))) == said


NAN, OPEN = math.nan, "undecided"
SPREAD = st.lists(st.integers(0, 9).map(float), min_size=2, max_size=6)


@pytest.mark.parametrize(
    ("ours", "theirs", "word", "said"),
    [
        # the 97.5% point of t is 2.776 with 4 degrees of freedom, 12.706 with one: from a table
        ((21.0, 22.0, 23.0), (11.0, 12.0, 13.0), "ahead", "ahead: +10.00 ± 2.27 dB, 3 seeds"),
        ((11.0, 12.0, 13.0), (21.0, 22.0, 23.0), "behind", "behind: -10.00 ± 2.27 dB, 3 seeds"),
        ((21.1, 21.2, 21.3), (21.0, 21.1, 21.2), "level", "level: +0.10 ± 0.23 dB, 3 seeds"),
        ((21.0, 22.0, 23.0), (20.0, 21.0, 22.0), OPEN, "undecided: +1.00 ± 2.27 dB, 3 seeds"),
        ((20.0, 22.0), (19.0, 19.0), OPEN, "undecided: +2.00 ± 12.71 dB, 2 seeds"),
        ((20.0, 22.0), (19.0, 19.0, 19.0), OPEN, "undecided: +2.00 ± 12.71 dB, 2 and 3 seeds"),
        ((20.0,), (11.0, 12.0, 13.0), None, "+8.00 dB, one seed: no verdict"),
        ((20.0,), (10.0,), None, "+10.00 dB, one seed: no verdict"),
        ((20.0, 20.0), (20.0, 20.0), "level", "level: +0.00 ± 0.00 dB, 2 seeds"),
        ((20.5, 20.5), (20.0, 20.0), "ahead", "ahead: +0.50 ± 0.00 dB, 2 seeds"),
        ((20.0, NAN), (10.0, 10.0), None, "+nan dB, not a number: no verdict"),
        ((20.0, 21.0), (math.inf, 10.0), None, "-inf dB, not a number: no verdict"),
    ],
)
def test_planted_answers_are_found(ours, theirs, word, said) -> None:
    found = compare(ours, theirs)
    assert (found.word, found.said()) == (word, said)


@settings(max_examples=30)
@given(SPREAD, SPREAD)
def test_the_interval_is_that_of_scipy_and_swapping_two_swaps_the_verdict(ours, theirs) -> None:
    found, swapped = compare(ours, theirs), compare(theirs, ours)
    opposite = {"ahead": "behind", "behind": "ahead", "level": "level", OPEN: OPEN}
    assert swapped.word == opposite[found.word] and swapped.margin == pytest.approx(found.margin)
    if min(len(set(ours)), len(set(theirs))) > 1:  # scipy warns of one that does not scatter
        interval = stats.ttest_ind(ours, theirs, equal_var=False).confidence_interval(0.95)
        low, high = found.difference - found.margin, found.difference + found.margin
        assert (low, high) == pytest.approx((interval.low, interval.high))
        assert found.is_open == (interval.low <= 0.0 <= interval.high)


def test_seeds_are_no_pairs() -> None:
    """Each run gains 0.1 on that of the same number, which pairs would call a lead."""
    theirs = [20.0, 21.0, 22.0, 23.0, 24.0]
    assert compare([value + 0.1 for value in theirs], theirs).is_open


@pytest.mark.parametrize(
    ("close", "word"), [(2.26, OPEN), (2.28, "level"), (0.5, OPEN), (None, "level")]
)
def test_two_are_level_only_where_the_seeds_leave_little_room(close, word) -> None:
    """A quarter of the mean of all is 5.4 here; the margin is 2.27."""
    assert compare((21.0, 22.0, 23.0), (20.0, 21.0, 22.0), close=close).word == word
    small, wide = (0.1, 0.2, 0.3), (0.2, 0.3, 0.4)
    assert compare(small, wide, close=None).word == OPEN


def test_a_margin_is_narrow_beside_the_mean_of_all_runs_not_of_one_side() -> None:
    """The margin is 2.54. A quarter of the mean of all is 2.67 and then 2.49; that of one side lies
    on the other side of the margin, and so does that of both sides' means."""
    low, high = (8.0, 10.0, 10.0, 12.0), (11.6, 12.4)
    for scale in (1.0, 50.0):
        for less, word in ((0.0, "level"), (0.7, OPEN)):
            ours, theirs = ([scale * (x - less) for x in side] for side in (low, high))
            assert compare(ours, theirs, close=None).word == word
            assert compare(theirs, ours, close=None).word == word


def test_nothing_cannot_be_compared() -> None:
    with pytest.raises(ValueError, match="0 runs cannot be compared with 1"):
        compare([], [20.0])
