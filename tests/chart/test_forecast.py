"""Claims about how long runs are said to take."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from leco_plugin.chart.contenders import forecast
from leco_plugin.chart.contenders.contender import Contender
from leco_plugin.chart.contenders.forecast import FAST, SLOW
from leco_plugin.chart.contenders.protocol import Protocol
from leco_plugin.chart.contenders.suites import SUITES

CHARTS = Path(__file__).parents[2] / "benchmarks" / "results" / "charts"
GUIDED = Contender("guided", "leco-occupancy", "learned-occupancy")
DENSE = Contender("dense", "leco-occupancy", "dense")


@pytest.mark.parametrize("cores", [FAST, SLOW])
def test_a_run_takes_its_time_and_what_is_beside_it(cores: forecast.Cores) -> None:
    protocol = Protocol(100.0)
    guided = forecast.run_seconds(GUIDED, protocol, cores)
    assert guided == 100.0 + cores.overhead
    assert forecast.run_seconds(DENSE, protocol, cores) == guided + cores.unguided
    assert forecast.run_seconds(replace(GUIDED, budget=2.0), protocol, cores) == guided + 100.0
    with_grids = replace(GUIDED, grids=(64,))
    assert forecast.run_seconds(with_grids, protocol, cores) == guided + cores.grids


def test_a_run_ends_with_its_time_or_its_steps() -> None:
    few, many = (Protocol(100.0, steps) for steps in (10, 10_000))
    in_time = forecast.run_seconds(GUIDED, Protocol(100.0), FAST)
    assert forecast.run_seconds(GUIDED, many, FAST) == in_time
    assert forecast.run_seconds(GUIDED, few, FAST) == 10 * FAST.step + FAST.overhead


def test_two_runs_at_a_time_take_half_as_long() -> None:
    alone, beside = (Protocol(100.0, at_once=count) for count in (1, 2))
    minutes = forecast.minutes([GUIDED, DENSE], alone, FAST)
    assert minutes == pytest.approx((130.0 + 155.0) / 60.0)
    assert forecast.minutes([GUIDED, DENSE], beside, FAST) == pytest.approx(minutes / 2)


def test_what_is_said_holds_for_fast_cores_and_for_slow_ones() -> None:
    runs = [GUIDED] * 12
    protocol = Protocol(None, 400, at_once=2)
    fast, slow = (round(forecast.minutes(runs, protocol, cores)) for cores in (FAST, SLOW))
    said = forecast.about(runs, protocol)
    assert said == f"about {fast} to {slow} minutes on two CPU cores, by their speed"
    assert forecast.about([GUIDED], Protocol(20.0)) == "about 1 minute on two CPU cores"


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
    fast, slow = (forecast.minutes(made, protocol, cores) for cores in (FAST, SLOW))
    took = sum(run["wall_seconds"] for run in results["runs"]) / 60.0 / protocol.at_once
    assert 0.8 * fast <= took <= 1.1 * slow, name
