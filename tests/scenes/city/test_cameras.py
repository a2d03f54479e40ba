"""Cameras stand in free space, see the city, and are as many as asked for."""

import numpy as np
import pytest

from leco_plugin.scenes.city.cameras import aerial_cameras, look_at, street_cameras
from leco_plugin.scenes.city.city import City, CityConfig


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
