"""What becomes of a method's config when its sampler is swapped, and what is refused."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from ball_occupancy import ball
from nerfstudio.configs.method_configs import all_methods
from nerfstudio.data.dataparsers.nerfstudio_dataparser import (
    Nerfstudio,
    NerfstudioDataParserConfig,
)
from PIL import Image

from leco_plugin.hosts.guided import GuidedModelConfig
from leco_plugin.scenes.input_error import InputError
from leco_plugin.studio.dynamic_batch import ClampedDynamicBatchPipelineConfig
from leco_plugin.swap import learned_first, registered, swapped_config


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("occupancy") / "occupancy.safetensors"
    ball().save(path)
    return path


def test_only_sampler_batches_and_trainer_are_others(file: Path) -> None:
    before = registered("instant-ngp")
    made: Any = swapped_config("instant-ngp", file, ["--max-num-iterations", "7"])
    assert made.method_name == "instant-ngp" and made.max_num_iterations == 7
    assert made.optimizers == before.optimizers
    assert isinstance(made.pipeline, ClampedDynamicBatchPipelineConfig)
    guided = made.pipeline.model
    assert isinstance(guided, GuidedModelConfig)
    assert guided.host == before.pipeline.model  # type: ignore[attr-defined]
    assert guided.occupancy.path == file and guided.occupancy.sampler == "learned-occupancy"


def test_pictures_of_a_swapped_method_are_checked_by_its_own_reader_too(
    file: Path, tiny_scene: Path, tmp_path: Path
) -> None:
    scene = Path(shutil.copytree(tiny_scene, tmp_path / "scene"))
    for path in scene.glob("images/*"):
        grey = np.asarray(Image.open(path).convert("L"), dtype=np.uint16)
        Image.fromarray(256 * grey).save(path)
    made: Any = swapped_config("nerfacto", file, ["--data", str(scene)])
    reader = made.pipeline.datamanager.dataparser
    assert type(reader) is NerfstudioDataParserConfig
    parser = replace(yaml.load(yaml.dump(reader), Loader=yaml.Loader), data=scene).setup()
    assert isinstance(parser, Nerfstudio)
    with pytest.raises(InputError, match="16") as error:
        parser.get_dataparser_outputs("train")
    assert "\n" not in str(error.value)


def test_options_of_the_sampler_are_in_the_config(file: Path) -> None:
    options = {"cache_bytes": 0, "num_candidates": 64}
    made: Any = swapped_config("nerfacto", file, options=options)
    assert made.pipeline.model.occupancy.options == options
    assert yaml.load(yaml.dump(made), Loader=yaml.Loader) == made


def test_without_a_file_one_is_learned_first_in_the_sizes_of_this_device() -> None:
    made: Any = swapped_config("instant-ngp", None)
    guided = made.pipeline.model
    assert guided.occupancy == learned_first() and guided.occupancy.path is None
    assert guided.host == registered("instant-ngp").pipeline.model  # type: ignore[attr-defined]
    ngp: Any = registered("leco-ngp")
    assert guided.occupancy == ngp.pipeline.model.occupancy
    soon: Any = swapped_config("instant-ngp", None, learn_seconds=9.0)
    assert soon.pipeline.model.occupancy == replace(learned_first(), seconds=9.0)


def test_a_sampler_that_asks_no_occupancy_is_given_none() -> None:
    options = {"resolution": 32}
    made: Any = swapped_config("instant-ngp", None, [], "occupancy-grid", options)
    occupancy = made.pipeline.model.occupancy
    assert occupancy.path is None and occupancy.sampler == "occupancy-grid"
    assert occupancy.options == options


def test_a_swap_may_insist_on_the_occupancy_of_another_scene(file: Path) -> None:
    for insists in (False, True):
        made: Any = swapped_config("nerfacto", file, other_scene=insists)
        assert made.pipeline.model.occupancy.other_scene is insists


def test_what_is_registered_stays_as_it_is(file: Path) -> None:
    swapped_config("nerfacto", file, ["--pipeline.model.near-plane", "0.3"])
    host: Any = all_methods["nerfacto"].pipeline.model
    assert not isinstance(host, GuidedModelConfig) and host.near_plane != 0.3


def test_a_relative_file_is_stored_as_an_absolute_one(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(file.parent)
    for given in (Path(file.name), Path(".")):
        made: Any = swapped_config("nerfacto", given)
        assert made.pipeline.model.occupancy.path == file


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "an unknown method": ({"method": "nerfato"}, "no method 'nerfato'; did you mean nerfacto"),
    "a method without its package": ({"method": "kplanes"}, "not installed"),
    "a guided method": (
        {"method": "leco-ngp"},
        "ns-train leco-ngp --pipeline.model.occupancy.path .*occupancy.safetensors",
    ),
    "a method that draws no rays": (
        {"method": "splatfacto"},
        "splatfacto draws whole images, not rays.*`leco export FILE` writes points",
    ),
    "the method that learns": ({"method": "leco-occupancy"}, "is no host"),
    "an unknown sampler": ({"sampler": "learnt"}, "no sampler 'learnt'; there are"),
    "another kind of gate": ({"sampler": "learned-occupancy-hash"}, "asks a gate on hash"),
    "a gate that would not be learned": (
        {"file": None, "sampler": "learned-occupancy-hash"},
        "asks a gate on hash features",
    ),
    "an option that there is not": (
        {"sampler": "occupancy-grid", "options": {"levels": 2, "cells": 64}},
        "'occupancy-grid' has no option 'cells'; there are levels, resolution",
    ),
    "another run's config": (
        {"arguments": ["--load-config", "config.yml"]},
        "--load-config would train what that file says",
    ),
    "seconds for what is given": ({"learn_seconds": 9.0}, "leave one out"),
    "a file for a grid": (
        {"sampler": "occupancy-grid"},
        "asks no occupancy: leave --occupancy and",
    ),
    "seconds for a grid": (
        {"sampler": "dense", "file": None, "learn_seconds": 9.0},
        "'dense' asks no occupancy",
    ),
    "a file that is not there": ({"file": Path("none.safetensors")}, "there is no occupancy"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_cannot_be_swapped_is_said_in_a_line(what: str, file: Path) -> None:
    given, message = REFUSED[what]
    with pytest.raises(InputError, match=message) as error:
        swapped_config(**({"method": "nerfacto", "file": file} | given))
    assert "\n" not in str(error.value)


def test_a_scene_that_is_not_there_is_said_before_the_run_has_a_folder(
    file: Path, tmp_path: Path
) -> None:
    scene = tmp_path / "nowhere"
    with pytest.raises(InputError, match=f"there is no scene {scene}"):
        swapped_config("nerfacto", file, ["--data", str(scene)])
    scene.mkdir()
    assert swapped_config("nerfacto", file, ["--data", str(scene)]).data == scene
