"""Claims about contenders as data, the configs of their runs, and how long these take."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest
from nerfstudio.configs import method_configs
from nerfstudio.data.datamanagers.base_datamanager import (
    VanillaDataManager,
    VanillaDataManagerConfig,
)
from nerfstudio.data.datamanagers.parallel_datamanager import ParallelDataManagerConfig
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig

from leco_plugin.chart.contender import (
    FAST,
    LEARN_SHARE,
    SLOW,
    SMALL,
    UNGUIDED,
    Contender,
    Cores,
    Protocol,
    changed,
    config_of,
    forecast,
    forecast_minutes,
    in_this_process,
    run_seconds,
    settings_of,
    short_names,
)
from leco_plugin.chart.methods import SUITES, contenders
from leco_plugin.host_configs import leco_ngp
from leco_plugin.hosts.guided import GuidedModelConfig
from leco_plugin.method_configs import best_device
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.photographs import LecoPhotographsDataParserConfig
from leco_plugin.swap import registered

DATA, FOLDER = Path("scene"), Path("runs")


@dataclass(frozen=True)
class Inner:
    depth: int = 1


@dataclass
class Outer:
    inner: Inner = field(default_factory=Inner)
    width: int = 2


CONTENDER = Contender("A + b", "a", "b", {"inner.depth": 3}, (64,))


def test_a_setting_deep_in_a_config_is_changed_and_the_original_is_not() -> None:
    before = Outer()
    after = changed(before, "inner.depth", 5)
    assert after == Outer(Inner(5)) and before == Outer()


@pytest.mark.parametrize("path", ["height", "inner.height", "width.depth"])
def test_a_setting_that_is_not_there_is_named(path: str) -> None:
    with pytest.raises(ValueError, match=path.rpartition(".")[2]):
        changed(Outer(), path, 1)


def test_a_contender_survives_json() -> None:
    again = Contender.from_dict(json.loads(json.dumps(asdict(CONTENDER))))
    assert again == CONTENDER and again.key == CONTENDER.key


def test_the_name_is_no_part_of_what_a_contender_is() -> None:
    assert replace(CONTENDER, name="other").key == CONTENDER.key


@pytest.mark.parametrize(
    "change",
    [
        {"method": "x"},
        {"sampler": "x"},
        {"changes": {"inner.depth": 4}},
        {"grids": ()},
        {"taught": True},
        {"settings": {"steps_per_save": 3}},
    ],
)
def test_everything_else_is(change: dict[str, object]) -> None:
    assert replace(CONTENDER, **change).key != CONTENDER.key


@pytest.mark.parametrize(
    ("names", "short"),
    [
        (["NGP + a", "NGP + b"], ["a", "b"]),
        (["LeCO + a", "LeCO, never frozen"], ["a", "never frozen"]),
        (["NGP + a", "Nerfacto + a"], ["NGP + a", "Nerfacto + a"]),
        (["identity", "MLP"], ["identity", "MLP"]),
        (["NGP + a", "b"], ["NGP + a", "b"]),
        (["NGP + a"], ["NGP + a"]),
    ],
)
def test_short_names_leave_out_a_shared_method(names: list[str], short: list[str]) -> None:
    assert short_names(names) == short


def test_the_changes_of_a_contender_reach_its_model_and_no_other() -> None:
    (one,) = contenders(["leco-ngp"], ["occupancy-grid-96"])
    model: Any = config_of(one, DATA, FOLDER).pipeline.model
    assert model.occupancy.sampler == "occupancy-grid"
    assert model.occupancy.options == {"resolution": 96, "levels": 4}
    assert leco_ngp.config.pipeline.model.occupancy.options == {}


def test_data_folder_and_device_are_set() -> None:
    config = config_of(contenders(["leco-occupancy"])[0], DATA, FOLDER)
    assert config.pipeline.datamanager.data == DATA
    assert config.output_dir == FOLDER
    assert config.machine.device_type == best_device()


def test_a_method_of_nerfstudio_reads_the_scene_as_ours_do_and_can_be_guided() -> None:
    config = config_of(contenders(["nerfacto"])[0], DATA, FOLDER)
    assert type(config.pipeline.datamanager.dataparser) is LecoPhotographsDataParserConfig
    model: Any = config.pipeline.model
    assert isinstance(model, GuidedModelConfig) and model.occupancy.sampler == "own"


@pytest.mark.parametrize("method", ["nerfacto", "tensorf", "mipnerf", "leco-nerfacto"])
def test_rays_are_drawn_on_the_clock_and_not_by_another_process(method: str) -> None:
    """The clock of a run counts one process."""
    own: Any = registered(method).pipeline
    made: Any = config_of(contenders([method], ["own"])[0], DATA, FOLDER).pipeline.datamanager
    assert not isinstance(made, ParallelDataManagerConfig)
    if isinstance(own.datamanager, ParallelDataManagerConfig):
        assert type(made) is VanillaDataManagerConfig and made._target is VanillaDataManager
    assert made.train_num_rays_per_batch == own.datamanager.train_num_rays_per_batch
    assert made.eval_num_rays_per_batch == own.datamanager.eval_num_rays_per_batch
    if method != "tensorf":  # that has a reader of its own
        assert type(made.dataparser) is LecoPhotographsDataParserConfig


def test_a_third_party_that_draws_rays_elsewhere_is_refused_in_a_line() -> None:
    class Elsewhere(ParallelDataManagerConfig):
        pass

    with pytest.raises(InputError, match=r"^Elsewhere draws rays in other processes") as refused:
        in_this_process(Elsewhere())
    assert "\n" not in str(refused.value)


def test_every_contender_is_tested_on_the_photographs_that_are_asked_for() -> None:
    for one in contenders(["leco-occupancy", "nerfacto"]):
        reader = config_of(one, DATA, FOLDER, held_out="stretch").pipeline.datamanager.dataparser
        assert reader.held_out == "stretch"
        reader = config_of(one, DATA, FOLDER).pipeline.datamanager.dataparser
        assert reader.held_out == "spread"


def test_only_our_reader_holds_out_a_stretch(monkeypatch: pytest.MonkeyPatch) -> None:
    data = replace(leco_ngp.config.pipeline.datamanager, dataparser=BlenderDataParserConfig())
    config = replace(
        leco_ngp.config,
        method_name="third",
        pipeline=replace(leco_ngp.config.pipeline, datamanager=data),
    )
    monkeypatch.setitem(method_configs.all_methods, "third", config)
    (one,) = contenders(["third"], ["own"])
    with pytest.raises(InputError, match="third has a reader of its own"):
        config_of(one, DATA, FOLDER, held_out="stretch")


def test_a_host_keeps_to_the_time_for_learning() -> None:
    config = config_of(contenders(["leco-ngp"])[0], DATA, FOLDER, learn_seconds=7.0)
    assert config.pipeline.model.occupancy.seconds == 7.0


def test_a_setting_that_the_method_has_not_is_named() -> None:
    wrong = replace(contenders(["leco-occupancy"])[0], changes={"sizes.gates": 1})
    with pytest.raises(ValueError, match="'gates'"):
        config_of(wrong, DATA, FOLDER)


def test_a_learning_time_of_a_contenders_own_is_not_the_charts() -> None:
    one = replace(contenders(["leco-ngp"])[0], changes={"occupancy.seconds": 3.0})
    config: Any = config_of(one, DATA, FOLDER, learn_seconds=7.0)
    assert config.pipeline.model.occupancy.seconds == 3.0


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
