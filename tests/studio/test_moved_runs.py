"""A run that was moved after it was trained is evaluated where it is now."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from nerfstudio.utils import eval_utils, writer
from tiny_run import tiny_trainer

from leco_plugin.capacity.sources import find_source
from leco_plugin.method_configs import leco_occupancy
from leco_plugin.scenes.input_error import InputError
from leco_plugin.studio.checkpoints import config_in_use, found_around


@pytest.fixture(scope="module")
def trained(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a scene and a checkpoint of a run on it, moved since it was trained."""
    gate = replace(leco_occupancy.config.pipeline.model.sizes.gate, width=8, layers=1)
    place = tmp_path_factory.mktemp("place")
    project = place / "project"
    shutil.copytree(tiny_scene, project / "data" / "scene")
    trainer = tiny_trainer(project / "data" / "scene", project / "outputs", gate, candidates=32)
    trainer.save_checkpoint(7)
    for each in writer.EVENT_WRITERS:
        if isinstance(each, writer.TensorboardWriter):
            each.tb_writer.close()  # its thread would miss its folder in a later test
    writer.EVENT_WRITERS.clear()
    return Path(shutil.move(project, place / "moved"))


def config_of(project: Path) -> Path:
    return next(project.rglob("config.yml"))


def test_a_run_is_found_beside_its_config_and_its_data_where_they_lay(
    trained: Path, tmp_path: Path, printed: Any
) -> None:
    project = Path(shutil.copytree(trained, tmp_path / "project"))
    loaded: tuple[Any, ...] = eval_utils.eval_setup(config_of(project))
    _, pipeline, checkpoint, step = loaded
    assert step == 7 and checkpoint.parent == config_of(project).parent / "nerfstudio_models"
    assert pipeline.datamanager.get_datapath() == project / "data" / "scene"
    assert "data/scene is not there;" in printed()


def test_checkpoints_in_folders_of_folders_are_found_beside_it(trained: Path) -> None:
    config = config_of(trained)
    text = config.read_text()
    config.write_text(text.replace("- nerfstudio_models\n", "- models/of_this\n"))
    nested = config.parent / "models" / "of_this"
    nested.parent.mkdir()
    (config.parent / "nerfstudio_models").rename(nested)
    try:
        assert eval_utils.eval_setup(config)[2].parent == nested
        source = find_source(config.parent / "occupancy.safetensors", trained / "data" / "scene")
        assert source.model is not None
    finally:
        nested.rename(config.parent / "nerfstudio_models")
        config.write_text(text)


@pytest.mark.parametrize("linked", [False, True])
def test_what_the_error_asks_for_is_enough(trained: Path, tmp_path: Path, linked: bool) -> None:
    run = Path(shutil.copytree(config_of(trained).parent, tmp_path / "run"))
    scene = Path(shutil.copytree(trained / "data" / "scene", tmp_path / "elsewhere" / "photos"))
    with pytest.raises(InputError) as caught:
        eval_utils.eval_setup(run / "config.yml")
    said = str(caught.value)
    assert "\n" not in said and "--data" not in said
    assert f"a link with the name scene, beside {run / 'config.yml'}" in said
    if linked:
        (run / "scene").symlink_to(scene)
    else:
        scene.rename(run / "scene")
    assert eval_utils.eval_setup(run / "config.yml")[3] == 7
    shutil.move(run / "nerfstudio_models", tmp_path / "kept")
    with pytest.raises(InputError, match=r"put the folder nerfstudio_models of this run beside"):
        eval_utils.eval_setup(run / "config.yml")


def test_data_that_a_command_names_are_read(trained: Path, tmp_path: Path) -> None:
    run = Path(shutil.copytree(config_of(trained).parent, tmp_path / "run"))
    scene = Path(shutil.copytree(trained / "data" / "scene", tmp_path / "elsewhere" / "photos"))

    def named_by_command(config: Any) -> Any:  # as ns-render dataset --data
        config.pipeline.datamanager.data = scene
        return config

    loaded: tuple[Any, ...] = eval_utils.eval_setup(
        run / "config.yml", update_config_callback=named_by_command
    )
    assert loaded[3] == 7 and loaded[1].datamanager.get_datapath() == scene
    shutil.rmtree(scene)
    with pytest.raises(InputError, match="a link with the name photos, beside"):
        eval_utils.eval_setup(run / "config.yml", update_config_callback=named_by_command)


def test_runs_and_files_of_other_scenes_are_not_taken_for_data(tmp_path: Path) -> None:
    run = tmp_path / "outputs" / "exp2" / "leco-ngp" / "b"
    other = tmp_path / "outputs" / "caliterra" / "leco-ngp" / "a"
    for folder in (run, other):
        folder.mkdir(parents=True)
        (folder / "config.yml").touch()
    named = Path("/gone/data/caliterra")
    assert found_around(named, run) is None
    (tmp_path / "caliterra" / "images").mkdir(parents=True)
    assert found_around(named, run) == tmp_path / "caliterra"

    file = Path("/gone/siteA/transforms.json")
    (tmp_path / "transforms.json").touch()
    assert found_around(file, run) is None
    (run / "transforms.json").touch()
    assert found_around(file, run) == run / "transforms.json"
    (tmp_path / "siteA").mkdir()
    (tmp_path / "siteA" / "transforms.json").touch()
    assert found_around(file, run) == tmp_path / "siteA" / "transforms.json"


def test_the_longest_part_of_a_path_that_exists_is_taken(tmp_path: Path) -> None:
    run = tmp_path / "outputs" / "scene" / "method" / "run"
    run.mkdir(parents=True)
    assert found_around(Path("/gone/data/scene"), run) is None
    (tmp_path / "scene").mkdir()
    assert found_around(Path("/gone/data/scene"), run) == tmp_path / "scene"
    (tmp_path / "data" / "scene").mkdir(parents=True)
    assert found_around(Path("/gone/data/scene"), run) == tmp_path / "data" / "scene"
    assert found_around(Path("data/scene"), run) == tmp_path / "data" / "scene"


def test_outside_of_an_evaluation_no_config_is_in_use() -> None:
    assert config_in_use() is None
