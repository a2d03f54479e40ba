"""The search finds what looking at every shape finds."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from leco_plugin.scenes.city import city as city_queries
from leco_plugin.scenes.city.city import City, CityConfig, squared_to_triangles


def distance_by_looking_at_all(city: City, points: np.ndarray) -> np.ndarray:
    """The slow twin: each of points [N, 3] against every triangle the rays are cast at."""
    repeated = (np.broadcast_to(point, (len(city.triangles), 3)) for point in points)
    return np.sqrt([squared_to_triangles(each, city.triangles).min() for each in repeated])


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 2**31), st.booleans(), st.sampled_from([32.0, 40.0, 71.3]))
def test_distance_is_that_to_the_nearest_of_all_triangles(
    seed: int, far_terrain: bool, block_size: float
) -> None:
    city = City(CityConfig(blocks=1, seed=seed, far_terrain=far_terrain, block_size=block_size))
    random = np.random.default_rng(seed)
    near = random.uniform([-40, -40, -8], [40, 40, 45], (120, 3))
    on_faces = city.triangles[random.integers(len(city.triangles), size=60)].mean(1)
    close = on_faces + random.normal(0, 0.1, on_faces.shape)
    far = random.normal(0, 300, (20, 3))
    points = np.concatenate([near, close, far])
    slow = distance_by_looking_at_all(city, points)
    np.testing.assert_allclose(city.distance(points), slow, rtol=1e-9, atol=1e-9)


def test_the_answers_do_not_depend_on_how_points_are_grouped(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    city = City(CityConfig(blocks=2, seed=1))
    points = np.random.default_rng(0).uniform([-50, -50, -5], [50, 50, 30], (2000, 3))
    distance, occupied = city.distance(points), city.occupied(points)
    monkeypatch.setattr(city_queries, "_PAIRS", 1)
    np.testing.assert_allclose(city.distance(points[:200]), distance[:200], rtol=1e-12)
    assert np.array_equal(city.occupied(points[:200]), occupied[:200])
    assert 0 < occupied.mean() < 1


def test_no_points_and_equal_points_are_answered() -> None:
    city = City(CityConfig(blocks=1))
    assert city.distance(np.zeros((0, 3))).shape == (0,)
    assert city.occupied(np.zeros((0, 3))).shape == (0,)
    same = np.tile([[3.0, 2.0, 60.0]], (70_000, 1))
    assert np.unique(city.distance(same)).size == 1
    assert not city.occupied(same).any()


def test_distance_changes_no_faster_than_the_point_moves() -> None:
    city = City(CityConfig(blocks=2, seed=3))
    random = np.random.default_rng(0)
    points = random.uniform([-50, -50, -5], [50, 50, 40], (3000, 3))
    step = random.normal(0, 0.5, points.shape)
    change = np.abs(city.distance(points + step) - city.distance(points))
    assert (change <= np.linalg.norm(step, axis=1) + 1e-9).all()


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
