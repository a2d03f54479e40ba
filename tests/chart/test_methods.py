"""Claims about which methods, samplers and named comparisons make contenders."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from nerfstudio.configs import method_configs
from nerfstudio.data.scene_box import SceneBox
from suite_minutes import CPU_STEPS, minutes_of, minutes_together, on_two_cores

from leco_plugin import cli
from leco_plugin.chart.contender import FAST, SLOW, Cores, config_of, run_seconds
from leco_plugin.chart.methods import (
    AT_ONCE,
    STEPS,
    SUITES,
    SWITCH_CELLS,
    contender_of_host,
    contenders,
    in_order,
)
from leco_plugin.host_configs import leco_ngp, ngp_host
from leco_plugin.learning.schedule import MOST_EXTENSIONS, steps_of_an_extension
from leco_plugin.method_configs import LEARNING, ON_GPU
from leco_plugin.samplers.base import DenseEstimator
from leco_plugin.scenes.bounds import find_bounds
from leco_plugin.scenes.input_error import InputError


def found(*methods: str, samplers: tuple[str, ...] = ()) -> list[tuple[str, str]]:
    return [(one.method, one.sampler) for one in contenders(methods, samplers)]


def test_a_host_is_charted_guided_as_it_is_and_with_long_steps() -> None:
    assert found("leco-ngp", "leco-nerfacto") == [
        ("leco-ngp", "learned-occupancy"),
        ("leco-ngp", "own"),
        ("leco-ngp", "long-steps"),
        ("leco-nerfacto", "learned-occupancy"),
        ("leco-nerfacto", "own"),
        ("leco-nerfacto", "long-steps"),
    ]


def test_a_learned_occupancy_without_gifts_has_neither_sparse_points_nor_an_opaque_start() -> None:
    (one,) = contenders(["leco-ngp"], ["learned-occupancy-without-gifts"])
    occupancy: Any = config_of(one, Path("scene"), Path("runs")).pipeline.model.occupancy
    assert occupancy.sampler == "learned-occupancy" and not occupancy.opaque_start
    assert occupancy.learning.termination == occupancy.learning.calibration.recheck_rays == 0


def test_a_method_that_learns_itself_is_charted_as_it_is() -> None:
    assert found("leco-occupancy") == [("leco-occupancy", "learned-occupancy")]


def test_each_method_gets_the_samplers_that_it_can_use() -> None:
    samplers = ("learned-occupancy-vm", "dense", "own")
    assert found("leco-occupancy", "leco-ngp", "leco-nerfacto", samplers=samplers) == [
        ("leco-occupancy", "learned-occupancy-vm"),
        ("leco-occupancy", "dense"),
        ("leco-ngp", "learned-occupancy-vm"),
        ("leco-ngp", "dense"),
        ("leco-ngp", "own"),
        ("leco-nerfacto", "learned-occupancy-vm"),
        ("leco-nerfacto", "own"),
    ]


def test_another_kind_of_gate_is_learned_with_its_own_features() -> None:
    own, hosted = contenders(["leco-occupancy", "leco-ngp"], ["learned-occupancy-k-planes"])
    assert own.changes == {"sizes.gate.encoding.kind": "k-planes"}
    assert hosted.changes["occupancy.learning.sizes.gate.encoding.kind"] == "k-planes"
    assert hosted.changes["occupancy.sampler"] == "learned-occupancy-k-planes"


def test_a_taught_grid_has_the_cells_that_its_name_says() -> None:
    ways = ["learned-occupancy-grid", "learned-occupancy-grid-128", "learned-occupancy-grid-32"]
    usual, small = contenders(["leco-ngp"], ways)
    assert [usual.name, small.name] == [f"Instant-NGP + taught grid {n}³" for n in (128, 32)]
    gates = []
    for one in (usual, small, *contenders(["leco-occupancy"], ways)):
        model: Any = config_of(one, Path("scene"), Path("runs")).pipeline.model
        guided = one.method == "leco-ngp"
        sizes = model.occupancy.learning.sizes if guided else model.sizes
        gates.append((sizes.gate.encoding.kind, sizes.gate.encoding.plane_cells))
    assert gates == [("grid", 128), ("grid", 32)] * 2


def test_an_occupancy_grid_has_the_cells_that_its_name_says_and_the_levels_of_the_host() -> None:
    (one,) = contenders(["leco-ngp"], ["occupancy-grid-96"])
    options = {"resolution": 96, "levels": ngp_host().grid_levels}
    assert one.changes == {"occupancy.sampler": "occupancy-grid", "occupancy.options": options}
    assert one.name == "Instant-NGP + grid 96³"


@pytest.mark.parametrize("method", ["leco-ngp", "leco-switch-nerf"])
def test_a_grid_is_one_contender_however_its_cells_are_written(method: str) -> None:
    (usual,) = contenders([method], ["occupancy-grid"])
    cells = usual.sampler.removeprefix("occupancy-grid-")
    ways = ["occupancy-grid", f"occupancy-grid-{cells}", f"occupancy-grid-0{cells}"]
    assert contenders([method], ways) == [usual]
    assert len({one.key for way in ways for one in contenders([method], [way])}) == 1
    assert usual.name.endswith(f" + grid {cells}³")


def test_a_host_that_asks_every_sample_goes_as_far_as_its_own_grid() -> None:
    (one,) = contenders(["leco-ngp"], ["dense"])
    assert one.changes["occupancy.options"] == {"levels": ngp_host().grid_levels}


def test_switch_nerf_uses_the_grid_that_it_fits_to_its_bounds() -> None:
    (one,) = contenders(["leco-switch-nerf"], ["occupancy-grid-96"])
    assert one.changes == {
        "occupancy.sampler": "own",
        "host.sampling": "occupancy-grid",
        "host.sizes.grid_resolution": 96,
    }


def test_names_say_what_a_host_does_by_itself() -> None:
    methods = ["leco-ngp", "leco-nerfacto", "leco-switch-nerf"]
    assert [one.name for one in contenders(methods, ["own"])] == [
        f"Instant-NGP + own grid {ngp_host().grid_resolution}³",
        "Nerfacto + proposal networks",
        "Switch-NeRF + coarse and fine samples",
    ]


@pytest.mark.parametrize("method", ["leco-ngp", "leco-nerfacto", "leco-switch-nerf"])
def test_long_steps_are_four_times_as_long_and_none_is_skipped(method: str) -> None:
    box = SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3]))
    made, own = (
        config_of(one, Path("scene"), Path("runs")).pipeline.model.setup(
            scene_box=box, num_train_data=2, metadata={}, device="cpu"
        )
        for one in contenders([method], ["long-steps", "own"])
    )
    if method == "leco-ngp":
        assert made.config.cone_angle == 4 * own.config.cone_angle
        assert made.config.render_step_size == pytest.approx(4 * own.config.render_step_size)
        assert torch.equal(made.occupancy_grid.bounds(), own.occupancy_grid.aabbs[-1])
        samples = made.occupancy_grid.sampling(torch.zeros(1, 3), torch.eye(3)[:1], far_plane=5.0)
        assert (samples[2] - samples[1]).sum() == pytest.approx(5.0, abs=0.01)
    elif method == "leco-nerfacto":
        assert (
            4 * made.proposal_sampler.sampler.samples == own.config.num_proposal_samples_per_ray[0]
        )
    else:
        poses = torch.eye(4)[None, :3].repeat(2, 1, 1)
        poses[1, 0, 3] = 1.0
        bounds = find_bounds(poses, -torch.eye(3)[None, 2:].repeat(2, 1, 1), None)
        made.set_bounds(bounds, 1.0)
        own.set_bounds(bounds, 1.0)
        assert float(made.step) == pytest.approx(4 * float(own.step), rel=0.1)
        assert isinstance(made.occupancy_grid, DenseEstimator)


def test_a_host_without_a_rule_for_its_steps_has_no_long_ones() -> None:
    assert contender_of_host("third", "long-steps", object()) is None


def test_the_phases_of_learning_are_methods_of_the_chart() -> None:
    names = [f"leco-occupancy-{what}" for what in ("never-frozen", "retrained", "homogeneous")]
    never, retrained, homogeneous = contenders(names)
    assert never.changes == {"schedule.freeze": False, "front_to_back": True}
    assert retrained.changes == {"schedule.restart": True}
    four = {"sizes.field.experts.scene_experts": 4, "sizes.gate.scene_experts": 4}
    assert homogeneous.changes == never.changes | four | {"homogeneous": True}
    assert contenders(["leco-occupancy"], ["dense"]) == [never]


def test_a_method_joins_by_being_registered(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = replace(leco_ngp.config.pipeline, model=ngp_host())
    config = replace(leco_ngp.config, method_name="third", pipeline=plain)
    monkeypatch.setitem(method_configs.all_methods, "third", config)
    assert found("third") == [("third", "own")]
    assert found("third", samplers=("learned-occupancy",)) == [("third", "learned-occupancy")]


def test_what_is_asked_for_twice_is_made_once() -> None:
    assert len(contenders(["leco-ngp", "leco-ngp"], ["own", "own"])) == 1


@pytest.mark.parametrize(
    ("methods", "samplers", "said"),
    [
        ([], [], "--methods"),
        (["no-such"], [], "no method 'no-such'.*leco-occupancy-retrained"),
        (["leco-ngp"], ["no-such"], "no sampler 'no-such'.*own"),
        (["leco-ngp"], ["occupancy-grid-"], "no sampler"),
        (["leco-ngp"], ["occupancy-grid-0"], "'occupancy-grid-0' has too few cells"),
        (["leco-ngp"], ["occupancy-grid-01"], "'occupancy-grid-01' has too few cells"),
        (["leco-ngp"], ["learned-occupancy-grid-1"], "has too few cells"),
        (["leco-ngp"], ["learned-occupancy-grid-500"], "too many cells: .* 251511967 values"),
        (["leco-occupancy"], ["own"], "leco-occupancy has none of the samplers own"),
        (["leco-nerfacto"], ["dense"], "leco-nerfacto has none of the samplers dense"),
        (["leco-nerfacto"], ["own", "dense"], "'dense' fits none of leco-nerfacto"),
        (["leco-occupancy-retrained"], ["dense"], "it has learned-occupancy"),
    ],
)
def test_unknown_choices_are_refused(methods: list[str], samplers: list[str], said: str) -> None:
    with pytest.raises(InputError, match=said) as refused:
        contenders(methods, samplers)
    assert "\n" not in str(refused.value)


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
