"""Claims about Mega-NeRF's fixed shares of the ground, in the field of Switch-NeRF."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.scene_box import SceneBox

from leco_plugin.host_configs import leco_mega_nerf
from leco_plugin.models.switch.field import (
    NearestOnTheGround,
    SwitchField,
    SwitchFieldConfig,
    SwitchNerfModelConfig,
    SwitchSizes,
)
from leco_plugin.models.switch_nerf import SwitchNerfModel
from leco_plugin.scenes.bounds import SceneBounds

TINY = SwitchSizes(
    field=SwitchFieldConfig(octaves=4, width=16, layers=2, skip=None, color_width=16),
    coarse=12,
    fine=12,
)
BOX = SceneBounds("box", torch.zeros(3), 1.0, 0.1, 4.0, torch.tensor([-1.0] * 3 + [1.0] * 3), "")
NO_WALLS = torch.tensor([-1e6] * 3 + [1e6] * 3)
UNBOUNDED = SceneBounds("contraction", torch.zeros(3), 1.0, 0.1, 20.0, NO_WALLS, "")


def new_model(bounds: SceneBounds, experts: int = 4) -> SwitchNerfModel:
    torch.manual_seed(0)
    field = replace(TINY.field, routing="nearest", experts=experts)
    config = SwitchNerfModelConfig(sizes=replace(TINY, field=field), balance=0.0)
    box = SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3]))
    model: SwitchNerfModel = config.setup(scene_box=box, num_train_data=3)
    model.set_bounds(bounds, 2.0)
    return model


@pytest.mark.parametrize(
    ("experts", "high", "columns", "rows"),
    [(4, (1.0, 1.0), 2, 2), (8, (1.0, 1.0), 2, 4), (8, (1.0, -0.5), 4, 2), (3, (1.0, 0.0), 3, 1)],
)
def test_centroids_are_the_middles_of_equal_parts(
    experts: int, high: tuple[float, float], columns: int, rows: int
) -> None:
    gate = NearestOnTheGround(experts)
    gate.spread(torch.tensor([-1.0, -1.0]), torch.tensor(high))
    x, y = gate.centroids.unbind(dim=-1)
    if (columns, rows) in ((2, 4), (4, 2)) and high == (1.0, 1.0):
        columns, rows = len(x.unique()), len(y.unique())  # a square may be cut either way
        assert {columns, rows} == {2, 4}
    assert len(x.unique()) == columns and len(y.unique()) == rows
    widths = (high[0] + 1.0) / columns, (high[1] + 1.0) / rows
    torch.testing.assert_close(x.min(), torch.tensor(-1.0 + widths[0] / 2))
    torch.testing.assert_close(y.max(), torch.tensor(high[1] - widths[1] / 2))


def test_a_point_belongs_to_the_nearest_centroid_whatever_its_height() -> None:
    gate = NearestOnTheGround(4)
    points = torch.rand(200, 3) * 2.0 - 1.0
    slow = [
        min(range(4), key=lambda c: float((point[:2] - gate.centroids[c]).norm()))
        for point in points
    ]
    assert gate(points).argmax(dim=-1).tolist() == slow
    higher = points * torch.tensor([1.0, 1.0, 0.1])
    assert torch.equal(gate(points), gate(higher))


def test_only_the_expert_that_has_a_point_learns_of_it() -> None:
    torch.manual_seed(0)
    config = SwitchFieldConfig(
        octaves=2, experts=4, width=8, layers=2, skip=None, appearance_dim=0, routing="nearest"
    )
    field = SwitchField(config, 1)
    answers = field(torch.tensor([[-0.5, 0.5, 0.3], [-0.4, 0.6, -0.9]]))
    assert len(set(answers.routes.tolist())) == 1
    answers.sigmas.sum().backward()
    moved = [
        any(p.grad is not None and bool(p.grad.any()) for p in expert.parameters())
        for expert in field.experts
    ]
    assert moved == [number == int(answers.routes[0]) for number in range(4)]


@pytest.mark.parametrize("bounds", [BOX, UNBOUNDED])
def test_the_model_trains_and_its_shares_follow_the_scene(bounds: Any) -> None:
    if bounds is BOX:
        narrow = torch.tensor([-1.0, -0.25, -1.0, 1.0, 0.25, 1.0])
        bounds = replace(BOX, aabb=narrow)
    model = new_model(bounds)
    centroids = model.field.gate.centroids
    if bounds is not UNBOUNDED:
        assert centroids[:, 1].abs().max() < 0.25 and len(centroids[:, 0].unique()) == 4
    assert torch.equal(model.state_dict()["field.gate.centroids"], centroids)
    rays = RayBundle(
        origins=torch.tensor([[-2.0, 0.0, 0.0]]).repeat(10, 1),
        directions=torch.nn.functional.normalize(torch.eye(3)[0] + 0.1 * torch.randn(10, 3), dim=1),
        pixel_area=torch.ones(10, 1),
        camera_indices=torch.zeros(10, 1, dtype=torch.long),
    )
    outputs = model(rays)
    losses = model.get_loss_dict(outputs, {"image": torch.rand(len(rays), 3)})
    assert losses.keys() == {"rgb_loss"}
    losses["rgb_loss"].backward()
    assert all(p.grad is None or bool(p.grad.isfinite().all()) for p in model.parameters())


def test_the_method_has_fixed_shares_and_no_loss_of_balance() -> None:
    model: Any = leco_mega_nerf.config.pipeline.model
    assert leco_mega_nerf.config.method_name == "leco-mega-nerf"
    assert model.host.sizes.field.routing == "nearest" and model.host.balance == 0.0
    assert model.occupancy.sampler == "learned-occupancy"
