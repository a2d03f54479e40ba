"""Claims about which scene experts leave a field, on one whose experts are known."""

from __future__ import annotations

import copy
import io

import pytest
import torch
from nerfstudio.data.scene_box import SceneBox

from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.field import FieldConfig
from leco_plugin.learning.calibration import near_median_depth
from leco_plugin.learning.merging import MergingConfig, find_unneeded, line_of, merge
from leco_plugin.models.gate import GateConfig
from leco_plugin.models.hmoe import HMoEConfig
from leco_plugin.models.leco import LecoModel
from leco_plugin.models.leco_config import LecoModelConfig
from leco_plugin.models.rendering import Rays
from leco_plugin.models.sizing.sizes import Sizes

BOUND = 0.01
SIZES = Sizes(
    gate=GateConfig(EncodingConfig(octaves=1), width=8, layers=1, scene_experts=4),
    field=FieldConfig(
        EncodingConfig(kind="hash", levels=2, log2_table=8), HMoEConfig(4, width=16, layers=1)
    ),
    candidates=24,
)


def make() -> LecoModel:
    box = SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3]))
    model = LecoModelConfig(sizes=SIZES, precision="float32").setup(scene_box=box, num_train_data=3)
    assert isinstance(model, LecoModel)
    return model


@pytest.fixture
def model() -> LecoModel:
    """Frozen; its experts 2 and 3 add nothing, the first and the last one a lot."""
    torch.manual_seed(0)
    model = make()
    torch.nn.init.normal_(model.gate.head.weight, std=2.0)
    torch.nn.init.normal_(model.field.encoding.table, std=1.0)
    for number in (1, 4):
        for parameter in model.field.experts.experts[number].parameters():
            torch.nn.init.normal_(parameter, std=1.0)
    model.frozen.fill_(True)
    model.gate.requires_grad_(False)
    return model.train()


def some_rays(count: int = 200) -> Rays:
    torch.manual_seed(1)
    directions = torch.nn.functional.normalize(torch.randn(count, 3), dim=-1)
    ends = torch.full((count,), 1.5)
    return Rays(-0.5 * directions, directions, torch.full((count,), 0.05), ends, None)


def image(model: LecoModel) -> torch.Tensor:
    training = model.training
    model.eval()
    with torch.no_grad():
        rays = some_rays()
        rgb = model.shade(rays, model.intervals_of(rays, guided=False, learning=False)).rgb
    model.train(training)
    return rgb


def occupancies(model: LecoModel) -> torch.Tensor:
    torch.manual_seed(2)
    return model.occupancy().query(torch.rand(500, 3) - 0.5)


def test_an_expert_whose_points_fare_as_well_elsewhere_goes_and_no_other(model: LecoModel) -> None:
    """2 and 3 do the same, so that one of them is enough."""
    # nothing but the two that are alike has any points
    with torch.no_grad():
        model.gate.head.bias[1], model.gate.head.bias[4] = -50.0, -50.0
    truth = image(model)
    found = find_unneeded(model, some_rays(), truth, BOUND)
    assert {trial.expert for trial in found.dropped} > {1, 4} and len(found.dropped) == 3
    assert found.refused is None
    assert all(trial.price_db == pytest.approx(0.0, abs=1e-9) for trial in found.dropped)


def test_the_least_is_tried_first_and_the_first_failure_ends_it(model: LecoModel) -> None:
    truth = image(model)  # which only the field as it is explains
    rays = some_rays()
    model.eval()
    intervals = model.intervals_of(rays, guided=False, learning=False)
    with torch.no_grad():
        shaded = model.shade(rays, intervals)
    mass = torch.bincount(
        shaded.routes, shaded.weights * near_median_depth(shaded, intervals), minlength=5
    )
    found = find_unneeded(model, rays, truth, BOUND)
    assert found.refused is not None and found.refused.price_db > BOUND
    first = (found.dropped or [found.refused])[0]
    assert first.expert == int(mass[1:].argmin()) + 1
    assert first.share == pytest.approx(float(mass[first.expert] / mass.sum()), rel=1e-5)


def test_looking_changes_nothing(model: LecoModel) -> None:
    before, pixels = copy.deepcopy(model.state_dict()), image(model)
    find_unneeded(model, some_rays(), pixels, 1e3)
    assert model.training and torch.equal(image(model), pixels)
    after = model.state_dict()
    assert list(after) == list(before)
    assert model.field.experts.those_left() is None


def test_the_price_is_that_of_all_that_have_gone(model: LecoModel) -> None:
    torch.manual_seed(3)
    truth = torch.rand(200, 3)
    full = image(model)
    found = find_unneeded(model, some_rays(), truth, 1e3)
    assert [trial.expert for trial in found.dropped] and len(found.dropped) == 3
    for trial in found.dropped:
        model.field.experts.drop(trial.expert)
        errors = [float((rgb - truth).square().mean()) for rgb in (image(model), full)]
        price = 10.0 * torch.log10(torch.tensor(errors[0] / errors[1]))
        assert trial.price_db == pytest.approx(float(price), abs=1e-4)


def test_what_is_empty_and_what_is_skipped_stays_so(
    model: LecoModel, capsys: pytest.CaptureFixture[str]
) -> None:
    model.config.merging = MergingConfig(1e3, rays=200)
    before = occupancies(model)
    params = sum(parameter.numel() for parameter in model.field.parameters())
    merge(model, lambda count: (some_rays(count), torch.rand(count, 3)))
    assert torch.equal(occupancies(model), before)
    assert int(model.field.experts.left.sum()) == 1
    each = 16 * 16 + 16
    assert sum(p.numel() for p in model.field.parameters()) == params - 3 * each
    assert sum(p.numel() for p in model.get_param_groups()["field"]) <= params - 3 * each
    assert "scene experts: 1 left; dropped" in " ".join(capsys.readouterr().out.split())


def test_a_checkpoint_of_a_field_without_some_experts_renders_the_same(model: LecoModel) -> None:
    model.field.experts.drop(2)
    buffer = io.BytesIO()
    torch.save(model.state_dict(), buffer)
    buffer.seek(0)
    restored = make().train()
    restored.load_state_dict(torch.load(buffer, weights_only=True))
    assert restored.field.experts.left.tolist() == [True, False, True, True]
    assert torch.equal(image(restored), image(model))


def test_where_nothing_may_go_nothing_is_tried(model: LecoModel) -> None:
    def draw(count: int) -> tuple[Rays, torch.Tensor]:
        raise AssertionError("rays were asked for")

    model.config.merging = MergingConfig(None)
    merge(model, draw)
    model.config.merging = MergingConfig(BOUND)
    model.config.homogeneous = True
    merge(model, draw)
    model.config.homogeneous = False
    for number in (1, 2, 3):
        model.field.experts.drop(number)
    merge(model, draw)
    assert model.field.experts.left.tolist() == [False, False, False, True]


def test_the_log_says_what_was_dropped_and_why_no_more(model: LecoModel) -> None:
    found = find_unneeded(model, some_rays(), image(model), BOUND)
    line = line_of(found, 4 - len(found.dropped))
    assert found.refused is not None
    assert f"without {found.refused.expert} (" in line and "would lose" in line
