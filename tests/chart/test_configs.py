"""Claims about the configs of a chart's runs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from leco_plugin.chart.contenders.configs import config_of
from leco_plugin.chart.contenders.contender import Contender
from leco_plugin.chart.contenders.methods import contenders
from leco_plugin.host_configs import leco_ngp
from leco_plugin.hosts.guided import GuidedModelConfig
from leco_plugin.method_configs import best_device
from leco_plugin.scenes.photographs import LecoPhotographsDataParserConfig

DATA, FOLDER = Path("scene"), Path("runs")


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


def test_a_host_keeps_to_the_time_for_learning() -> None:
    config = config_of(contenders(["leco-ngp"])[0], DATA, FOLDER, learn_seconds=7.0)
    assert config.pipeline.model.occupancy.seconds == 7.0


def test_a_setting_that_the_method_has_not_is_named() -> None:
    wrong = replace(contenders(["leco-occupancy"])[0], changes={"sizes.gates": 1})
    with pytest.raises(ValueError, match="'gates'"):
        config_of(wrong, DATA, FOLDER)


def test_an_unknown_method_is_named() -> None:
    with pytest.raises(ValueError, match="no-such"):
        config_of(Contender("x", "no-such", "own"), DATA, FOLDER)
