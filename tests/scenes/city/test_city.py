"""The city as a whole: decided by its configuration, of one matter, irregular at its rim."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from leco_plugin.scenes.city.city import City, CityConfig
from leco_plugin.scenes.city.plan import choose_blocks
from leco_plugin.scenes.city.shapes import Material

SMALL = st.builds(
    CityConfig,
    blocks=st.integers(1, 2),
    seed=st.integers(0, 2**31),
    block_size=st.floats(32, 80),
    far_terrain=st.booleans(),
)


@pytest.fixture(scope="module")
def city() -> City:
    return City(CityConfig(blocks=3, seed=4))


def faces_and_normals(city: City) -> tuple[np.ndarray, np.ndarray]:
    """One random place on each face, and the face's outward normal: [T, 3] each."""
    corners = city.triangles
    weights = np.random.default_rng(0).dirichlet([1, 1, 1], len(corners))
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return np.einsum("tk,tkj->tj", weights, corners), normals


def crossings(city: City, origins: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """How many faces the rays from [N, 3] along one direction cross, in double precision: [N]."""
    first, second, third = city.triangles.transpose(1, 0, 2)
    u, v = second - first, third - first
    across = np.cross(direction, v)
    scale = np.einsum("tk,tk->t", u, across)
    counts = []
    for origin in origins:
        away = origin - first
        b = np.einsum("tk,tk->t", away, across) / scale
        turned = np.cross(away, u)
        c = turned @ direction / scale
        depth = np.einsum("tk,tk->t", v, turned) / scale
        counts.append(((b >= 0) & (c >= 0) & (b + c <= 1) & (depth > 0)).sum())
    return np.array(counts)


def test_the_configuration_decides_everything(city: City) -> None:
    again, other = City(city.config), City(CityConfig(blocks=3, seed=5))
    assert np.array_equal(city.triangles, again.triangles)
    assert np.array_equal(city.paint, again.paint)
    assert np.array_equal(city.colour, again.colour)
    assert city.triangles.shape != other.triangles.shape


@settings(max_examples=12, deadline=None)
@given(SMALL)
def test_every_face_has_matter_behind_it_and_air_before_it(config: CityConfig) -> None:
    city = City(config)
    places, normals = faces_and_normals(city)
    assert not city.occupied(places + 1e-5 * normals).any()
    assert city.occupied(places - 1e-5 * normals).all()


def test_a_point_is_inside_if_a_ray_from_it_crosses_an_odd_number_of_faces(city: City) -> None:
    random = np.random.default_rng(1)
    low, high = city.bounds
    points = random.uniform(low - 1, [*high[:2] + 1, 20.0], (300, 3))
    odd = crossings(city, points, np.array([0.31, 0.53, 0.79])) % 2 == 1
    assert np.array_equal(city.occupied(points), odd)
    assert 0.05 < odd.mean() < 0.6


def test_the_middles_of_walls_poles_and_wires_are_matter(city: City) -> None:
    x, y = city.centres[tuple(np.argwhere(city.built)[0])]
    line, quarter = 0.35 * 40 - 0.8, 0.36 * 28
    pole, below_wire = [x + line, y + quarter], [x + line + 0.4, y + quarter]
    assert city.occupied(np.array([[*pole, 5.0], [*below_wire, 9.6]])).all()
    assert not city.occupied(np.array([[*pole, 12.0], [*below_wire, 9.0]])).any()
    assert city.occupied(np.array([[x, y, -1.0], [x + 20, y + 20, -0.01]])).all()


@pytest.mark.parametrize("blocks", [3, 4, 7, 8])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_rim_has_gaps_and_the_rest_hangs_together(blocks: int, seed: int) -> None:
    built = choose_blocks(blocks, seed)
    assert not built[[0, 0, -1, -1], [0, -1, 0, -1]].all()
    assert built[1:-1, 1:-1].all()
    assert built.mean() > 0.6
    padded = np.pad(built, 1)
    neighbours = padded[:-2, 1:-1] | padded[2:, 1:-1] | padded[1:-1, :-2] | padded[1:-1, 2:]
    assert neighbours[built].all()


@pytest.mark.parametrize("blocks", [9, 16, 64])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_outline_of_a_large_city_wanders(blocks: int, seed: int) -> None:
    built = choose_blocks(blocks, seed)
    assert 0.7 < built.mean() < 0.9
    widths = {int(np.ptp(np.flatnonzero(row))) for row in built if row.any()}
    assert len(widths) >= blocks // 4
    reached = np.zeros_like(built)
    todo = [tuple(np.argwhere(built)[0])]
    while todo:
        i, j = todo.pop()
        if 0 <= i < blocks and 0 <= j < blocks and built[i, j] and not reached[i, j]:
            reached[i, j] = True
            todo += [(i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)]
    assert np.array_equal(reached, built)


def test_the_outline_is_irregular(city: City) -> None:
    """How far the ground reaches beyond the last street differs from place to place."""
    i, j = np.argwhere(city.built)[-1]
    x, y = city.centres[i, j]
    along = np.linspace(-18, 18, 30)
    out = np.arange(20, 32, 0.1)
    places = np.stack(np.broadcast_arrays(x + out, y + along[:, None], -1.0), -1)
    if i + 1 < len(city.built) and city.built[i + 1, j]:
        pytest.fail("the last block of the list has no free side to the east")
    reach = city.occupied(places.reshape(-1, 3)).reshape(30, -1).sum(1) / 10
    assert reach.min() > 1
    assert np.ptp(reach) > 1


def test_terrain_lies_around_the_city_and_below_its_ground() -> None:
    city = City(CityConfig(blocks=2, far_terrain=True))
    terrain = city.material[city.paint] == Material.TERRAIN
    assert np.abs(city.triangles[terrain]).max() > 4 * np.abs(city.centres).max()
    assert city.triangles[terrain][..., 2].max() > 10
    assert city.occupied(np.array([[0.0, 0.0, -6.0]])).all()


def test_a_place_is_on_a_block_where_its_cell_is_built(city: City) -> None:
    assert not np.array_equal(city.built, city.built.T)  # else axes could be swapped
    for i, j in np.ndindex(*city.built.shape):
        corners = np.array([[-19.9, -19.9], [19.9, -19.9], [-19.9, 19.9], [19.9, 19.9]])
        assert (city.on_block(city.centres[i, j] + corners) == city.built[i, j]).all()
    assert not city.on_block(np.array([[60.1, 0.0], [-60.1, 0.0], [0.0, 60.1], [0.0, -60.1]])).any()


def test_a_city_at_the_limits_can_be_asked_for() -> None:
    assert CityConfig(blocks=1, block_size=32.0) and CityConfig(blocks=64, block_size=200.0)
    for size in (31.9, 200.1):
        with pytest.raises(ValueError, match="32 to 200 metres"):
            CityConfig(block_size=size)


@pytest.mark.parametrize(
    "bad", [{"blocks": 0}, {"blocks": 65}, {"seed": -1}, {"block_size": 5.0}, {"block_size": 1e9}]
)
def test_a_city_that_cannot_be_built_is_refused_in_one_line(bad: dict) -> None:
    with pytest.raises(ValueError, match=r"^[^\n]+$"):
        CityConfig(**bad)
