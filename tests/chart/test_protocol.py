"""Claims about how long runs are and what tells one chart from another."""

from __future__ import annotations

import math

import pytest

from leco_plugin.chart.contenders.protocol import LEARN_SHARE, Protocol, settings_of


def test_more_time_is_more_time_for_everything_but_learning() -> None:
    once, thrice = Protocol(10.0, 50).budget(), Protocol(10.0, 50).budget(3.0)
    assert (once.seconds, once.steps, once.learn_seconds) == (10.0, 50, LEARN_SHARE * 10.0)
    assert (thrice.seconds, thrice.steps, thrice.learn_seconds) == (30.0, 150, LEARN_SHARE * 10.0)


def test_without_a_time_learning_is_left_to_the_method() -> None:
    assert Protocol(None, 50).budget().learn_seconds is None
    assert Protocol(None, 50, 3.0).budget().learn_seconds == 3.0


@pytest.mark.parametrize(
    "values",
    [
        {},
        {"seconds": 0.0},
        {"seconds": -1.0},
        {"seconds": math.nan},
        {"seconds": math.inf},
        {"steps": 0},
        {"seconds": 1.0, "learn_seconds": 0.0},
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
