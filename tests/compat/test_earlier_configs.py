"""Runs that an earlier release began can be gone on with, evaluated and rendered."""

from __future__ import annotations

import copy
import pickle
from pathlib import Path
from typing import Any

import pytest
import yaml
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManagerConfig

from leco_plugin.learning.merging import MergingConfig
from leco_plugin.method_configs import leco_occupancy
from leco_plugin.models.guided import GuidedModelConfig
from leco_plugin.models.hosts.guided_start import OccupancyConfig
from leco_plugin.models.leco_config import LecoModelConfig
from leco_plugin.models.switch.config import SwitchNerfModelConfig
from leco_plugin.scenes.bounds import BoundsConfig
from leco_plugin.scenes.data_manager import LecoDataManager
from leco_plugin.scenes.photographs import LecoPhotographsDataParserConfig
from leco_plugin.scenes.pixels.known_distances import KnownDistancePixelSamplerConfig

# nerfstudio leaves images open that it has read
pytestmark = [
    pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]


@pytest.mark.parametrize("kind", [LecoModelConfig, SwitchNerfModelConfig])
def test_a_stored_config_without_later_fields_has_their_defaults(kind: Any) -> None:
    config = kind(near=0.25)
    del config.__dict__["bounds"]
    found = yaml.load(yaml.dump(config), Loader=yaml.Loader)
    assert found.bounds == BoundsConfig() and found.near == 0.25
    assert found == kind(near=0.25) and repr(found)


def test_a_guided_run_of_an_earlier_release_has_no_options() -> None:
    config = GuidedModelConfig(occupancy=OccupancyConfig(Path("some.safetensors"), seconds=7.0))
    del config.occupancy.__dict__["options"]
    found = yaml.load(yaml.dump(config), Loader=yaml.Loader)
    expected = OccupancyConfig(Path("some.safetensors"), seconds=7.0)
    assert found == GuidedModelConfig(occupancy=expected)


def test_what_is_stored_goes_before_defaults() -> None:
    bounds, merging = BoundsConfig(altitudes=(-1.0, 2.0)), MergingConfig(rays=7)
    config = LecoModelConfig(bounds=bounds, merging=merging)
    for found in (copy.deepcopy(config), pickle.loads(pickle.dumps(config))):
        assert found == config


def test_a_whole_method_is_read_back_as_it_was_written() -> None:
    config = leco_occupancy.config
    assert yaml.load(yaml.dump(config), Loader=yaml.Loader) == config


def test_the_data_manager_takes_the_config_of_an_earlier_run(tiny_scene: Path) -> None:
    config = VanillaDataManagerConfig(
        dataparser=LecoPhotographsDataParserConfig(data=tiny_scene),
        train_num_rays_per_batch=16,
        pixel_sampler=KnownDistancePixelSamplerConfig(),
    )
    config._target = LecoDataManager  # as nerfstudio's eval_setup does
    manager: Any = config.setup(device="cpu")
    bundle, batch = manager.next_train(0)
    assert len(bundle) == len(batch["image"]) == 16
