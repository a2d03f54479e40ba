"""Claims about the state that a run keeps from the moment of freezing."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from nerfstudio.data.scene_box import SceneBox

from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.field import FieldConfig
from leco_plugin.learning import field_at_freezing as kept
from leco_plugin.learning.field_at_freezing import carry_over, field_at_freezing, leave_field
from leco_plugin.models.gate import GateConfig
from leco_plugin.models.leco import LecoModel
from leco_plugin.models.leco_config import LecoModelConfig
from leco_plugin.models.sizing.sizes import Sizes

SIZES = Sizes(
    gate=GateConfig(EncodingConfig(octaves=1), width=8, layers=1, scene_experts=4),
    field=FieldConfig(EncodingConfig(kind="hash", log2_table=8)),
)


@pytest.fixture
def model() -> LecoModel:
    torch.manual_seed(0)
    box = SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3]))
    made = LecoModelConfig(sizes=SIZES).setup(scene_box=box, num_train_data=3)
    made.frozen.fill_(True)
    made.report = {"step": 7}
    return made


def densities(model: LecoModel) -> torch.Tensor:
    torch.manual_seed(1)
    mapped, routes = 2.0 * torch.rand(50, 3) - 1.0, torch.randint(2, (50,))
    with torch.no_grad():
        return model.field.density(mapped, routes, torch.ones(50))[0]


def go_on(model: LecoModel) -> None:
    """What guided training does to a model: another field, one expert fewer, the same gate."""
    with torch.no_grad():
        for parameter in model.field.parameters():
            parameter.add_(0.1)
    model.field.experts.drop(3)
    model.threshold.fill_(0.25)


def test_it_is_the_field_that_the_gate_was_calibrated_on(model: LecoModel, tmp_path: Path) -> None:
    before = densities(model)
    leave_field(model, tmp_path)
    go_on(model)
    now = densities(model)
    frozen = field_at_freezing(model, tmp_path)
    assert frozen is not None and not frozen.training
    assert torch.equal(densities(frozen), before) and not torch.equal(now, before)
    assert torch.equal(densities(model), now) and model.field.experts.those_left() is not None
    assert frozen.field.experts.those_left() is None and frozen.report == {"step": 7}


def test_a_run_without_one_has_none(model: LecoModel, tmp_path: Path) -> None:
    assert field_at_freezing(model, tmp_path) is None


def test_a_damaged_one_and_one_of_another_gate_are_refused_in_a_line(
    model: LecoModel, tmp_path: Path
) -> None:
    leave_field(model, tmp_path)
    path = tmp_path / kept.FILE_NAME
    whole = path.read_bytes()
    for damaged in (b"", whole[: len(whole) // 2], b"no archive"):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match="cannot be used") as error:
            field_at_freezing(model, tmp_path)
        assert "\n" not in str(error.value)
    path.write_bytes(whole)
    with torch.no_grad():
        model.gate.head.bias.add_(1.0)
    with pytest.raises(ValueError, match="another gate"):
        field_at_freezing(model, tmp_path)


@pytest.mark.parametrize("what", ["checkpoint", "folder"])
def test_a_run_that_resumes_in_a_folder_of_its_own_takes_it_along(
    what: str, model: LecoModel, tmp_path: Path
) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    leave_field(model, first)
    checkpoint = first / "nerfstudio_models" / "step-000000009.ckpt"
    checkpoint.parent.mkdir()
    checkpoint.write_bytes(b"")
    carry_over(checkpoint if what == "checkpoint" else checkpoint.parent, second)
    assert (second / kept.FILE_NAME).read_bytes() == (first / kept.FILE_NAME).read_bytes()
    (second / kept.FILE_NAME).write_bytes(b"its own")
    carry_over(checkpoint, second)
    assert (second / kept.FILE_NAME).read_bytes() == b"its own"
    carry_over(tmp_path / "none" / "step-000000009.ckpt", tmp_path / "third")
    assert not (tmp_path / "third").exists()


def test_a_full_disk_costs_the_file_and_not_the_run(
    model: LecoModel,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(kept, "write_whole", full)
    leave_field(model, tmp_path)
    assert "could not be written" in " ".join(capsys.readouterr().out.split())
