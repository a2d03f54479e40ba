"""Claims about the named comparisons."""

from __future__ import annotations

from pathlib import Path

import pytest

from leco_plugin import cli
from leco_plugin.chart.configs import config_of
from leco_plugin.chart.methods import contenders
from leco_plugin.chart.protocol import OVERHEAD_SECONDS, Protocol
from leco_plugin.chart.suites import SUITES, SWITCH_CELLS, suite
from leco_plugin.scenes.input_error import InputError

NAMES = {
    "empty-expert",
    "losses",
    "freeze",
    "representations",
    "enough-time",
    "grid-resolution",
}


def test_there_is_a_suite_for_every_question() -> None:
    assert set(SUITES) == NAMES


@pytest.mark.parametrize("name", sorted(NAMES))
def test_the_contenders_of_a_suite_differ_and_can_be_configured(name: str) -> None:
    compared = SUITES[name].contenders
    assert len(compared) >= 3
    assert len({one.key for one in compared}) == len({one.name for one in compared})
    assert len({one.key for one in compared}) == len(compared)
    for one in compared:
        assert config_of(one, Path("scene"), Path("runs")).method_name == one.method


@pytest.mark.parametrize("name", sorted(NAMES))
def test_three_seeds_of_a_suite_take_less_than_45_minutes(name: str) -> None:
    found = SUITES[name]
    runs = [one.budget * found.seconds + OVERHEAD_SECONDS for one in found.contenders]
    assert 3 * sum(runs) / 60 <= found.minutes() < 45
    assert found.minutes(1) == pytest.approx(found.minutes() / 3)


def test_all_suites_take_less_than_four_hours_and_the_help_says_how_long_each_takes() -> None:
    assert sum(one.minutes() for one in SUITES.values()) < 4 * 60
    said = " ".join(str(cli.chart.__doc__).split())
    for name, found in SUITES.items():
        assert f"{name} {found.minutes():.0f}" in said


def test_a_run_of_a_suite_leaves_time_to_learn_an_occupancy_and_to_use_it() -> None:
    for found in SUITES.values():
        learning = Protocol(found.seconds, None, found.learn_seconds).budget().learn_seconds
        assert learning is not None and 30.0 <= learning <= 0.55 * found.seconds


def test_suites_one_after_the_other_share_their_runs_and_take_less_than_three_hours() -> None:
    made: set[tuple[str, float]] = set()
    minutes = 0.0
    for found in SUITES.values():
        protocol = Protocol(found.seconds, None, found.learn_seconds)
        new = [c for c in found.contenders if (c.without_grids().key, found.seconds) not in made]
        made |= {(c.without_grids().key, found.seconds) for c in new}
        minutes += 3 * (protocol.minutes(new) or 0.0)
    assert minutes < 160


def test_guided_switch_nerf_is_that_of_charts_by_method_whose_runs_can_be_reused() -> None:
    named = contenders(
        ["leco-switch-nerf"], ["learned-occupancy", "own", f"occupancy-grid-{SWITCH_CELLS}"]
    )
    assert [one.key for one in SUITES["enough-time"].contenders] == [one.key for one in named]
    assert [one.name for one in SUITES["enough-time"].contenders] == [one.name for one in named]


def test_an_unknown_suite_is_named_beside_those_there_are() -> None:
    with pytest.raises(InputError, match=r"'no-such'.*empty-expert"):
        suite("no-such")
