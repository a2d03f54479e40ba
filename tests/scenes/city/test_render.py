"""Pictures agree with the exact geometry, thin things included, and stick to the surfaces."""

import numpy as np
import pytest

from leco_plugin.scenes.city import render
from leco_plugin.scenes.city.cameras import Lens, aerial_cameras, look_at, street_cameras
from leco_plugin.scenes.city.city import City, CityConfig
from leco_plugin.scenes.city.render import Tracer
from leco_plugin.scenes.city.shapes import Material

LENS = Lens(64, 48, 55.0)


@pytest.fixture(scope="module")
def tracer() -> Tracer:
    return Tracer(City(CityConfig(blocks=2, seed=0)))


@pytest.fixture(scope="module")
def corner(tracer: Tracer) -> np.ndarray:
    """The pole line's corner [2] of the first block: all poles are at known places from it."""
    return tracer.city.centres[0, 0]


def test_every_ray_ends_on_a_surface(tracer: Tracer) -> None:
    poses = [*aerial_cameras(tracer.city, 4, 0), *street_cameras(tracer.city, 3, 0)]
    for pose in poses:
        _, depth = tracer.photograph(pose, LENS)
        hit = np.isfinite(depth)
        assert hit.any()
        points = LENS.points(pose, depth)[hit]
        assert tracer.city.distance(points).max() < 1e-4


def test_nothing_stands_between_the_camera_and_what_it_sees(tracer: Tracer) -> None:
    for pose in street_cameras(tracer.city, 3, 1):
        _, depth = tracer.photograph(pose, LENS)
        share = np.random.default_rng(0).uniform(0, 0.999, depth.shape)
        before = LENS.points(pose, np.minimum(depth, 100.0) * share)
        assert not tracer.city.occupied(before.reshape(-1, 3)).any()


def test_a_pole_is_seen_at_its_distance(tracer: Tracer, corner: np.ndarray) -> None:
    pole = np.array([corner[0] + 14 - 0.8, corner[1] + 0.36 * 28, 6.5])
    eye = pole + np.array([5.0, 0.0, 0.0])
    lens = Lens(33, 25, 40.0)
    image, depth = tracer.photograph(look_at(eye, pole), lens)
    middle = depth[:, 16]
    assert middle[12] == pytest.approx(4.87, abs=0.04)
    assert (middle < 7).all(), "the pole runs through the whole picture"
    assert np.median(depth[:, 2]) > 7
    assert np.abs(image[12, 16].astype(int) - image[12, 4]).max() > 20


def test_a_wire_is_seen_from_below(tracer: Tracer, corner: np.ndarray) -> None:
    eye = np.array([corner[0] + 14 - 0.8 + 0.4, corner[1], 2.0])
    _, depth = tracer.photograph(look_at(eye, eye + np.array([0, 0, 1.0])), Lens(65, 65, 400.0))
    assert depth[32, 32] == pytest.approx(9.6 - 0.44 - 0.05 - 2.0, abs=0.02)
    assert 0.05 < np.isfinite(depth).mean() < 0.6


def test_a_place_looks_the_same_from_everywhere(tracer: Tracer) -> None:
    """Colour belongs to the surface: two rays to one place bring back one colour."""
    city, random = tracer.city, np.random.default_rng(2)
    chosen = random.choice(np.flatnonzero(city.triangles[:, 0, 2] > -0.1), 400)
    places = city.triangles[chosen].mean(1)
    found = []
    for eye in ([60.0, -50.0, 70.0], [40.0, -70.0, 90.0]):
        rays = places - eye
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        origins = np.broadcast_to(eye, rays.shape)
        depth = tracer.cast(origins, rays)[1]
        seen = np.abs(depth - np.linalg.norm(places - eye, axis=1)) < 1e-3
        found.append((seen, tracer.colour(origins, rays, 1e-6)[0]))
    (seen_a, a), (seen_b, b) = found
    both = seen_a & seen_b
    assert both.sum() > 30
    assert (np.abs(a - b)[both].max(1) < 0.02).mean() > 0.97  # edges of stripes and shadows aside


def test_light_is_the_suns_where_it_reaches_and_the_skys(
    tracer: Tracer, monkeypatch: pytest.MonkeyPatch
) -> None:
    def grey(city: City, places: np.ndarray, *_: object) -> np.ndarray:
        return np.full(places.shape, 0.5, np.float32)

    monkeypatch.setattr(render, "paint_surface", grey)
    random = np.random.default_rng(0)
    origins = np.array([0.0, 0.0, 60.0]) + random.uniform(-30, 30, (300, 3)) * [1, 1, 0]
    rays = random.normal(0, 0.5, (300, 3)) * [1, 1, 0] - [0, 0, 1]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    faces, depths = tracer.cast(origins, rays)
    hit = faces >= 0
    places, normals = (origins + depths[:, None] * rays)[hit], tracer.normals[faces[hit]]
    towards = normals @ render.SUN
    starts = places + 1e-3 * normals
    shadow = tracer.cast(starts, np.broadcast_to(render.SUN, starts.shape))[0] >= 0
    lit = np.where(shadow, 0.0, towards.clip(min=0.0))[:, None]
    openness = 0.55 + 0.3 * normals[:, 2:] + 0.15 * (places[:, 2:] / 12).clip(0, 1)
    light = lit * [1.06, 1.0, 0.9] + openness * [0.42, 0.46, 0.52]
    found = tracer.colour(origins, rays, 1e-3)[0][hit]
    np.testing.assert_allclose(found, (0.5 * light).clip(0, 1), atol=1e-5)
    assert (towards < -0.1).sum() > 9 and (shadow & (towards > 0.1)).sum() > 9 and lit.max() > 0.7


def test_the_sky_is_pale_at_the_horizon_and_below() -> None:
    directions = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.6, -0.8], [0.6, 0.0, 0.8]])
    zenith, horizon = np.array([0.22, 0.42, 0.72]), np.array([0.74, 0.80, 0.86])
    between = horizon + 0.8**0.6 * (zenith - horizon)
    np.testing.assert_allclose(
        render.sky(directions), [zenith, horizon, horizon, between], rtol=1e-5
    )


def test_all_materials_are_textured(tracer: Tracer) -> None:
    """Within each kind of surface, neighbouring places differ, so that matching has a grip."""
    pixels = Lens(200, 150, 170.0)
    pose = look_at(np.array([-55.0, -60.0, 60.0]), np.zeros(3))
    image, _ = tracer.photograph(pose, pixels)
    rays = (pixels.directions() @ pose[:, :3].T).reshape(-1, 3)
    faces, _ = tracer.cast(np.broadcast_to(pose[:, 3], rays.shape), rays)
    material = np.where(faces >= 0, tracer.city.material[tracer.city.paint[faces]], -1)
    for kind in (Material.STREET, Material.WALL, Material.ROOF, Material.GRASS):
        shown = image.reshape(-1, 3)[material == kind]
        assert len(shown) > 100
        assert shown.std(0).mean() > 5


def test_without_sky_a_ray_that_misses_is_black_and_infinitely_deep() -> None:
    up = look_at(np.array([0.0, 0, 200]), np.array([0.0, 0, 300]))
    for sky in (False, True):
        tracer = Tracer(City(CityConfig(blocks=1, sky=sky)))
        image, depth = tracer.photograph(up, LENS)
        assert np.isinf(depth).all()
        assert (image > 0).all() == sky
        assert (image == 0).all() != sky
