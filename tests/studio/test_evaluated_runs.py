"""A run whose newest checkpoint is damaged is evaluated from the one before, and says so."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from nerfstudio.utils import eval_utils
from tiny_run import tiny_trainer

from leco_plugin.method_configs import leco_occupancy
from leco_plugin.scenes.input_error import InputError
from leco_plugin.studio.checkpoints import from_whole, prepare_checkpoints, previous_of


@pytest.fixture(autouse=True)
def undone(monkeypatch: pytest.MonkeyPatch) -> None:
    """What models do to nerfstudio ends with each test."""
    plain = getattr(eval_utils.eval_load_checkpoint, "__wrapped__", eval_utils.eval_load_checkpoint)
    monkeypatch.setattr(eval_utils, "eval_load_checkpoint", plain)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Checkpoints of steps 10 and 20, where a run leaves them."""
    checkpoints = tmp_path / "run" / "nerfstudio_models"
    for place, step in ((previous_of(checkpoints), 10), (checkpoints, 20)):
        place.mkdir(parents=True)
        torch.save({"step": step, "pipeline": {}}, place / f"step-{step:09d}.ckpt")
    return checkpoints


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-200])


def loaded(folder: Path, step: int | None = None) -> tuple[Path, int]:
    """What nerfstudio would then load."""
    config = SimpleNamespace(load_dir=folder, load_step=step)
    return from_whole(lambda config, _: (config.load_dir, config.load_step))(config, None)


def test_a_whole_run_loads_its_newest(folder: Path, printed: Any) -> None:
    assert loaded(folder) == (folder, 20)
    assert printed() == ""


def test_without_a_whole_checkpoint_one_line_names_the_files_and_what_to_do(folder: Path) -> None:
    for path in folder.parent.rglob("*.ckpt"):
        cut(path)
    with pytest.raises(InputError) as caught:
        loaded(folder)
    said = str(caught.value)
    assert "\n" not in said and "step-000000010.ckpt" in said and "step-000000020.ckpt" in said
    assert "put a copy of one of them back, or train again" in said


def test_a_step_that_the_config_names_is_loaded_if_it_is_there(folder: Path) -> None:
    torch.save({"step": 15, "pipeline": {}}, folder / "step-000000015.ckpt")
    assert loaded(folder, 15) == (folder, 15)
    # a run that was resumed with --load-step 7 has that step in its config, and not in its folder
    assert loaded(folder, 7) == (folder, 20)


def test_it_is_done_once_and_to_nerfstudio_as_a_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = eval_utils.eval_load_checkpoint
    prepare_checkpoints()
    done: Any = eval_utils.eval_load_checkpoint
    prepare_checkpoints()
    assert eval_utils.eval_load_checkpoint is done and done.__wrapped__ is plain


@pytest.fixture(scope="module")
def run(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of `leco-occupancy` that has saved twice: first with 3 in a place, then with 7."""
    gate = replace(leco_occupancy.config.pipeline.model.sizes.gate, width=8, layers=1)
    outputs = tmp_path_factory.mktemp("outputs")
    trainer = tiny_trainer(tiny_scene, outputs, gate, candidates=32)
    bias = trainer.pipeline.model.mixture.field.density_head.bias
    for step, value in ((3, 3.0), (7, 7.0)):
        with torch.no_grad():
            bias.fill_(value)
        trainer.save_checkpoint(step)
    return Path(trainer.base_dir)


@pytest.mark.parametrize("damage", ["cut", "flip"])
def test_nerfstudios_commands_fall_back_on_the_checkpoint_before(
    damage: str, run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = run / "nerfstudio_models" / "step-000000007.ckpt"
    content = path.read_bytes()
    if damage == "cut":
        cut(path)
    else:  # torch reads it without complaint
        flipped = bytearray(content)
        flipped[content.index(torch.full((1,), 7.0).numpy().tobytes())] ^= 1
        path.write_bytes(flipped)
        torch.load(path)
    _, pipeline, used, step = eval_utils.eval_setup(run / "config.yml")
    path.write_bytes(content)
    said = "".join(capsys.readouterr().out.split())
    assert "step-000000007.ckptisdamaged" in said and "thenewestthatiswhole" in said
    assert step == 3 and used.parent.name == "nerfstudio_models.previous"
    model: Any = pipeline.model
    assert model.mixture.field.density_head.bias.tolist() == [3.0]
    assert eval_utils.eval_setup(run / "config.yml")[3] == 7
