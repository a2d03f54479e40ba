"""Claims about how long runs are, and how long they are said to take."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from leco_plugin.chart.contender import (
    FAST,
    LEARN_SHARE,
    SLOW,
    SMALL,
    UNGUIDED,
    Contender,
    Cores,
    Protocol,
    forecast,
    forecast_minutes,
    run_seconds,
    settings_of,
)
from leco_plugin.chart.methods import SUITES

CHARTS = Path(__file__).parents[2] / "benchmarks" / "results" / "charts"
GUIDED = Contender("guided", "leco-occupancy", "learned-occupancy")
DENSE = Contender("dense", "leco-occupancy", "dense")


def test_learning_has_a_share_of_the_time() -> None:
    budget = Protocol(10.0, 50).budget()
    assert (budget.seconds, budget.steps, budget.learn_seconds) == (10.0, 50, LEARN_SHARE * 10.0)


def test_without_a_time_learning_is_left_to_the_method() -> None:
    assert Protocol(None, 50).budget().learn_seconds is None
    assert Protocol(None, 50, 3.0).budget().learn_seconds == 3.0


@pytest.mark.parametrize(
    "values",
    [
        {"steps": 0},
        {"seconds": 1.0, "learn_seconds": 1.0},
        {"seconds": 1.0, "images": 0},
        {"seconds": 1.0, "curve_points": 0},
        {"seconds": 1.0, "at_once": 0},
    ],
)
def test_no_time_is_refused_in_a_line(values: dict[str, float]) -> None:
    with pytest.raises(ValueError) as refused:
        Protocol(**values)
    assert "\n" not in str(refused.value)


def test_settings_hold_what_makes_runs_comparable() -> None:
    settings = settings_of({"name": "city"}, Protocol(10.0), "losses", {"cores": 2})
    assert {"scene", "seconds", "steps", "images", "suite", "machine"} <= settings.keys()
    assert "seeds" not in settings and "methods" not in settings


def test_runs_beside_each_other_have_equally_many_threads_and_at_least_one() -> None:
    assert Protocol(1.0).threads(6) == 6
    assert Protocol(1.0, at_once=4).threads(6) == 1
    assert Protocol(1.0, at_once=9).threads(6) == 1


@pytest.mark.parametrize("cores", [FAST, SLOW])
def test_a_run_takes_its_time_and_what_is_beside_it(cores: Cores) -> None:
    protocol = Protocol(100.0)
    guided = run_seconds(GUIDED, protocol, cores)
    assert guided == 100.0 + cores.overhead
    assert run_seconds(DENSE, protocol, cores) == guided + cores.unguided
    with_grids = replace(GUIDED, grids=(64,))
    assert run_seconds(with_grids, protocol, cores) == guided + cores.grids


def test_a_run_ends_with_its_time_or_its_steps() -> None:
    few, many = (Protocol(100.0, steps) for steps in (10, 10_000))
    in_time = run_seconds(GUIDED, Protocol(100.0), FAST)
    assert run_seconds(GUIDED, many, FAST) == in_time
    assert run_seconds(GUIDED, few, FAST) == 10 * FAST.step + FAST.overhead


def test_two_runs_at_a_time_take_half_as_long() -> None:
    alone, beside = (Protocol(100.0, at_once=count) for count in (1, 2))
    minutes = forecast_minutes([GUIDED, DENSE], alone, FAST)
    assert minutes == pytest.approx((130.0 + 153.0) / 60.0)
    assert forecast_minutes([GUIDED, DENSE], beside, FAST) == pytest.approx(minutes / 2)


def test_one_run_takes_no_less_where_two_could_be_made_at_a_time() -> None:
    alone, beside = (forecast([GUIDED], Protocol(290.0, at_once=count)) for count in (1, 2))
    assert beside == alone == "about 5 to 6 minutes on two CPU cores, by their speed"


def test_large_test_images_take_longer_and_longest_where_nothing_is_skipped() -> None:
    protocol = Protocol(20.0, images=3)
    small, large = (
        [run_seconds(run, protocol, FAST, size) for run in (GUIDED, DENSE)]
        for size in (SMALL, SMALL + 1.5)
    )
    assert run_seconds(GUIDED, protocol, FAST) == small[0]
    assert run_seconds(GUIDED, protocol, FAST, SMALL / 4) == small[0]
    assert large[0] - small[0] == pytest.approx(3 * 1.5 * FAST.megapixel)
    assert large[1] - small[1] == pytest.approx(UNGUIDED * 3 * 1.5 * FAST.megapixel)
    said = forecast([DENSE], protocol, 2.0)
    assert said == "about 7 to 20 minutes on two CPU cores, by their speed"


def test_what_is_said_holds_for_fast_cores_and_for_slow_ones() -> None:
    runs = [GUIDED] * 12
    protocol = Protocol(None, 400, at_once=2)
    fast, slow = (round(forecast_minutes(runs, protocol, cores)) for cores in (FAST, SLOW))
    said = forecast(runs, protocol)
    assert said == f"about {fast} to {slow} minutes on two CPU cores, by their speed"
    assert forecast([GUIDED], Protocol(20.0)) == "about 1 minute on two CPU cores"


def of_suites() -> list[tuple[str, dict[str, Any]]]:
    """Stored charts of suites that say how long their runs took."""
    found = [(path.stem, json.loads(path.read_text())) for path in sorted(CHARTS.glob("*.json"))]
    return [
        (name, results)
        for name, results in found
        if results["suite"] and all(run.get("wall_seconds") for run in results["runs"])
    ]


@pytest.mark.parametrize(
    ("name", "results"), [pytest.param(*one, id=one[0]) for one in of_suites()]
)
def test_suites_took_about_as_long_as_is_said(name: str, results: dict[str, Any]) -> None:
    contenders = {one.name: one for one in SUITES[results["suite"]].contenders}
    made = [contenders[run["name"]] for run in results["runs"]]
    protocol = Protocol(**results["protocol"])
    fast, slow = (forecast_minutes(made, protocol, cores) for cores in (FAST, SLOW))
    took = sum(run["wall_seconds"] for run in results["runs"]) / 60.0 / protocol.at_once
    assert 0.8 * fast <= took <= 1.1 * slow, name
