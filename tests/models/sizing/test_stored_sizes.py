"""A model is built again in the sizes that it was stored in."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.scene_box import SceneBox

from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.field import FieldConfig
from leco_plugin.models.gate import GateConfig
from leco_plugin.models.hmoe import HMoEConfig
from leco_plugin.models.leco import LecoModel
from leco_plugin.models.leco_config import LecoModelConfig
from leco_plugin.models.sizing.sizes import (
    LARGE,
    PAPER,
    SMALL,
    Sizes,
    automatic,
    from_stored,
    sizes_in,
    sizes_to_resume,
    to_store,
    with_size,
)
from leco_plugin.scenes.input_error import InputError

TINY = Sizes(
    gate=GateConfig(EncodingConfig(octaves=1), width=8, layers=1, scene_experts=2),
    field=FieldConfig(EncodingConfig(kind="hash", log2_table=8), HMoEConfig(scene_experts=2)),
    learn_candidates=8,
    candidates=16,
)


def model_of(sizes: Sizes, images: int = 3) -> LecoModel:
    box = SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3]))
    made = LecoModelConfig(sizes=sizes).setup(scene_box=box, num_train_data=images)
    assert isinstance(made, LecoModel)
    return made.eval()


def rendered(model: LecoModel) -> torch.Tensor:
    torch.manual_seed(1)
    directions = torch.nn.functional.normalize(torch.randn(7, 3), dim=-1)
    bundle = RayBundle(
        -0.5 * directions, directions, torch.ones(7, 1), camera_indices=torch.zeros(7, 1).long()
    )
    with torch.no_grad():
        return torch.as_tensor(model.get_outputs(bundle)["rgb"])


@pytest.mark.parametrize("sizes", [TINY, SMALL, LARGE, PAPER])
def test_sizes_come_back_as_they_were(sizes: Sizes) -> None:
    found, images = from_stored(to_store(sizes, 7), SMALL)
    assert (found.gate, found.field, images) == (sizes.gate, sizes.field, 7)
    assert (found.candidates, found.learn_candidates) == (sizes.candidates, sizes.learn_candidates)
    assert found.guided_batch == SMALL.guided_batch  # no matter of what was built


def test_sizes_of_a_later_release_are_refused() -> None:
    stored = to_store(TINY, 3)
    stored["field"]["colour_octaves"] = 4
    with pytest.raises(ValueError, match="of another release") as caught:
        from_stored(stored, SMALL)
    assert "\n" not in str(caught.value)


def test_a_model_takes_the_sizes_of_its_checkpoint_and_renders_the_same() -> None:
    torch.manual_seed(0)
    stored = model_of(TINY, images=5)
    for parameter in stored.parameters():
        parameter.data += 0.1 * torch.randn_like(parameter)
    state = stored.state_dict()
    # of the scene nothing is known, so that without the checkpoint all sizes were the device's
    again = model_of(automatic(SMALL), images=4)
    again.load_state_dict(state)
    assert again.config.sizes.gate == TINY.gate and again.config.sizes.field == TINY.field
    assert again.num_train_data == 5
    for name, value in again.state_dict().items():
        if isinstance(value, torch.Tensor):
            assert torch.equal(value, state[name])
    torch.testing.assert_close(
        rendered(with_candidates(again)), rendered(with_candidates(stored)), rtol=0.0, atol=0.0
    )


def with_candidates(model: LecoModel) -> LecoModel:
    model.mixture.region.far.fill_(2.0)
    model.mixture.steps.fill_(0.1)
    return model


def test_a_model_inside_another_takes_them_too() -> None:
    stored = torch.nn.ModuleDict({"_model": model_of(TINY)})
    again = torch.nn.ModuleDict({"_model": model_of(SMALL)})
    again.load_state_dict(stored.state_dict())
    assert again["_model"].config.sizes.gate == TINY.gate


def test_the_same_sizes_leave_modules_and_config_as_they_are() -> None:
    model = model_of(TINY)
    mixture, config = model.mixture, model.config
    gate, field = mixture.gate, mixture.field
    model.load_state_dict(model_of(TINY).state_dict())
    assert mixture.gate is gate and mixture.field is field and model.config is config


def test_a_model_refuses_a_checkpoint_with_sizes_of_a_later_release() -> None:
    state = model_of(TINY).state_dict()
    state["mixture._extra_state"]["sizes"]["field"]["colour_octaves"] = 4
    with pytest.raises(InputError, match="of another release"):
        model_of(TINY).load_state_dict(state)


def test_the_config_of_others_keeps_its_open_sizes() -> None:
    config = LecoModelConfig(sizes=automatic(SMALL))
    box = SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3]))
    model: Any = config.setup(scene_box=box, num_train_data=3)
    assert model.config.sizes == SMALL and config.sizes == automatic(SMALL)


def test_a_checkpoint_says_its_sizes(tmp_path: Path) -> None:
    pipeline = torch.nn.ModuleDict({"_model": model_of(TINY)})
    torch.save({"step": 3, "pipeline": pipeline.state_dict()}, tmp_path / "some.ckpt")
    assert sizes_in(tmp_path / "some.ckpt") == to_store(TINY, 3)
    torch.save({"step": 3, "pipeline": torch.nn.Linear(2, 2).state_dict()}, tmp_path / "none.ckpt")
    assert sizes_in(tmp_path / "none.ckpt") is None


def test_going_on_fills_what_is_open_and_refuses_another_size() -> None:
    stored = to_store(TINY, 3)
    wanted = replace(automatic(TINY), guided_batch=9.0)
    assert sizes_to_resume(wanted, stored) == replace(TINY, guided_batch=9.0)
    assert sizes_to_resume(TINY, stored) == TINY
    other = with_size(wanted, "field.encoding.log2_table", 11)
    with pytest.raises(InputError, match=r"log2-table is 11, and the run .* has 8") as caught:
        sizes_to_resume(other, stored)
    assert "\n" not in str(caught.value)
    for name in ("candidates", "learn-candidates"):  # the steps along rays are found from them
        with pytest.raises(InputError, match=rf"sizes\.{name} is 99, and the run"):
            sizes_to_resume(replace(TINY, **{name.replace("-", "_"): 99}), stored)
    with pytest.raises(InputError, match=r"gate\.layers is 3, and the run .* has 1"):
        sizes_to_resume(automatic(SMALL), stored)
