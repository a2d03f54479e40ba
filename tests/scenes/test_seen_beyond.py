"""A survey whose pictures show something beyond its bounds gets higher ones."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from leco_plugin.scenes.bounds import BoundsConfig
from leco_plugin.scenes.photographs import POINTS
from leco_plugin.scenes.survey import bright, seen_beyond, survey

PIXELS = 32
DOWN = (-0.55, -1.5)
"""z of where cameras look in turn: the upper row of each second picture goes over the horizon."""


class Pictures:
    """A dataset of pictures that show one colour in their upper rows and another below."""

    def __init__(self, cameras: Cameras, points: Tensor, above: list[float], rows: int) -> None:
        self.cameras, self.metadata = cameras, {POINTS: points}
        self.image = torch.zeros(PIXELS, PIXELS, len(above))
        self.image[rows:, :, :] = 0.5
        self.image[:rows] = torch.tensor(above)
        self.asked: list[int] = []

    def get_data(self, number: int) -> dict[str, Any]:
        self.asked.append(number)
        return {"image": self.image}


def tilted(above: list[float], count: int = 20) -> SimpleNamespace:
    """Cameras 3 above a flat ground with pictures of 64 degrees."""
    right, poses = torch.tensor([0.0, -1.0, 0.0]), torch.zeros(count, 3, 4)
    for number in range(count):
        ahead = torch.nn.functional.normalize(torch.tensor([1.0, 0.0, DOWN[number % 2]]), dim=0)
        poses[number, :, :3] = torch.stack([right, torch.linalg.cross(right, ahead), -ahead], dim=1)
    poses[:, 2, 3] = 3.0
    poses[:, 1, 3] = torch.linspace(-2.0, 2.0, count)
    cameras = Cameras(poses, 25.6, 25.6, 16.0, 16.0, PIXELS, PIXELS)
    points = torch.rand(400, 3, generator=torch.Generator().manual_seed(0))
    points = points * torch.tensor([14.0, 8.0, 0.5]) + torch.tensor([0.5, -4.0, 0.0])
    return SimpleNamespace(train_dataset=Pictures(cameras, points, above, rows=8))


@pytest.mark.parametrize("above", [[0.6, 0.8, 1.0], [0.6, 0.6, 0.6, 0.5]])
def test_a_sky_raises_the_bounds_over_the_cameras(above: list[float]) -> None:
    data = tilted(above)
    bounds = survey(data).bounds
    low, high = bounds.aabb.view(2, 3)
    assert bounds.kind == "box" and "raised" in bounds.reason and "\n" not in bounds.reason
    assert float(high[2]) > 3.0 and float(low[2]) < 0.0
    assert bounds.near <= 0.05 * bounds.far
    cube = torch.stack([bounds.center - bounds.half_extent, bounds.center + bounds.half_extent])
    assert bool((low >= cube[0] - 1e-4).all()) and bool((high <= cube[1] + 1e-4).all())
    assert len(data.train_dataset.asked) <= 16  # not every picture of a large scene


@pytest.mark.parametrize("above", [[0.02, 0.05, 0.09], [0.9, 0.9, 0.9, 0.0]])
def test_darkness_and_nothing_raise_none(above: list[float]) -> None:
    bounds = survey(tilted(above)).bounds
    assert "raised" not in bounds.reason and float(bounds.aabb[5]) < 3.0


def test_altitudes_by_hand_stay() -> None:
    data = tilted([0.6, 0.8, 1.0])
    bounds = survey(data, BoundsConfig(altitudes=(-1.0, 1.0))).bounds
    assert float(bounds.aabb[5]) == 1.0 and data.train_dataset.asked == []


def test_what_a_mask_hides_shows_nothing() -> None:
    chosen = torch.zeros(8, 8, dtype=torch.bool)
    chosen[0], chosen[7, 7] = True, True
    image, mask = torch.full((12, 20, 3), 0.5), torch.ones(12, 20, 1)
    assert int(bright({"image": image}, chosen).sum()) == 9
    mask[0] = 0.0
    assert int(bright({"image": image, "mask": mask}, chosen).sum()) == 1


def test_rays_that_all_meet_the_scene_open_no_picture() -> None:
    data = tilted([1.0, 1.0, 1.0]).train_dataset
    assert seen_beyond(data, torch.arange(20), torch.zeros(20, 8, 8, dtype=torch.bool)) == 0.0
    assert data.asked == []
