"""(down, right, back) and its altitudes, and how a wrong first axis shows."""

import numpy as np
import pytest
from mega_nerf_scene import COORDINATES, poses

from leco_plugin.scenes.city.cameras import look_at
from leco_plugin.scenes.mega_nerf_format.files import TO_DRB, around, wrong_axis

FILES = COORDINATES.to_file(poses(24))

RING = np.stack(
    [
        look_at(np.array([30 * np.cos(a), 30 * np.sin(a), height]), np.array([0.0, 0.0, 0.0]))
        for a, height in zip(np.linspace(0, 5.5, 12), np.linspace(20, 40, 12))
    ]
)
STREET = np.stack(
    [
        look_at(np.array([x, 0.0, 2.0]), np.array([x + 5.0, y, 2.3]))
        for x, y in zip(range(12), np.linspace(-4, 4, 12))
    ]
)
LAWNMOWER = np.tile(np.diag([1.0, 1.0, 1.0]), (8, 1, 1))
LAWNMOWER[1::2] = np.diag([-1.0, -1.0, 1.0])  # to and fro, straight down
LAWNMOWER = np.concatenate([LAWNMOWER, np.zeros((8, 3, 1))], axis=2)
SURVEYS = {"oblique": RING, "street": STREET, "straight down": LAWNMOWER, "drone": poses(24)}


def test_the_axes_are_a_rotation_and_mean_what_they_say() -> None:
    np.testing.assert_array_equal(TO_DRB @ TO_DRB.T, np.eye(3))
    assert np.linalg.det(TO_DRB) == 1
    right, forward, up = np.eye(3)
    np.testing.assert_array_equal(TO_DRB @ up, [-1, 0, 0])
    np.testing.assert_array_equal(TO_DRB @ right, [0, 1, 0])
    np.testing.assert_array_equal(TO_DRB @ forward, [0, 0, -1])


def test_altitude_is_metres_above_the_datum() -> None:
    np.testing.assert_allclose(COORDINATES.altitudes(FILES), poses(24)[:, 2, 3])


def test_the_way_into_the_files_and_to_the_model_differs_by_units_and_origin_only() -> None:
    model, metres = COORDINATES.to_model(FILES), poses(24)
    np.testing.assert_allclose(model[:, :, :3], metres[:, :, :3], atol=1e-12)
    origin = TO_DRB.T @ COORDINATES.origin_drb
    np.testing.assert_allclose(40 * model[:, :, 3] + origin, metres[:, :, 3], atol=1e-9)


def test_the_transform_takes_metric_places_to_the_model() -> None:
    transform = COORDINATES.transform()
    drb = metric = FILES[:, :, 3] * COORDINATES.metres + COORDINATES.origin_drb
    drb = (metric @ transform[:, :3].T + transform[:, 3]) / COORDINATES.metres
    np.testing.assert_allclose(drb, COORDINATES.to_model(FILES)[:, :, 3], atol=1e-12)


def test_coordinates_around_cameras_hold_them() -> None:
    coordinates = around(poses(24)[:, :, 3])
    places = coordinates.to_file(poses(24))[:, :, 3]
    assert np.abs(places).max() == pytest.approx(1)
    assert around(np.zeros((1, 3))).metres > 0


@pytest.mark.parametrize("name", SURVEYS)
def test_a_survey_whose_first_axis_points_down_passes(name: str) -> None:
    assert wrong_axis(TO_DRB @ SURVEYS[name]) is None


@pytest.mark.parametrize("name", ["oblique", "drone"])
@pytest.mark.parametrize("direction", ["up", "left", "right", "back", "forward"])
def test_any_other_direction_of_down_is_named(name: str, direction: str) -> None:
    axis, sign = {
        "up": (0, -1),
        "left": (1, -1),
        "right": (1, 1),
        "back": (2, 1),
        "forward": (2, -1),
    }[direction]
    world = np.zeros((3, 3))
    world[axis, 2] = -sign  # where the scene's "up" goes
    world[(axis + 1) % 3, 0] = 1
    world[(axis + 2) % 3, 1] = np.linalg.det(world + _unit((axis + 2) % 3, 1))
    assert np.linalg.det(world) == pytest.approx(1)
    fault = wrong_axis(world @ SURVEYS[name])
    assert fault is not None and direction in fault


def _unit(row: int, column: int) -> np.ndarray:
    matrix = np.zeros((3, 3))
    matrix[row, column] = 1
    return matrix


def test_the_trap_of_poses_aligned_to_east_north_up_is_found() -> None:
    """colmap_to_mega_nerf.py takes the world to be (right, down, forward)."""
    from_rdf = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    fault = wrong_axis(from_rdf @ SURVEYS["drone"])
    assert fault is not None and "the cameras look back" in fault
