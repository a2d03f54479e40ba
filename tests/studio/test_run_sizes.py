"""The sizes that a run has chosen stay those of the run, whatever becomes of its scene."""

from __future__ import annotations

import copy
import json
import shutil
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from nerfstudio.utils.eval_utils import eval_setup

from leco_plugin.learning.calibration import CalibrationConfig
from leco_plugin.learning.schedule import ScheduleConfig
from leco_plugin.method_configs import leco_occupancy
from leco_plugin.models.sizing.sizes import left_open, with_size
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.survey import CAMERAS
from leco_plugin.studio.run_folder import checkpoint_of

STEPS = 2


def config_of(scene: Path, folder: Path, name: str, **changes: Any) -> Any:
    """A run of a few steps in automatic sizes that is never frozen."""
    config: Any = copy.deepcopy(leco_occupancy.config)
    manager = config.pipeline.datamanager
    manager.data, manager.train_num_rays_per_batch = scene, 32
    manager.dataparser.downscale_factor = 1  # else nerfstudio leaves an image open to look at it
    model = config.pipeline.model
    config.pipeline.model = replace(
        model,
        sizes=replace(model.sizes, candidates=64, learn_candidates=32),
        schedule=ScheduleConfig(learn_steps=1000, freeze=False),
        calibration=CalibrationConfig(rays=32),
    )
    config.machine.device_type = "cpu"
    return replace(
        config,
        data=scene,
        output_dir=folder,
        experiment_name="sizes",
        timestamp=name,
        max_num_iterations=STEPS,
        vis="tensorboard",
        steps_per_eval_image=0,
        **changes,
    )


def run(config: Any) -> Any:
    """What `ns-train` does with a config; its trainer."""
    config.save_config()
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    trainer.train()
    return trainer


@pytest.fixture(scope="module")
def scene(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy that tests may take images from."""
    return Path(shutil.copytree(tiny_scene, tmp_path_factory.mktemp("sizes") / "ball"))


@pytest.fixture(scope="module")
def begun(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A finished run in automatic sizes, its trainer."""
    trainer = run(config_of(scene, tmp_path_factory.mktemp("runs"), "begun"))
    assert not left_open(trainer.pipeline.model.config.sizes)
    return trainer


@pytest.fixture
def poorer(scene: Path) -> Any:
    """The scene with an image less, so that other sizes would be chosen; whole again afterwards."""
    description = scene / "transforms.json"
    whole = description.read_text()
    meta = json.loads(whole)
    lost = meta["train_filenames"].pop()
    meta["frames"] = [frame for frame in meta["frames"] if frame["file_path"] != lost]
    for frame in meta["frames"]:  # and the rest is seen from twice as far
        frame["transform_matrix"][2][3] += 3.0
    description.write_text(json.dumps(meta))
    yield scene
    description.write_text(whole)


def test_the_stored_config_says_what_was_chosen(begun: Any) -> None:
    path = begun.config.get_base_dir() / "config.yml"
    stored = yaml.load(path.read_text(), Loader=yaml.Loader)
    assert stored.pipeline.model.sizes == begun.pipeline.model.config.sizes
    assert not left_open(stored.pipeline.model.sizes)
    # and the method's own is as it was
    assert left_open(leco_occupancy.config.pipeline.model.sizes)


def test_it_is_evaluated_as_it_was_trained_with_images_missing(begun: Any, poorer: Path) -> None:
    path = begun.config.get_base_dir() / "config.yml"
    sizes = begun.pipeline.model.config.sizes
    whole = path.read_text()
    opened = yaml.load(whole, Loader=yaml.Loader)
    opened.pipeline.model = replace(
        opened.pipeline.model, sizes=leco_occupancy.config.pipeline.model.sizes
    )
    try:
        for text in (whole, yaml.dump(opened)):  # by its config, and by its checkpoint alone
            path.write_text(text)
            _, pipeline, _, step = eval_setup(path, test_mode="test")
            model: Any = pipeline.model
            assert step == STEPS - 1
            assert (model.config.sizes.gate, model.config.sizes.field) == (sizes.gate, sizes.field)
            for name, value in begun.pipeline.model.named_parameters():
                assert torch.equal(value, dict(model.named_parameters())[name])
    finally:
        path.write_text(whole)


def resumed(begun: Any, scene: Path, name: str) -> Any:
    """The same command with `--load-dir`."""
    return config_of(
        scene, begun.config.output_dir, name, load_dir=begun.config.get_checkpoint_dir()
    )


def test_a_resumed_run_has_the_sizes_it_was_begun_with(
    begun: Any, scene: Path, monkeypatch: pytest.MonkeyPatch, printed: Any
) -> None:
    def lost(*_: Any) -> Any:
        raise AssertionError("sizes are chosen anew")

    monkeypatch.setattr("leco_plugin.models.sizing.scene_sizes.detail_of", lost)
    trainer = run(resumed(begun, scene, "resumed"))
    assert trainer.pipeline.model.config.sizes == begun.pipeline.model.config.sizes
    assert trainer.step == 2 * STEPS - 1
    assert "texels" not in printed()
    stored = yaml.load(
        (trainer.config.get_base_dir() / "config.yml").read_text(), Loader=yaml.Loader
    )
    assert stored.pipeline.model.sizes == begun.pipeline.model.config.sizes
    # what is trained is what is rendered
    trained = {id(p) for o in trainer.optimizers.optimizers.values() for p in groups_of(o)}
    assert {id(p) for p in trainer.pipeline.model.mixture.field.parameters()} <= trained


def groups_of(optimizer: torch.optim.Optimizer) -> list[torch.Tensor]:
    return [parameter for group in optimizer.param_groups for parameter in group["params"]]


def test_other_sizes_or_photographs_are_refused(begun: Any, scene: Path, poorer: Path) -> None:
    config = resumed(begun, scene, "other")
    with pytest.raises(InputError, match=r"with 7 training photographs, and the scene has 6"):
        config.setup(local_rank=0, world_size=1).setup()
    model = config.pipeline.model
    table = "field.encoding.log2_table"
    config.pipeline.model = replace(model, sizes=with_size(model.sizes, table, 5))
    with pytest.raises(InputError, match=r"log2-table is 5, and the run .* leave it out"):
        config.setup(local_rank=0, world_size=1).setup()


@pytest.mark.parametrize(
    ("part", "option", "value", "said"),
    [
        ("datamanager", "held_out_period", 9, "held-out-period is 9, and the run .* has 5: give"),
        ("datamanager", "camera_res_scale_factor", 0.5, "photographs of up to 32 x 32"),
        ("datamanager", "upright", False, None),
        ("dataparser", "scale_factor", 2.0, "lie elsewhere .* give the dataparser the options"),
        ("dataparser", "center_method", "focus", "lie elsewhere"),
    ],
)
def test_other_places_or_held_out_pixels_are_refused(
    begun: Any, scene: Path, part: str, option: str, value: Any, said: str | None
) -> None:
    config = resumed(begun, scene, "moved")
    manager = config.pipeline.datamanager
    setattr(manager if part == "datamanager" else manager.dataparser, option, value)
    trainer = config.setup(local_rank=0, world_size=1)
    with pytest.raises(InputError, match=said) if said else nullcontext():
        trainer.setup()


def test_photographs_that_have_taught_a_gate_do_not_vouch_for_it(begun: Any, scene: Path) -> None:
    config = resumed(begun, scene, "vouching")  # of a run that never sets any aside
    model = config.pipeline.model
    for cameras in (0, 1):
        model.schedule, model.calibration = ScheduleConfig(), CalibrationConfig(cameras=cameras)
        trainer = config.setup(local_rank=0, world_size=1)
        refused = pytest.raises(InputError, match=r"calibration.cameras is 1, and .* 0 photographs")
        with refused if cameras else nullcontext():
            trainer.setup()


def test_no_image_is_decoded_to_choose_sizes(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def decoded(*_: Any) -> Any:
        raise AssertionError("an image was decoded")

    config = config_of(scene, tmp_path, "none").pipeline
    config.datamanager.dataparser.data = scene
    outputs = config.datamanager.dataparser.setup().get_dataparser_outputs("train")
    dataset = config.datamanager._target.dataset_type
    monkeypatch.setattr("PIL.Image.Image.load", decoded)
    monkeypatch.setattr(dataset, "get_numpy_image", decoded, raising=False)
    model: Any = config.model.setup(
        scene_box=outputs.scene_box,
        num_train_data=len(outputs.image_filenames),
        metadata={CAMERAS: outputs.cameras},
        device="cpu",
    )
    assert not left_open(model.config.sizes)


def test_the_checkpoint_to_go_on_from(tmp_path: Path) -> None:
    config = config_of(tmp_path, tmp_path, "x")
    assert checkpoint_of(config) is None
    models = tmp_path / "models"
    models.mkdir()
    path = models / "step-000000007.ckpt"
    torch.save({}, path)
    for given in ({"load_checkpoint": path}, {"load_dir": models, "load_step": 7}):
        assert checkpoint_of(replace(config, **given)) == path
    with pytest.raises(InputError, match=f"there is no checkpoint in {tmp_path}: give {models}$"):
        checkpoint_of(replace(config, load_dir=tmp_path))
    with pytest.raises(InputError, match=r"8\.ckpt cannot .*no such file.*without --load-step"):
        checkpoint_of(replace(config, load_dir=models, load_step=8))
    path.write_bytes(path.read_bytes()[:-30])
    with pytest.raises(InputError, match=r"7\.ckpt cannot be gone on with \(File is not a zip"):
        checkpoint_of(replace(config, load_checkpoint=path))
