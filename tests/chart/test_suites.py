"""Claims about the named comparisons."""

from __future__ import annotations

from pathlib import Path

import pytest
from suite_minutes import CPU_STEPS, minutes_of, minutes_together, on_two_cores

from leco_plugin import cli
from leco_plugin.chart.contender import FAST, SLOW, Cores, config_of, run_seconds
from leco_plugin.chart.methods import (
    AT_ONCE,
    STEPS,
    SUITES,
    SWITCH_CELLS,
    contenders,
    in_order,
)
from leco_plugin.learning.schedule import MOST_EXTENSIONS, steps_of_an_extension
from leco_plugin.method_configs import LEARNING, ON_GPU
from leco_plugin.scenes.input_error import InputError


@pytest.mark.parametrize("name", SUITES)
def test_the_contenders_of_a_suite_differ_and_can_be_configured(name: str) -> None:
    compared = SUITES[name].contenders
    assert len(compared) >= 3
    assert len({one.key for one in compared}) == len({one.name for one in compared})
    assert len({one.key for one in compared}) == len(compared)
    for one in compared:
        assert config_of(one, Path("scene"), Path("runs")).method_name == one.method


@pytest.mark.parametrize("cores", [FAST, SLOW])
@pytest.mark.parametrize("name", SUITES)
def test_three_seeds_of_a_suite_take_at_most_45_minutes(name: str, cores: Cores) -> None:
    found = SUITES[name]
    least = found.seconds or CPU_STEPS * cores.step
    runs = [least + cores.overhead for _ in found.contenders]
    assert 3 * sum(runs) / 2 / 60 <= minutes_of(found, cores) < 45
    assert minutes_of(found, cores, 1) == pytest.approx(minutes_of(found, cores) / 3)


def test_all_suites_of_a_scene_take_less_than_two_hours_and_the_help_says_how_long() -> None:
    together = [minutes_together(list(SUITES), cores) for cores in (FAST, SLOW)]
    alone = [sum(minutes_of(one, cores) for one in SUITES.values()) for cores in (FAST, SLOW)]
    assert max(together) <= 2 * 60 and max(alone) < 4 * 60
    said = " ".join(str(cli.chart.__doc__).split())
    assert f"all take {together[0]:.0f} to {together[1]:.0f} minutes" in said
    for name, found in SUITES.items():
        assert f"{name} {minutes_of(found, FAST):.0f} to {minutes_of(found, SLOW):.0f}" in said


@pytest.mark.skipif(ON_GPU, reason="a GPU takes more steps in that time")
def test_forecasts_are_for_as_many_steps_as_a_run_has() -> None:
    assert STEPS == CPU_STEPS


def test_what_suites_share_is_counted_once() -> None:
    apart = minutes_of(SUITES["enough-time"], FAST) + minutes_of(SUITES["grid-resolution"], FAST)
    shared = [
        c for c in SUITES["grid-resolution"].contenders if c in SUITES["enough-time"].contenders
    ]
    protocol = on_two_cores(SUITES["enough-time"])
    saved = 3 * sum(run_seconds(one, protocol, FAST) for one in shared) / 2 / 60
    assert shared and minutes_together(["enough-time", "grid-resolution"], FAST) == pytest.approx(
        apart - saved
    )
    assert minutes_together(["losses"], FAST) == pytest.approx(minutes_of(SUITES["losses"], FAST))


def test_a_run_of_a_suite_leaves_time_to_learn_an_occupancy_and_to_use_it() -> None:
    for found in SUITES.values():
        budget = found.protocol.budget()
        if budget.seconds is None:
            learning = LEARNING.schedule.learn_steps
            most = learning + MOST_EXTENSIONS * steps_of_an_extension(learning)
            assert budget.learn_seconds is None and budget.steps == STEPS
            assert learning == STEPS // 2 and most < STEPS
        else:
            # one thread beside another run takes 1.38 times the 30 s that two take
            assert budget.learn_seconds is not None
            assert 1.38 * 30.0 <= budget.learn_seconds <= 0.55 * budget.seconds


def test_suites_that_ask_what_was_learned_train_for_equal_steps_and_the_others_for_time() -> None:
    by_steps = {name for name, found in SUITES.items() if found.seconds is None}
    assert by_steps == {"representations", "empty-expert", "losses"}


def test_who_trains_for_time_meets_the_host_with_long_steps() -> None:
    for found in SUITES.values():
        if found.contenders[0].method == "leco-switch-nerf":
            assert "long-steps" in {one.sampler for one in found.contenders}


@pytest.mark.gpu
@pytest.mark.skipif(not ON_GPU, reason="needs a CUDA device")
def test_runs_have_a_gpu_to_themselves() -> None:
    assert AT_ONCE == 1


def test_suites_are_made_in_the_order_in_which_they_share_most() -> None:
    assert in_order(["losses", "representations"]) == ["representations", "losses"]
    assert in_order(["losses", "all", "losses"]) == list(SUITES)
    assert in_order([]) == []
    with pytest.raises(InputError, match="'no-such'"):
        in_order(["all", "no-such"])


def test_guided_switch_nerf_is_that_of_charts_by_method_whose_runs_can_be_reused() -> None:
    grid = f"occupancy-grid-{SWITCH_CELLS}"
    named = contenders(["leco-switch-nerf"], ["learned-occupancy", "own", grid, "long-steps"])
    assert [one.key for one in SUITES["enough-time"].contenders] == [one.key for one in named]
    assert [one.name for one in SUITES["enough-time"].contenders] == [one.name for one in named]
