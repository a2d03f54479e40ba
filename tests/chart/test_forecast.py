"""Claims about how long runs are said to take."""

from __future__ import annotations

from dataclasses import replace

import pytest

from leco_plugin.chart import forecast
from leco_plugin.chart.contender import Contender
from leco_plugin.chart.protocol import Protocol
from leco_plugin.chart.suites import STEPS_SECONDS

GUIDED = Contender("guided", "leco-occupancy", "learned-occupancy")
DENSE = Contender("dense", "leco-occupancy", "dense")


def test_a_run_takes_its_time_and_what_is_beside_it() -> None:
    protocol = Protocol(100.0)
    guided = forecast.run_seconds(GUIDED, protocol)
    assert guided == 100.0 + forecast.OVERHEAD_SECONDS
    assert forecast.run_seconds(DENSE, protocol) == guided + forecast.UNGUIDED_SECONDS
    assert forecast.run_seconds(replace(GUIDED, budget=2.0), protocol) == guided + 100.0
    with_grids = replace(GUIDED, grids=(64,))
    assert forecast.run_seconds(with_grids, protocol) == guided + forecast.GRIDS_SECONDS


def test_a_run_ends_with_its_time_or_its_steps() -> None:
    few, many = (Protocol(100.0, steps) for steps in (10, 10_000))
    assert forecast.run_seconds(GUIDED, many) == forecast.run_seconds(GUIDED, Protocol(100.0))
    assert forecast.run_seconds(GUIDED, few) == 10 * forecast.STEP_SECONDS + 30.0


def test_two_runs_at_a_time_take_half_as_long() -> None:
    alone, beside = (Protocol(100.0, at_once=count) for count in (1, 2))
    minutes = forecast.minutes([GUIDED, DENSE], alone)
    assert minutes == pytest.approx((130.0 + 155.0) / 60.0)
    assert forecast.minutes([GUIDED, DENSE], beside) == pytest.approx(minutes / 2)


def test_the_steps_of_suites_take_what_their_forecast_says() -> None:
    seconds = forecast.run_seconds(GUIDED, Protocol(None, 400)) - forecast.OVERHEAD_SECONDS
    assert seconds == pytest.approx(STEPS_SECONDS)
