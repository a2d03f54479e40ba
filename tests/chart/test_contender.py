"""Claims about contenders as data, and the configs of their runs."""

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
    Contender,
    changed,
    config_of,
    in_this_process,
    short_names,
)
from leco_plugin.chart.methods import contenders
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
