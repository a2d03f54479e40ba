"""Claims about what runs still gain at last."""

from __future__ import annotations

import pytest
from chart_results import results, run

from leco_plugin.chart.drawing.table import table
from leco_plugin.chart.findings.settling import last_gain, settling
from leco_plugin.chart.findings.summary import lines_of

STILL = [[3.0, 18.0], [6.0, 20.0], [9.0, 20.2]]
RISING = [[3.0, 15.0], [6.0, 18.0], [9.0, 21.0]]


def test_the_gain_of_the_last_third_is_between_two_thirds_of_the_time_and_its_end() -> None:
    still, rising = lines_of(results(run("A", curve=STILL), run("B", curve=RISING)))
    assert last_gain(still) == pytest.approx(0.2)
    assert last_gain(rising) == pytest.approx(3.0)
    begun_late = lines_of(results(run("C", curve=[[8.0, 15.0], [9.0, 17.0]])))[0]
    assert last_gain(begun_late) == pytest.approx(2.0)


def test_who_rises_has_not_had_enough_time() -> None:
    lines = lines_of(results(run("A", curve=STILL), run("B", curve=RISING)))
    said = settling(lines)
    assert "A +0.2 dB, B +3.0 dB" in said and "none, B would gain by more time" in said
    assert "all of them have had enough time" in settling(lines[:1])
    assert "all of them would gain by more time" in settling(lines[1:])


def test_tables_of_runs_of_equal_time_say_it_and_no_others() -> None:
    both = [run("A", curve=STILL), run("B", curve=RISING)]
    suite = {"suite": "freeze", "question": "Why?"}
    steps = {"protocol": {"seconds": None, "steps": 400}}
    assert "last third" in table(results(*both, **suite))
    assert "last third" in table(results(*both))
    assert "last third" not in table(results(*both, **suite, **steps))
