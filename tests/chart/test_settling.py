"""Claims about what runs still gain at last."""

from __future__ import annotations

from pathlib import Path

import pytest
from chart_results import results, run

from leco_plugin.chart.drawing.page import write_page
from leco_plugin.chart.drawing.table import table
from leco_plugin.chart.findings.settling import falls, last_gain, settling, still_rising
from leco_plugin.chart.findings.summary import lines_of

STILL = [[3.0, 18.0], [6.0, 20.0], [9.0, 20.2]]
RISING = [[3.0, 15.0], [6.0, 18.0], [9.0, 21.0]]


def test_the_gain_of_the_last_third_is_between_two_thirds_of_the_time_and_its_end() -> None:
    still, rising = lines_of(results(run("A", curve=STILL), run("B", curve=RISING)))
    assert last_gain(still) == pytest.approx(0.2)
    assert last_gain(rising) == pytest.approx(3.0)
    begun_late = lines_of(results(run("C", curve=[[8.0, 15.0], [9.0, 17.0]])))[0]
    assert last_gain(begun_late) is None


def test_who_rises_or_may_rise_is_named_and_nobody_is_said_to_have_had_enough() -> None:
    lines = lines_of(results(run("A", curve=STILL), run("B", curve=RISING)))
    said = settling(lines)
    assert "A +0.2 dB, B +3.0 dB. Still rising: B; rates fall" in said
    assert "Still rising: none;" in settling(lines[:1])
    assert "Still rising: all of them;" in settling(lines[1:])
    late = lines_of(results(run("A", curve=STILL), run("C", curve=[[9.0, 17.0]])))
    assert "C unknown. Still rising: C;" in settling(late)


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


def test_tables_of_runs_of_equal_time_say_it_and_no_others() -> None:
    both = [run("A", curve=STILL), run("B", curve=RISING)]
    suite = {"suite": "freeze", "question": "Why?"}
    steps = {"protocol": {"seconds": None, "steps": 400}}
    assert "last third" in table(results(*both, **suite))
    assert "last third" in table(results(*both))
    assert "last third" not in table(results(*both, **suite, **steps))


def test_runs_that_end_below_their_best_point_are_named_on_table_and_page(tmp_path: Path) -> None:
    fell = run("B", curve=[[3.0, 18.0], [6.0, 20.0], [9.0, 19.6]])
    both = results(run("A", curve=STILL), fell)
    said = "Fell from their own best point: B in 1 of 1 run, by at most 0.40 dB."
    assert falls(lines_of(both)) == said
    assert said in table(both) and said in write_page(both, tmp_path / "chart.html").read_text()
    one = results(*(run("B", seed=seed, curve=STILL) for seed in (0, 1)), fell | {"seed": 2})
    assert falls(lines_of(one)) == said.replace("1 of 1 run", "1 of 3 runs")
    hardly = run("B", curve=[[3.0, 18.0], [6.0, 20.0], [9.0, 19.95]])
    assert falls(lines_of(results(run("A", curve=STILL), hardly))) is None
