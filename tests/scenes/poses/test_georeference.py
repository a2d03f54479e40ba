"""Claims about up, metres and north of a reconstruction."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from leco_plugin.scenes.poses.georeference import (
    Array,
    Placement,
    local_places,
    place,
    roll_upright,
    tolerance,
    upright,
)


def rotation(seed: int) -> Array:
    matrix, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return np.asarray(matrix * np.linalg.det(matrix))


def survey(seed: int, columns: int = 6, rows: int = 4) -> tuple[Array, Array]:
    """Poses [C, 3, 4] of cameras that look down, flown to and fro, and points [P, 3] below."""
    rng = np.random.default_rng(seed)
    poses = np.zeros((columns * rows, 3, 4))
    for number in range(len(poses)):
        row, column = divmod(number, columns)
        turn = np.diag([-1.0, -1.0, 1.0]) if row % 2 else np.eye(3)
        tilt = 0.02 * rng.normal(size=(3, 3))
        poses[number, :, :3] = np.linalg.qr(turn + tilt)[0]
        poses[number, :, :3] *= np.sign((poses[number, :, :3] * turn).sum(axis=0))
        poses[number, :, 3] = 20.0 * column, 20.0 * row, 60.0 + rng.normal()
    points = rng.uniform((-30.0, -30.0, 0.0), (130.0, 90.0, 4.0), size=(500, 3))
    return poses, points


@pytest.mark.parametrize("seed", range(6))
def test_up_is_found_however_a_survey_lies(seed: int) -> None:
    poses, points = survey(seed)
    turn = np.eye(3) if seed == 0 else rotation(seed)
    found = upright(turn @ poses, points @ turn.T)
    assert math.degrees(math.acos(min(1.0, float(found @ turn[:, 2])))) < 3.0


def test_up_of_other_photographs_is_where_their_top_edges_are() -> None:
    around = np.linspace(0.0, 6.0, 12)
    poses = np.zeros((12, 3, 4))
    for pose, angle in zip(poses, around):
        out = np.array([math.cos(angle), math.sin(angle), 0.0])
        pose[:, 2], pose[:, 1] = out, (0.0, 0.0, 1.0)
        pose[:, 0], pose[:, 3] = np.cross(pose[:, 1], out), 4.0 * out
    turn = rotation(7)
    points = np.random.default_rng(0).normal(size=(200, 3))
    assert upright(turn @ poses, points @ turn.T) @ turn[:, 2] > 0.99


def line(count: int = 12) -> Array:
    """Places of a flight along one line, off it by a metre as GPS is."""
    rng = np.random.default_rng(0)
    places = np.outer(np.arange(count), [30.0, 10.0, 0.0]) + rng.normal(size=(count, 3))
    return np.asarray(places + np.array([0.0, 0.0, 300.0]))


def test_a_flight_along_a_line_is_rolled_upright_and_a_wide_one_is_left() -> None:
    places, turn = line(), rotation(3)
    up = turn.T @ np.array([0.0, 0.0, 1.0])
    direction = (places[-1] - places[0]) / np.linalg.norm(places[-1] - places[0])
    angle = 1.2
    x, y, z = direction
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    roll = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    mended = roll_upright(roll @ turn, places, up, width=5.0)
    assert (mended @ up)[2] > 0.99
    np.testing.assert_allclose(mended @ mended.T, np.eye(3), atol=1e-9)
    wide = survey(0)[0][:, :, 3]
    assert roll_upright(roll @ turn, wide, up, width=5.0) is not mended
    np.testing.assert_array_equal(roll_upright(roll @ turn, wide, up, width=5.0), roll @ turn)


def test_without_gps_a_reconstruction_is_turned_upright_in_its_own_units() -> None:
    for up in (rotation(1)[:, 2], np.array([0, 0, 1.0]), np.array([0, 0, -1.0])):
        placed = place(None, np.zeros((5, 3)), np.full((5, 3), np.nan), up)
        assert placed.residuals is None and placed.scale == 1.0
        np.testing.assert_allclose(placed.turn @ up, [0.0, 0.0, 1.0], atol=1e-12)
        np.testing.assert_allclose(np.linalg.det(placed.turn), 1.0)
        assert placed.reason == "no placed photographs have a GPS position, and 4 are needed"


def away(places: Array, seed: int = 5) -> tuple[Array, Array]:
    """The same places in other units and directions, and what up is there."""
    turn = rotation(seed)
    return 0.04 * (places - places.mean(axis=0)) @ turn.T + 3.0, turn[:, 2]


@pytest.mark.parametrize("wrong", [0, 5], ids=["all right", "five wrong"])
def test_gps_gives_metres_and_north(wrong: int) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    places = survey(1)[0][:, :, 3]
    centres, up = away(places)
    gps = places + np.random.default_rng(2).normal(size=places.shape)
    gps[:wrong] += 80.0
    gps[9] = np.nan
    placed = place(pycolmap, centres, gps, up)
    assert placed.residuals is not None and math.isnan(placed.residuals[9])
    assert np.nanmedian(placed.residuals) < 2.5
    np.testing.assert_allclose(placed.apply(centres), places, atol=3.0)
    assert placed.scale == pytest.approx(25.0, rel=0.03)


def test_a_line_of_gps_gives_metres_by_what_is_up() -> None:
    pycolmap = pytest.importorskip("pycolmap")
    places = line()
    centres, up = away(places)
    gps = places + np.random.default_rng(3).normal(size=places.shape)
    placed = place(pycolmap, centres, gps, up)
    assert placed.residuals is not None and placed.residuals.max() < 8.0
    np.testing.assert_allclose(placed.turn @ up, [0.0, 0.0, 1.0], atol=0.1)


@pytest.mark.parametrize("kind", ["a jump", "at random", "a drift", "not known"])
def test_wrong_altitudes_neither_tilt_a_survey_nor_cost_it_its_metres(kind: str) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    poses, _ = survey(1)
    places = poses[:, :, 3]
    centres, up = away(places)
    rng, gps = np.random.default_rng(2), places.copy()
    gps[:, :2] += rng.normal(size=(len(places), 2))
    wrong = {"a jump": 90.0 * (places[:, 1] > 30.0), "a drift": 0.2 * places[:, 0]}
    wrong |= {"at random": rng.uniform(0.0, 400.0, len(places)), "not known": -places[:, 2]}
    gps[:, 2] += wrong[kind]
    edges = {"rights": poses[:, :, 0] @ rotation(5).T, "altitudes": kind != "not known"}
    placed = place(pycolmap, centres, gps, up, **edges)
    assert placed.level and placed.residuals is not None and placed.residuals.max() < 5.0
    assert placed.scale == pytest.approx(25.0, rel=0.03)
    np.testing.assert_allclose(placed.turn @ up, [0.0, 0.0, 1.0], atol=1e-9)
    np.testing.assert_allclose(placed.apply(centres)[:, :2], places[:, :2], atol=3.0)
    assert np.median(gps[:, 2] - placed.apply(centres)[:, 2]) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("scatter", [0.0, 1.0])
def test_a_receiver_that_repeats_one_place_does_not_make_a_survey_small(scatter: float) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    places = survey(1)[0][:, :, 3]
    centres, up = away(places)
    gps = places.copy()
    gps[:18] = gps[0] + scatter * np.random.default_rng(0).normal(size=(18, 3))
    placed = place(pycolmap, centres, gps, up)
    assert placed.residuals is None and placed.scale == 1.0
    assert "GPS contradicts the poses" in placed.reason


def test_on_a_slope_gps_says_what_is_up() -> None:
    pycolmap = pytest.importorskip("pycolmap")
    poses, _ = survey(1)
    places = poses[:, :, 3] + 0.25 * poses[:, :1, 3] * [0.0, 0.0, 1.0]
    centres, up = away(places)
    slope = np.array([-0.25, 0.0, 1.0]) / math.hypot(0.25, 1.0)  # across the ground
    seems_up = rotation(5) @ slope
    placed = place(pycolmap, centres, places, seems_up, rights=poses[:, :, 0] @ rotation(5).T)
    assert not placed.level
    np.testing.assert_allclose(placed.turn @ up, [0.0, 0.0, 1.0], atol=1e-6)


def small_survey(off_by: float) -> tuple[Array, Array, Array]:
    """Centres, what is up, and positions within 25 m that are off by a receiver's error, metres."""
    places = survey(1)[0][:, :, 3]
    places = places * 18.0 / np.sqrt(places.var(axis=0).sum())
    gps = places + off_by * np.random.default_rng(2).normal(size=places.shape)
    return *away(places), gps


def test_the_error_of_an_ordinary_receiver_is_no_contradiction_in_a_small_survey() -> None:
    pycolmap = pytest.importorskip("pycolmap")
    centres, up, gps = small_survey(1.6)
    placed = place(pycolmap, centres, gps, up)
    assert placed.residuals is not None, placed.reason
    assert placed.scale == pytest.approx(25.0, rel=0.1)
    shuffled = np.random.default_rng(4).permutation(gps)
    assert place(pycolmap, centres, shuffled, up).reason.startswith("GPS contradicts the poses: ")


def test_the_tolerance_grows_with_the_survey_and_ends() -> None:
    assert [tolerance(spread) for spread in (0.0, 10.0, 25.0, 80.0, 1000.0)] == pytest.approx(
        [0.0, 3.0, 5.0, 8.0, 10.0]
    )


@pytest.mark.parametrize("spread", [0.0, 2.0], ids=["one position for all", "a few metres"])
def test_positions_too_near_one_another_are_said_to_be_so(spread: float) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    centres, up, gps = small_survey(0.0)
    gps = spread * np.random.default_rng(4).normal(size=gps.shape)
    placed = place(pycolmap, centres, gps, up)
    assert placed.residuals is None and "too near for what GPS is off by" in placed.reason


@pytest.mark.parametrize("kind", ["shuffled", "far from all"])
def test_gps_that_contradicts_the_poses_is_not_used(kind: str) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    places = survey(1)[0][:, :, 3]
    centres, up = away(places)
    rng = np.random.default_rng(4)
    gps = rng.permutation(places) if kind == "shuffled" else 40.0 * rng.normal(size=places.shape)
    placed = place(pycolmap, centres, gps, up)
    assert placed.residuals is None and placed.reason.startswith("GPS contradicts the poses: ")
    np.testing.assert_allclose(placed.turn @ up, [0.0, 0.0, 1.0], atol=1e-9)


@pytest.mark.parametrize("axis", [0, 1], ids=["longitude", "latitude"])
def test_mirrored_gps_does_not_turn_a_survey_upside_down(axis: int) -> None:
    """As where EXIF lacks the W of a longitude: cameras at one height fit after a half turn."""
    pycolmap = pytest.importorskip("pycolmap")
    places = survey(1)[0][:, :, 3]
    centres, up = away(places)
    gps = places.copy()
    gps[:, axis] *= -1.0
    placed = place(pycolmap, centres, gps, up)
    assert placed.residuals is None and placed.reason.startswith("GPS fits the poses only upside")
    np.testing.assert_allclose(placed.turn @ up, [0.0, 0.0, 1.0], atol=1e-9)
    # right GPS on a line, or of cameras that look up, says nothing of what seemed to be up
    places[:, 1] *= 0.02
    assert place(pycolmap, away(places)[0], places, -away(places)[1]).residuals is not None
    places[:, 1] *= 50.0
    turned, up = away(places)
    assert place(pycolmap, turned, places, -up).residuals is None
    assert place(pycolmap, turned, places, -up, 0.6 * up).residuals is not None
    # places in all three directions leave no doubt: what seemed to be up is wrong
    solid = np.random.default_rng(6).normal(size=places.shape) * 40.0
    placed = place(pycolmap, *away(solid)[:1], solid, -away(solid)[1])
    assert placed.residuals is not None and placed.residuals.max() < 1e-3


def test_places_are_metres_from_the_median_at_sea_level() -> None:
    pycolmap = pytest.importorskip("pycolmap")
    origin, places = local_places(
        pycolmap,
        [(41.5, -83.25, 300.0), None, (41.501, -83.25, math.nan), (41.5, -83.249, 310.0)],
    )
    assert origin == pytest.approx((41.5, -83.25, 0.0))
    np.testing.assert_allclose(places[0], (0.0, 0.0, 300.0), atol=1e-3)
    assert np.isnan(places[1]).all()
    np.testing.assert_allclose(places[2], (0.0, 111.07, 305.0), atol=0.02)
    np.testing.assert_allclose(places[3], (83.51, 0.0, 310.0), atol=0.02)


def test_places_on_both_sides_of_the_180th_meridian_are_near() -> None:
    pycolmap = pytest.importorskip("pycolmap")
    _, places = local_places(pycolmap, [(-17.0, 179.9999, 5.0), (-17.0, -179.9999, 5.0)])
    assert np.linalg.norm(places[0] - places[1]) < 25.0


def test_no_position_has_no_origin() -> None:
    origin, places = local_places(None, [None, None])
    assert origin is None and np.isnan(places).all()


def test_a_placement_is_a_similarity() -> None:
    placed = Placement(2.0, rotation(0), np.array([1.0, 2.0, 3.0]))
    points = np.random.default_rng(0).normal(size=(4, 3))
    np.testing.assert_allclose(placed.apply(points)[0], 2.0 * placed.turn @ points[0] + [1, 2, 3])


def estimates(found: Any) -> Any:
    """A pycolmap that estimates this."""
    options = lambda: SimpleNamespace(max_error=0.0, random_seed=-1)  # noqa: E731
    return SimpleNamespace(RANSACOptions=options, estimate_sim3d_robust=lambda *_: found)


def test_no_estimate_is_a_contradiction() -> None:
    places = survey(0)[0][:, :, 3]
    gps = np.random.default_rng(4).permutation(places)
    placed = place(estimates(None), places, gps, np.array([0.0, 0.0, 1.0]))
    assert placed.residuals is None and ": 0 of 24 positions agree within 5.0 m" in placed.reason


@pytest.mark.parametrize("first", [179.9999, -179.9999])
def test_the_origin_of_places_around_the_180th_meridian_is_among_them(first: float) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    given = [(-17.0, each, 5.0) for each in (first, -first)]
    origin, places = local_places(pycolmap, given)
    assert origin is not None and abs(origin[1]) == pytest.approx(180.0)
    assert np.abs(places[:, :2]).max() < 25.0  # metres east and north of it
    np.testing.assert_allclose(places[:, 2], 5.0, atol=1e-3)
