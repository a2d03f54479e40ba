"""The look at the cameras before the first step."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from tiny_scene import camera_to_world

from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.photographs import POINTS
from leco_plugin.scenes.survey import SIDE, covering_rays, survey


def ring(count: int = 8) -> Cameras:
    """Cameras around the origin that look at it."""
    poses = torch.stack([torch.tensor(camera_to_world(i)).float()[:3] for i in range(count)])
    return Cameras(poses, 32.0, 32.0, 16.0, 16.0, 32, 32)


def datamanager(cameras: Cameras, points: torch.Tensor | None = None) -> SimpleNamespace:
    metadata = {} if points is None else {POINTS: points}
    return SimpleNamespace(train_dataset=SimpleNamespace(cameras=cameras, metadata=metadata))


def test_rays_cover_each_image_and_are_of_unit_length() -> None:
    origins, directions = covering_rays(ring())
    assert origins.shape == directions.shape == (8, SIDE * SIDE, 3)
    torch.testing.assert_close(directions.norm(dim=-1), torch.ones(8, SIDE * SIDE))


def test_a_ring_of_cameras_sees_its_scene() -> None:
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(0)) * 0.6 - 0.3
    found = survey(datamanager(ring(), points))
    assert found.meeting > 0.5 and found.median_length > 0.0
    assert "\n" not in found.describe()
    span = torch.tensor([found.bounds.near, found.bounds.far])
    rays = found.probe_rays(torch.device("cpu"), found.bounds.aabb, span)
    assert len(rays.origins) > 0 and bool((rays.t_maxs > rays.t_mins).all())


def test_no_cameras_are_refused() -> None:
    with pytest.raises(InputError, match="no training cameras"):
        survey(datamanager(ring()[torch.zeros(8, dtype=torch.bool)]))


def test_rays_that_never_meet_the_scene_are_refused_in_one_line() -> None:
    """The sparse points lie behind every camera."""
    behind = torch.rand(200, 3, generator=torch.Generator().manual_seed(0)) + torch.tensor(
        [0, 0, 99]
    )
    with pytest.raises(InputError, match=r"no (camera sees|ray of any camera)") as caught:
        survey(datamanager(ring(), behind))
    assert "\n" not in str(caught.value)
