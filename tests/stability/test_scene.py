"""Claims about shapes that rays meet, against points walked along the rays."""

from __future__ import annotations

import numpy as np
import pytest

from leco_plugin.stability.scene import Ball, Box, Fog, Paint, Pane, Rod, Shape, Stage, look

PAINT = Paint((0.5, 0.6, 0.7))
SHAPES: dict[str, Shape] = {
    "box": Box((-0.7, -0.4, 0.1), (0.5, 0.9, 1.2), PAINT),
    "ball": Ball((0.2, -0.1, 0.4), 0.8, PAINT),
    "rod": Rod((-0.6, 0.1, -0.5), (0.7, 0.3, 0.9), 0.35, PAINT),
}
WALK = 2e-3


def inside(shape: Shape, points: np.ndarray) -> np.ndarray:
    """Whether points [..., 3] lie in the shape, from its definition."""
    if isinstance(shape, Box):
        return ((points >= shape.low) & (points <= shape.high)).all(axis=-1)
    if isinstance(shape, Ball):
        return np.linalg.norm(points - np.array(shape.centre), axis=-1) <= shape.radius
    assert isinstance(shape, Rod)
    start, axis = np.array(shape.start), np.array(shape.end) - np.array(shape.start)
    along = (points - start) @ axis / (axis @ axis)
    beside = np.linalg.norm(points - start - along[..., None] * axis, axis=-1)
    return (along >= 0) & (along <= 1) & (beside <= shape.radius)


def rays(count: int = 300) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(3)
    origins = random.uniform(-2.5, 2.5, (count, 3))
    directions = random.uniform(-0.6, 0.6, (count, 3)) - origins
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


def walked_to(shape: Shape, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """[N] where walking along a ray first goes into the shape or out of it; inf for nowhere."""
    steps = np.arange(0.0, 8.0, WALK)
    states = inside(shape, origins[:, None] + directions[:, None] * steps[:, None])
    changes = states[:, 1:] != states[:, :-1]
    return np.where(changes.any(1), steps[changes.argmax(1)], np.inf)


@pytest.mark.parametrize("name", ["box", "ball"])
def test_a_ray_meets_a_solid_where_walking_along_it_does(name: str) -> None:
    origins, directions = rays()
    t, normals = SHAPES[name].meet(origins, directions)
    walked, met = walked_to(SHAPES[name], origins, directions), np.isfinite(t)
    assert (np.isfinite(walked) == met).mean() > 0.99  # a grazing ray can be stepped over
    both = met & np.isfinite(walked)
    assert both.mean() > 0.3 and np.abs(walked[both] - t[both]).max() < 2 * WALK
    assert np.allclose(np.linalg.norm(normals[met], axis=1), 1.0)
    outside = met & ~inside(SHAPES[name], origins)
    places = (origins + np.where(met, t, 0.0)[:, None] * directions)[outside]
    assert not inside(SHAPES[name], places + 1e-6 * normals[outside]).any()
    assert inside(SHAPES[name], places - 1e-6 * normals[outside]).all()


def test_a_ray_meets_the_side_of_a_rod_where_walking_along_it_does() -> None:
    rod = SHAPES["rod"]
    assert isinstance(rod, Rod)
    origins, directions = rays(600)
    t, normals = rod.meet(origins, directions)
    walked = walked_to(rod, origins, directions)
    found = np.flatnonzero(np.isfinite(walked))
    places = origins[found] + walked[found, None] * directions[found]
    axis = np.array(rod.end) - np.array(rod.start)
    along = (places - np.array(rod.start)) @ axis / (axis @ axis)
    sides = found[(along > 0.02) & (along < 0.98)]  # the ends are open
    assert len(sides) > 60 and np.abs(walked[sides] - t[sides]).max() < 3 * WALK
    met = np.isfinite(t)
    assert np.allclose(normals[met] @ axis, 0.0) and not met[np.isinf(walked)].any()
    assert np.allclose(np.linalg.norm(normals[met], axis=1), 1.0)
    middle = np.array(rod.start) + 0.5 * axis
    places = origins[sides] + t[sides, None] * directions[sides]
    assert (((places - middle) * normals[sides]).sum(axis=1) > 0.99 * rod.radius).all()


def test_a_room_is_met_from_within() -> None:
    t, normals = SHAPES["box"].meet(np.array([[0.0, 0.0, 0.5]]), np.array([[1.0, 0.0, 0.0]]))
    assert t == pytest.approx([0.5]) and normals.tolist() == [[-1.0, 0.0, 0.0]]


def test_a_pattern_stays_where_it_is_and_within_range() -> None:
    points = np.random.default_rng(0).uniform(-3, 3, (200, 3))
    colours = Paint((0.9, 0.5, 0.2), contrast=0.9).at(points)
    assert colours.min() >= 0.0 and colours.max() <= 1.0 and colours[:, 1].std() > 0.05
    paint, (fast, slow) = Paint((0.4, 0.2, 0.1), 2.0, 0.5), (2.7 * np.pi / 2, np.pi / 2)
    waves = 0.6 * np.sin(slow + 0.7) * np.sin(slow) * np.cos(slow / 2)
    waves += 0.4 * np.sin(fast + 0.7) * np.sin(fast) * np.cos(fast / 2)
    found = paint.at(np.array([[0.5, 0.5, 0.25]]))
    np.testing.assert_allclose(found, [(1.0 + 0.5 * waves) * np.array([0.4, 0.2, 0.1])])


FLAT = Paint((0.6, 0.6, 0.6), contrast=0.0)
WALL = Box((2.0, -5.0, -5.0), (3.0, 5.0, 5.0), FLAT)
ALONG_X = np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0]])


def seen(stage: Stage) -> np.ndarray:
    return look(stage, *ALONG_X)[0][0]


def test_the_nearest_surface_is_seen_and_the_rest_is_transparent() -> None:
    near = Box((1.0, -1.0, -1.0), (1.5, 1.0, 1.0), Paint((0.1, 0.9, 0.1), contrast=0.0))
    colours, depths, is_detail = look(Stage((WALL,), details=(near,)), *ALONG_X)
    assert depths == pytest.approx([1.0]) and is_detail.tolist() == [True]
    assert colours[0, 1] > colours[0, 0] and colours[0, 3] == 1.0
    nothing, depths, _ = look(Stage((WALL,)), ALONG_X[0], -ALONG_X[1])
    assert nothing.tolist() == [[0.0] * 4] and np.isinf(depths).all()


@pytest.mark.parametrize(
    ("origin", "direction", "towards"),
    [
        ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 0.0),
        ((9.0, 0.0, 0.0), (-1.0, 0.0, 0.0), 0.48),
        ((2.5, 0.0, 9.0), (0.0, 0.0, -1.0), 0.8),
        ((2.5, -9.0, 0.0), (0.0, 1.0, 0.0), 0.36),
        ((2.5, 9.0, 0.0), (0.0, -1.0, 0.0), 0.0),
    ],
)
def test_sides_are_lit_as_far_as_they_face_the_sun(
    origin: tuple[float, ...], direction: tuple[float, ...], towards: float
) -> None:
    colours, depths, _ = look(Stage((WALL,)), np.array([origin]), np.array([direction]))
    assert np.isfinite(depths).all()
    assert colours[0, :3] == pytest.approx(0.6 * (0.45 + 0.55 * towards))


def test_the_sky_is_behind_what_is_there() -> None:
    up = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [0.0, 0.6, 0.8], [1.0, 0.0, 0.0]])
    colours, depths, _ = look(Stage((WALL,), sky=True), np.zeros((4, 3)), up)
    zenith, horizon = np.array([0.35, 0.55, 0.86]), np.array([0.86, 0.90, 0.94])
    between = horizon + 0.8**0.6 * (zenith - horizon)
    np.testing.assert_allclose(colours[:3, :3], [zenith, horizon, between])
    assert (colours[:, 3] == 1.0).all() and np.isinf(depths[:3]).all() and depths[3] == 2.0


def test_fog_takes_what_the_law_of_beer_and_lambert_says() -> None:
    air = Box((-9.0, -9.0, -9.0), (9.0, 9.0, 9.0), Paint((1.0, 0.0, 0.0), contrast=0.0))
    clear, foggy = seen(Stage((WALL,))), seen(Stage((WALL,), fog=Fog(air, 0.4)))
    left = np.exp(-0.4 * 2.0)
    assert foggy[:3] == pytest.approx(left * clear[:3] + (1 - left) * np.array([1.0, 0, 0]))
    alone = look(Stage(fog=Fog(air, 0.4)), *ALONG_X)[0][0, 3]
    assert alone == pytest.approx(1 - np.exp(-0.4 * 9.0))


def test_panes_are_laid_from_back_to_front() -> None:
    def pane(x: float, colour: tuple[float, float, float]) -> Pane:
        return Pane(Box((x, -1, -1), (x + 0.01, 1, 1), Paint(colour, contrast=0.0)), 0.5)

    red, blue = pane(0.5, (1.0, 0.0, 0.0)), pane(1.0, (0.0, 0.0, 1.0))
    orders = [seen(Stage((WALL,), panes=order)) for order in ((red, blue), (blue, red))]
    assert orders[0] == pytest.approx(orders[1])
    assert orders[0][0] > orders[0][2]  # red is before blue
    behind = pane(4.0, (0.0, 1.0, 0.0))
    assert seen(Stage((WALL,), panes=(behind,))) == pytest.approx(seen(Stage((WALL,))))
