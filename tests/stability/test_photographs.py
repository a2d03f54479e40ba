"""Claims about how a scene is photographed, what goes wrong in that, and what lies on disk."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from PIL import Image

from leco_plugin.scenes.city.cameras import Lens, look_at
from leco_plugin.scenes.coloured_points import read_points
from leco_plugin.scenes.frames import distance_from_rotations
from leco_plugin.scenes.photographs import read_scene
from leco_plugin.stability import photographs
from leco_plugin.stability.photographs import (
    STAGES,
    TRUTH,
    YARD,
    Capture,
    Shot,
    count_views,
    digest_of,
    shots_of,
    write_scene,
)
from leco_plugin.stability.scene import Array, Box, Paint, Seen, Stage, photograph
from leco_plugin.stability.worker import FEWEST_VIEWS

PLAIN = Capture()


def trained(capture: Capture) -> list[Shot]:
    return [shot for shot in shots_of(capture) if not shot.held_out]


def held_out(capture: Capture) -> list[Shot]:
    return [shot for shot in shots_of(capture) if shot.held_out]


@pytest.mark.parametrize("views", [4, 6, 40])
def test_there_are_as_many_pictures_as_asked_for(views: int) -> None:
    capture = replace(PLAIN, views=views)
    assert (len(trained(capture)), len(held_out(capture))) == (views, capture.test_views)


@pytest.mark.parametrize(
    "capture",
    [
        Capture(exposure=0.5),
        Capture(shift=0.1, turn=2.0),
        Capture(moving=True),
        Capture(sizes=(1.0, 0.5)),
        Capture(stray=2),
    ],
)
def test_held_out_pictures_show_what_is_really_there(capture: Capture) -> None:
    for one, plain in zip(held_out(capture), held_out(PLAIN), strict=True):
        assert (one.gain, one.size, one.moving) == (1.0, 1.0, False)
        assert np.array_equal(one.pose, plain.pose) and np.array_equal(one.written, one.pose)
    assert any(
        (one.gain, one.size, one.moving) != (1.0, 1.0, False)
        or not np.array_equal(one.written, plain.written)
        for one, plain in zip(trained(capture), trained(PLAIN), strict=True)
    )


def test_noise_has_the_size_that_was_asked_for() -> None:
    shots = trained(Capture(views=400, shift=0.05, turn=2.0))
    shifts = np.concatenate([shot.written[:, 3] - shot.pose[:, 3] for shot in shots])
    turns = [shot.written[:, :3] @ shot.pose[:, :3].T for shot in shots]
    angles = np.rad2deg(np.arccos(np.clip((np.trace(turns, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    assert shifts.std() == pytest.approx(0.05, rel=0.15)
    assert np.sqrt((angles**2).mean() / 3) == pytest.approx(2.0, rel=0.15)
    assert distance_from_rotations(np.stack([s.written[:, :3] for s in shots])).max() < 1e-9


def test_the_origin_moves_what_is_written_and_nothing_else() -> None:
    capture = Capture(origin=(1e4, 0.0, -5.0))
    for shot in shots_of(capture):
        assert (shot.written - shot.pose)[:, 3] == pytest.approx([1e4, 0.0, -5.0])


LENS = Lens(32, 24, 30.0)
GREY = Paint((0.5, 0.5, 0.5))
WALL = Box((-8.0, 0.0, -8.0), (8.0, 1.0, 8.0), GREY)


def view(stage: Stage, position: tuple[float, float, float], target: tuple[float, ...]) -> Seen:
    pose: Array = look_at(np.array(position), np.array(target))
    return photograph(stage, pose, LENS)


def points_of(view: Seen) -> Array:
    """[h, w, 3] what a picture shows, metres."""
    return view.lens.points(view.pose, view.depth)


def test_a_picture_shows_what_it_shows_and_nothing_behind_it_or_beside_it() -> None:
    front = view(Stage((WALL,)), (0.0, -4.0, 0.0), (0.0, 0.0, 0.0))
    there = points_of(front).reshape(-1, 3)
    assert front.shows(there).all()
    assert not front.shows(there + np.array([0.0, 2.0, 0.0])).any()  # in the wall
    assert not front.shows(there - np.array([0.0, 2.0, 0.0])).any()  # in the air
    assert not front.shows(there + np.array([30.0, 0.0, 0.0])).any()  # beside the picture
    assert not front.shows(there - np.array([0.0, 9.0, 0.0])).any()  # behind the camera


def test_as_many_pictures_are_counted_as_show_the_place() -> None:
    left = view(Stage((WALL,)), (-2.0, -4.0, 0.0), (-2.0, 0.0, 0.0))
    both = view(Stage((WALL,)), (0.0, -4.0, 0.0), (0.0, 0.0, 0.0))
    counts = count_views(left, [both, both, left])
    width = 4.0 * LENS.width / LENS.focal  # of the wall that a picture shows, metres
    overlap = (width - 2.0) / width
    assert (counts >= 1).all()
    assert np.mean(counts == 3) == pytest.approx(overlap, abs=0.05)


def test_what_something_hides_is_not_shown() -> None:
    screen = Box((-1.0, -2.2, -8.0), (1.0, -2.0, 8.0), GREY)
    hidden = view(Stage((WALL, screen)), (0.0, -4.0, 0.0), (0.0, 0.0, 0.0))
    beside = view(Stage((WALL, screen)), (3.0, -1.5, 0.0), (0.0, 0.0, 0.0))
    counts = count_views(beside, [hidden])
    x = points_of(beside)[..., 0]
    assert not counts[np.abs(x) < 1.0].any()


def test_nothing_shows_the_sky() -> None:
    empty = view(Stage(sky=True), (0.0, -4.0, 0.0), (0.0, 0.0, 0.0))
    assert not count_views(empty, [empty]).any()


def test_what_the_held_out_pictures_of_a_case_show_can_be_learned() -> None:
    capture = Capture()
    shots = shots_of(capture)
    lens = capture.lens()
    views = [photograph(YARD, shot.pose, lens) for shot in shots]
    trained = [one for shot, one in zip(shots, views) if not shot.held_out]
    counts = np.concatenate(
        [
            count_views(one, trained)[np.isfinite(one.depth)]
            for shot, one in zip(shots, views)
            if shot.held_out
        ]
    )
    assert np.mean(counts < FEWEST_VIEWS) < 1e-3
    assert np.percentile(counts, 1) >= 3


SMALL = Capture(views=4, test_views=2, width=16, height=12)


def test_nerfstudio_can_read_it_and_the_truth_lies_beside(tmp_path: Path) -> None:
    folder = write_scene(STAGES["poles-and-wires"], SMALL, tmp_path / "scene")
    meta = read_scene(folder).meta
    assert len(meta["train_filenames"]) == 4 and len(meta["test_filenames"]) == 2
    for name in meta["test_filenames"]:
        truth = np.load(folder / TRUTH / f"{Path(name).stem}.npz")
        assert truth["depth"].shape == truth["detail"].shape == (12, 16)
        assert np.isfinite(truth["depth"]).mean() > 0.5
        assert truth["shown_by"].shape == (12, 16)
        assert not truth["shown_by"][np.isinf(truth["depth"])].any()
        assert 2 <= truth["shown_by"].max() <= 4  # by training pictures alone
    assert not list(tmp_path.glob(".*"))


def test_sparse_points_lie_on_surfaces_where_the_written_poses_put_them(tmp_path: Path) -> None:
    cube = Stage((Box((-1.0, -1.0, 0.0), (1.0, 1.0, 2.0), Paint((0.5, 0.5, 0.5))),))
    far = Capture(views=4, test_views=2, width=16, height=12, origin=(100.0, 0.0, 0.0))
    folder = write_scene(cube, far, tmp_path / "scene")
    points = read_points(read_scene(folder).meta, folder)
    assert points is not None
    offsets = (points.positions - [100.0, 0.0, 1.0]) / 1.0
    assert np.abs(offsets).max(axis=1) == pytest.approx(np.ones(len(points.positions)), abs=1e-3)


def test_a_scene_without_surfaces_has_no_points(tmp_path: Path) -> None:
    folder = write_scene(STAGES["all-empty"], SMALL, tmp_path / "scene")
    assert "ply_file_path" not in read_scene(folder).meta


def test_pictures_of_three_sizes_fit_their_intrinsics(tmp_path: Path) -> None:
    mixed = Capture(views=6, test_views=2, width=16, height=12, sizes=(1.0, 0.5, 1.5))
    folder = write_scene(YARD, mixed, tmp_path / "scene")
    frames = read_scene(folder).meta["frames"]
    assert {(frame["w"], frame["h"]) for frame in frames} == {(16, 12), (8, 6), (24, 18)}
    assert {frame["fl_x"] / frame["w"] for frame in frames} == {frames[0]["fl_x"] / frames[0]["w"]}


def test_exposure_changes_the_light_and_not_the_shape(tmp_path: Path) -> None:
    plain = write_scene(YARD, SMALL, tmp_path / "plain")
    exposed = Capture(views=4, test_views=2, width=16, height=12, exposure=0.5)
    other = write_scene(YARD, exposed, tmp_path / "other")
    for name in read_scene(plain).meta["train_filenames"]:
        one, two = (np.asarray(Image.open(folder / name)) for folder in (plain, other))
        assert np.array_equal(one[..., 3], two[..., 3]) and not np.array_equal(one, two)


def test_a_scene_is_written_once_and_anew_when_it_should_differ(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(photographs, "transforms_of", Mock(side_effect=KeyboardInterrupt))
        patch.setattr("os.getpid", lambda: 1)  # of the process that was killed
        write_scene(YARD, SMALL, tmp_path / "scene")
    assert not (tmp_path / "scene").exists()
    folder = write_scene(YARD, SMALL, tmp_path / "scene")
    marked = folder / "transforms.json"
    marked.write_text(marked.read_text() + " ")
    write_scene(YARD, SMALL, folder)
    assert marked.read_text().endswith(" ")
    write_scene(STAGES["outline"], SMALL, folder)
    json.loads(marked.read_text())
    assert not marked.read_text().endswith(" ")
    assert [path.name for path in tmp_path.iterdir()] == ["scene"]
    assert digest_of(YARD, SMALL) != digest_of(STAGES["outline"], SMALL)
