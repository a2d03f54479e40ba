"""What sparse points teach a gate before the first step."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.scene_box import SceneBox

from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.field import FieldConfig
from leco_plugin.models.gate import GateConfig
from leco_plugin.models.learning import lifecycle
from leco_plugin.models.learning.batches import Batches
from leco_plugin.models.learning.lifecycle import Lifecycle
from leco_plugin.models.learning.prior import (
    CELLS,
    PriorConfig,
    before_points,
    far_positions,
    lines_of_sight,
    near_points,
    warm_start,
)
from leco_plugin.models.leco import LecoModel
from leco_plugin.models.leco_config import LecoModelConfig
from leco_plugin.models.sizing.sizes import Sizes
from leco_plugin.scenes.pixels.lattice import Lattice
from leco_plugin.scenes.pixels.sparse_pixels import sparse_pixels
from leco_plugin.scenes.survey import survey


def drone(count: int = 9) -> Cameras:
    """Cameras 10 above the ground that look straight down."""
    poses = torch.eye(4)[:3].repeat(count, 1, 1)
    poses[:, 2, 3] = 10.0
    poses[:, 0, 3] = torch.linspace(-4.0, 4.0, count)
    return Cameras(poses, 32.0, 32.0, 16.0, 16.0, 32, 32)


def hills(count: int = 600) -> torch.Tensor:
    """Points of a surface between 0 and 1 that goes up with x."""
    points = 8.0 * torch.rand(count, 3, generator=torch.Generator().manual_seed(0)) - 4.0
    points[:, 2] = (points[:, 0] + 4.0) / 8.0
    return points


def made(steps: int) -> LecoModel:
    torch.manual_seed(0)
    sizes = Sizes(
        gate=GateConfig(EncodingConfig(octaves=5), width=32, layers=2, scene_experts=2),
        field=FieldConfig(EncodingConfig(kind="hash", log2_table=8)),
        learn_candidates=32,
        candidates=32,
    )
    config = LecoModelConfig(sizes=sizes, prior=PriorConfig(steps=steps, positions=512))
    box = SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3]))
    model: Any = config.setup(scene_box=box, num_train_data=9)
    metadata = {"points3D_xyz": hills()}
    dataset = SimpleNamespace(cameras=drone(), metadata=metadata)
    seen = survey(SimpleNamespace(train_dataset=dataset))
    model.set_bounds(seen.bounds, seen.median_length)
    assert isinstance(model, LecoModel)
    return model


def test_what_is_near_a_point_is_its_cell_and_those_around_it() -> None:
    near = near_points(torch.tensor([[0.01, 0.01, 0.01], [1.0, 1.0, 1.0]]))
    middle = CELLS // 2
    assert bool(near[middle - 1 : middle + 2, middle - 1 : middle + 2, middle].all())
    assert bool(near[-2:, -2:, -2:].all())
    assert int(near.sum()) == 27 + 8


def test_guessed_positions_are_far_from_every_point_and_inside_the_box() -> None:
    points = torch.rand(400, 3, generator=torch.Generator().manual_seed(1)) * 2.0 - 1.0
    low, high = torch.tensor([-1.0, -1.0, -0.5]), torch.tensor([1.0, 1.0, 0.5])
    drawn = far_positions(4000, near_points(points), low, high)
    assert 0 < len(drawn) < 4000
    assert bool((drawn >= low).all()) and bool((drawn <= high).all())
    nearest = (drawn[:, None] - points).abs().amax(dim=-1).amin(dim=-1)
    assert float(nearest.min()) >= 2.0 / CELLS


def test_free_positions_lie_between_a_camera_and_what_it_sees() -> None:
    distances = torch.tensor([5.0, 9.0, 1.1] * 200)
    directions = torch.tensor([[0.0, 0.0, -1.0]]).expand(600, 3)
    free = before_points(torch.zeros(600, 3), directions, distances, clear=0.5, near=1.0)
    assert len(free) == 400  # a point at 1.1 leaves no room between 1.0 and 0.6
    assert float(free[:, 2].max()) <= -1.0 and float(free[:, 2].min()) >= -8.5
    assert float(free[:, 2].min()) < -7.5


def test_lines_of_sight_lead_to_the_points() -> None:
    points = hills()
    origins, directions, distances = lines_of_sight(
        drone(), sparse_pixels(drone(), points, Lattice())
    )
    ends = origins + directions * distances[:, None]
    nearest = torch.cdist(ends, points).amin(dim=-1)
    assert len(ends) > 500
    assert float(nearest.max()) < 10.0 / 32.0  # within a pixel of where it is seen


def test_a_gate_that_was_shown_points_keeps_them_and_skips_the_air_before_them() -> None:
    points = hills()
    air = points + torch.tensor([0.0, 0.0, 0.8])
    model, new = made(steps=80), made(steps=0)
    loss = warm_start(model, drone(), points, sparse_pixels(drone(), points, Lattice()))
    assert loss > 0.0

    def kept(of: LecoModel, places: torch.Tensor) -> float:
        with torch.no_grad():
            occupancy = of.gate.occupancy(of.space.map(places).clamp(-1.0, 1.0))
        return float((occupancy > 0.5).float().mean())

    assert kept(model, points) > 0.95
    assert kept(model, air) < 0.2
    assert abs(kept(new, points) - kept(new, air)) < 0.5


@pytest.mark.parametrize("frozen", [False, True])
def test_no_points_are_no_prior_and_a_frozen_gate_is_left_alone(
    frozen: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    monkeypatch.setattr(lifecycle, "say", said.append)
    model = made(steps=3)
    model.frozen.fill_(frozen)
    run = object.__new__(Lifecycle)
    run.model = model
    dataset = SimpleNamespace(cameras=drone(), metadata={})
    manager = SimpleNamespace(train_dataset=dataset, get_train_rays_per_batch=lambda: 8)
    run.pipeline = SimpleNamespace(datamanager=manager)
    run.batches = Batches(model, manager)
    before = [parameter.clone() for parameter in model.gate.parameters()]
    run.begin_with_points()
    assert all(torch.equal(a, b) for a, b in zip(before, model.gate.parameters()))
    assert said == ([] if frozen else ["no prior: the scene has no sparse points"])
    dataset.metadata["points3D_xyz"] = hills()
    run.batches = Batches(model, manager)
    run.begin_with_points()
    changed = any(not torch.equal(a, b) for a, b in zip(before, model.gate.parameters()))
    assert changed is not frozen
    assert (model.progress.learn_seconds > 0.0) is not frozen
