"""The size of a scene in footprints of a pixel: against surveys whose size is known."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from scene_files import refused
from torch import Tensor

from leco_plugin.scenes.bounds import BoundsConfig, find_bounds
from leco_plugin.scenes.survey import _pixel_density, covering_rays, detail_of

HEIGHT, SIDE, FOCAL = 2.0, 32, 32.0
"""Of the survey: a pixel's footprint is 1/16, an image's 2 x 2."""


def survey(side: float, spacing: float = 1.0, size: int = SIDE, scale: float = 1.0) -> Cameras:
    """Cameras on a grid above a square of that side, looking straight down."""
    count = round(side / spacing)
    places = (torch.arange(count) + 0.5) * spacing - side / 2
    x, y = torch.meshgrid(places, places, indexing="ij")
    poses = torch.eye(4)[:3].repeat(count**2, 1, 1)
    poses[:, :, 3] = scale * torch.stack(
        [x.flatten(), y.flatten(), torch.full((count**2,), HEIGHT)], dim=-1
    )
    focal = FOCAL * size / SIDE
    return Cameras(poses, focal, focal, size / 2, size / 2, size, size)


def ground(side: float, scale: float = 1.0) -> Tensor:
    """Sparse points [P, 3] evenly on the ground, a little uneven."""
    unit = torch.rand(3000, 3, generator=torch.Generator().manual_seed(1)) - 0.5
    return scale * unit * torch.tensor([side, side, 0.02])


@pytest.mark.parametrize("side", [4.0, 9.0])
def test_texels_are_the_ground_over_the_footprint_of_a_pixel(side: float) -> None:
    found = detail_of(survey(side), ground(side))
    assert found.pixels == found.images * SIDE**2
    assert found.texels == pytest.approx(side**2 * 16**2, rel=0.2)


def test_walls_count_as_the_ground_does() -> None:
    flat = ground(6.0)
    wall = flat[:, [0, 2, 1]] * torch.tensor([1.0, 1.0, 0.1])  # a tenth as high as it is long
    cameras, both = survey(6.0), torch.cat([flat, wall[:300]])
    more = detail_of(cameras, both).texels / detail_of(cameras, flat).texels
    assert 1.02 < more < 1.3


def test_more_photographs_of_the_same_ground_show_no_more() -> None:
    once, often = (detail_of(survey(4.0, spacing), ground(4.0)) for spacing in (1.0, 0.5))
    assert often.pixels == 4 * once.pixels
    assert often.texels == pytest.approx(once.texels, rel=0.1)


def test_finer_photographs_show_more() -> None:
    coarse, fine = (detail_of(survey(6.0, size=size), ground(6.0)) for size in (SIDE, 2 * SIDE))
    assert fine.texels == pytest.approx(4.0 * coarse.texels, rel=0.05)
    assert fine.across == pytest.approx(2.0 * coarse.across, rel=0.05)


def test_the_footprint_of_a_pixel_is_exact_however_few_an_image_has() -> None:
    cameras = survey(1.0, size=8)  # with a focal length of 8 pixels, from a height of 2
    _, directions = covering_rays(cameras)
    pose = cameras.camera_to_worlds[0]
    assert float(_pixel_density(torch.zeros(1, 3), pose, directions[0], 8)) == pytest.approx(16.0)


def test_a_wide_image_is_as_wide_as_it_is_and_no_higher() -> None:
    pose = torch.eye(4)[:3]
    pose[:, 3] = torch.tensor([1.0, 0.0, 2.0])
    camera = Cameras(pose[None], 8.0, 6.0, 4.0, 2.0, 8, 4)
    _, directions = covering_rays(camera)
    places = torch.tensor([[1.7, 0.0, 0.0], [1.0, 0.7, 0.0], [0.2, 0.3, 0.0], [1.0, 0.0, 5.0]])
    found = _pixel_density(places, pose, directions[0], 8)
    assert found.tolist() == pytest.approx([16.0, 0.0, 16.0, 0.0])


@pytest.mark.parametrize(("space", "halves"), [("box", 2), ("contraction", 4)])
def test_a_contraction_is_twice_as_many_pixels_across_as_its_inner_cube(
    space: Any, halves: int
) -> None:
    cameras, points, config = survey(6.0), ground(6.0), BoundsConfig(space)
    _, directions = covering_rays(cameras)
    half = find_bounds(cameras.camera_to_worlds, directions, points, config).half_extent
    across = detail_of(cameras, points, config).across
    assert across == pytest.approx(halves * half * 16.0, rel=0.02)


def test_of_distances_the_nearest_counts() -> None:
    near = survey(6.0)
    poses = near.camera_to_worlds.clone()
    poses[::2, 2, 3] = 10.0 * HEIGHT
    mixed = Cameras(poses, FOCAL, FOCAL, SIDE / 2, SIDE / 2, SIDE, SIDE)
    found = detail_of(mixed, ground(6.0))
    assert found.texels == pytest.approx(detail_of(near, ground(6.0)).texels, rel=0.2)


def test_a_few_close_views_add_nothing_and_far_ones_show_less_where_there_are_no_others() -> None:
    usual, poses = detail_of(survey(6.0), ground(6.0)).texels, survey(6.0).camera_to_worlds
    close, afar = poses.clone(), poses.clone()
    close[::4, 2, 3] = HEIGHT / 4.0
    close = torch.cat([poses, close[::4]])
    afar[poses[:, 0, 3] > 1.0, 2, 3] = 2.0 * HEIGHT  # a third of the ground
    for heights, share in ((close, 1.0), (afar, 0.75)):
        cameras = Cameras(heights, FOCAL, FOCAL, SIDE / 2, SIDE / 2, SIDE, SIDE)
        found = detail_of(cameras, ground(6.0)).texels
        assert found == pytest.approx(share * usual, rel=0.1)


def test_there_are_no_more_texels_than_pixels() -> None:
    solid = ground(4.0) * torch.tensor([1.0, 1.0, 100.0])  # surfaces everywhere up to half way
    found = detail_of(survey(1.0), solid)
    assert found.texels == found.pixels == found.images * SIDE**2


def test_the_unit_of_length_does_not_count() -> None:
    found = detail_of(survey(6.0), ground(6.0))
    scaled = detail_of(survey(6.0, scale=37.0), ground(6.0, 37.0))
    assert scaled.texels == pytest.approx(found.texels, rel=1e-3)
    assert scaled.across == pytest.approx(found.across, rel=1e-3)


def test_it_is_the_same_each_time_and_for_many_photographs_by_a_sample_of_them() -> None:
    cameras, points = survey(17.0), ground(17.0)
    assert len(cameras) == 289  # more than are looked at
    found = detail_of(cameras, points)
    assert found == detail_of(cameras, points)
    assert found.texels == pytest.approx(17.0**2 * 16**2, rel=0.2)


def test_without_points_the_places_that_rays_reach_stand_for_them() -> None:
    config = BoundsConfig(altitudes=(0.0, 0.5))
    # the outermost images reach half a side beyond the survey
    assert detail_of(survey(8.0), None, config).texels == pytest.approx(9.0**2 * 16**2, rel=0.2)
    assert detail_of(survey(8.0), None).texels > 0.0  # contracted around the cameras


def test_a_fisheye_is_looked_through_too() -> None:
    cameras = survey(6.0)
    cameras.camera_type.fill_(CameraType.FISHEYE.value)
    assert detail_of(cameras, ground(6.0)).texels > 0.0


def test_what_nobody_sees_has_no_size() -> None:
    with refused("no training cameras"):
        detail_of(survey(2.0)[torch.zeros(4, dtype=torch.bool)])
    behind = ground(2.0) + torch.tensor([0.0, 0.0, 10.0])
    with refused("no camera sees"):
        detail_of(survey(2.0), behind)
