"""Cameras stand in free space and see the city, and depth leads back to the same points."""

import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras

from leco_plugin.scenes.city.cameras import (
    CaptureConfig,
    Lens,
    aerial_cameras,
    look_at,
    street_cameras,
    views_of,
)
from leco_plugin.scenes.city.city import City, CityConfig

LENS = Lens(40, 30, 33.0)


@pytest.fixture(scope="module")
def city() -> City:
    return City(CityConfig(blocks=3, seed=2))


def test_poses_are_rotations_that_look_at_their_target() -> None:
    for target in ([5.0, 1.0, 0.0], [1.0, 2.0, -7.0]):
        pose = look_at(np.array([1.0, 2.0, 3.0]), np.array(target))
        rotation = pose[:, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1)
        ahead = np.array(target) - pose[:, 3]
        np.testing.assert_allclose(-rotation[:, 2], ahead / np.linalg.norm(ahead))


def test_aerial_cameras_fly_above_all_roofs_some_straight_down_some_oblique(city: City) -> None:
    poses = aerial_cameras(city, 60, 0)
    assert poses.shape == (60, 3, 4)
    assert (poses[:, 2, 3] > city.roof).all()
    tilt = np.rad2deg(np.arccos(poses[:, 2, 2]))
    assert 15 <= (tilt < 15).sum() <= 25
    assert ((tilt > 35) & (tilt < 55)).sum() >= 35


def test_street_cameras_stand_at_eye_height_clear_of_everything(city: City) -> None:
    poses = street_cameras(city, 20, 0)
    assert poses.shape == (20, 3, 4)
    places = poses[:, :, 3]
    assert not city.occupied(places).any()
    assert city.distance(places).min() > 0.7
    assert ((places[:, 2] > 1.5) & (places[:, 2] < 3)).all()
    assert (np.abs(poses[:, 2, 2]) < 0.35).all()


def test_the_seed_decides_the_cameras(city: City) -> None:
    for cameras in (aerial_cameras, street_cameras):
        assert np.array_equal(cameras(city, 5, 3), cameras(city, 5, 3))
        assert not np.array_equal(cameras(city, 5, 3), cameras(city, 5, 4))
        assert cameras(city, 0, 0).shape == (0, 3, 4)


def test_rays_are_those_of_nerfstudio() -> None:
    pose = look_at(np.array([3.0, -2.0, 8.0]), np.array([0.5, 1.0, 0.0]))
    camera = Cameras(torch.tensor(pose[None]).float(), 33.0, 33.0, 20.0, 15.0, 40, 30)
    rays = camera.generate_rays(camera_indices=0)
    ours = LENS.directions() @ pose[:, :3].T
    np.testing.assert_allclose(ours, rays.directions.numpy(), atol=1e-5)


def test_axial_depth_leads_back_to_depth_along_the_ray() -> None:
    depth = np.random.default_rng(0).uniform(1, 100, (30, 40))
    depth[3, 4] = np.inf
    axial = LENS.axial(depth)
    assert axial[3, 4] == 0
    np.testing.assert_allclose(LENS.along_ray(axial), depth, rtol=1e-6)


def test_a_wall_square_to_the_view_has_one_axial_depth() -> None:
    depth = 7.0 / -LENS.directions()[..., 2]
    np.testing.assert_allclose(LENS.axial(depth), 7000.0, rtol=1e-6)


@pytest.fixture(scope="module")
def small() -> City:
    return City(CityConfig(blocks=2, seed=1))


def test_views_are_always_the_same(small: City) -> None:
    capture = CaptureConfig(aerial_per_block=3, street_per_block=1, test_every=4)
    views, again = views_of(small, capture), views_of(City(small.config), capture)
    assert [view.name for view in views] == [view.name for view in again]
    for one, other in zip(views, again):
        np.testing.assert_array_equal(one.pose, other.pose)
    assert [view.number for view in views] == list(range(16))
    assert [view.number for view in views if view.held_out] == [2, 6, 10, 14]
    assert views[12].name == "street_00000"


def test_of_two_views_the_last_is_held_out(small: City) -> None:
    capture = CaptureConfig(aerial_per_block=0.5, street_per_block=0, test_every=9)
    assert [view.held_out for view in views_of(small, capture)] == [False, True]


def test_one_view_is_too_few(small: City) -> None:
    with pytest.raises(ValueError, match="1 picture is too few"):
        views_of(small, CaptureConfig(aerial_per_block=0.3, street_per_block=0))


def test_pictures_have_the_opening_angle_across() -> None:
    lens = CaptureConfig(width=40, height=30, field_of_view=90.0).lens
    assert (lens.width, lens.height) == (40, 30) and lens.focal == pytest.approx(20.0)


@pytest.mark.parametrize(
    "ends",
    [
        {"width": 8, "height": 8192, "field_of_view": 10.0, "test_every": 2},
        {"width": 8192, "height": 8, "field_of_view": 120.0},
        {"aerial_per_block": 1000.0, "street_per_block": 0.0},
        {"aerial_per_block": 0.0, "street_per_block": 1000.0},
    ],
)
def test_pictures_at_the_limits_can_be_taken(ends: dict) -> None:
    assert CaptureConfig(**ends)


@pytest.mark.parametrize(
    "bad",
    [
        *({"width": 7}, {"height": 7}, {"width": 8193}, {"height": 8193}),
        *({"field_of_view": 9.9}, {"field_of_view": 120.1}),
        *({"aerial_per_block": 1000.1}, {"street_per_block": 1000.1}, {"street_per_block": -0.1}),
        {"width": 0},
        {"field_of_view": 180.0},
        {"aerial_per_block": -1.0},
        {"aerial_per_block": 0.0, "street_per_block": 0.0},
        {"test_every": 1},
    ],
)
def test_pictures_that_cannot_be_taken_are_refused_in_one_line(bad: dict) -> None:
    with pytest.raises(ValueError, match=r"^[^\n]+$"):
        CaptureConfig(**bad)
