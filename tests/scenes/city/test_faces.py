"""Distances to one face, against the same face cut into many points or triangles."""

import numpy as np
import pytest

from leco_plugin.scenes.city.faces import (
    squared_to_feet,
    squared_to_stretches,
    squared_to_triangles,
)


def test_a_triangle_is_as_near_as_the_nearest_of_its_points() -> None:
    random = np.random.default_rng(0)
    triangles, points = random.normal(size=(40, 3, 3)), random.normal(0, 2, (40, 3))
    u, v = np.meshgrid(np.linspace(0, 1, 150), np.linspace(0, 1, 150))
    weights = np.stack([1 - u, u * (1 - v), u * v], -1).reshape(-1, 3)
    places = np.einsum("sk,tkj->tsj", weights, triangles)
    sampled = np.linalg.norm(places - points[:, None], axis=-1).min(1)
    exact = np.sqrt(squared_to_triangles(points, triangles))
    assert (exact <= sampled + 1e-12).all()
    np.testing.assert_allclose(exact, sampled, atol=0.02)


@pytest.mark.parametrize("sides", [4, 8, 12])
@pytest.mark.parametrize(
    "rings", [(0.5, 1.0, 0.5, 4.0), (0.3, 1.0, 1.4, 1.7), (1.2, 2.0, 0.0, 2.0)]
)
def test_a_stretch_is_as_near_as_the_nearest_of_its_sides(
    sides: int, rings: tuple[float, float, float, float]
) -> None:
    r0, z0, r1, z1 = rings
    points = np.random.default_rng(1).uniform([1, -1, 0], [5, 3, 6], (200, 3))
    turn = 2 * np.pi * np.arange(sides + 1) / sides
    circle = np.stack([np.cos(turn), np.sin(turn), np.zeros(sides + 1)], 1)
    lower, upper = ([3.0, 1.0, z] + r * circle for r, z in ((r0, z0), (r1, z1)))
    triangles = [np.stack([lower[:-1], lower[1:], upper[1:]], 1)]
    if r1 > 0:
        triangles.append(np.stack([lower[:-1], upper[1:], upper[:-1]], 1))
    every = [
        squared_to_triangles(points, np.broadcast_to(t, (len(points), 3, 3)))
        for t in np.concatenate(triangles)
    ]
    row = np.broadcast_to([3.0, 1.0, sides, z0, r0, z1, r1], (len(points), 7))
    np.testing.assert_allclose(squared_to_stretches(points, row), np.min(every, 0), atol=1e-12)


def test_a_foot_is_a_square_with_a_hole() -> None:
    foot = np.array([[2.0, 1.0, 8, 0.5, 0.3, 0.6]])
    middle_of_side = 0.3 * np.cos(np.pi / 8)
    for point, distance in (
        ([2.0, 1.0, 0.5], middle_of_side),
        ([2.5, 1.0, 0.5], 0.0),
        ([2.5, 1.0, 0.9], 0.4),
        ([3.6, 1.0, 0.5], 1.0),
        ([3.6, 2.6, 0.5], np.sqrt(2)),
    ):
        assert np.sqrt(squared_to_feet(np.array([point]), foot)[0]) == pytest.approx(distance)
