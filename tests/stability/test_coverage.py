"""Claims about `leco_plugin.stability.coverage`."""

from __future__ import annotations

import numpy as np
import pytest

from leco_plugin.scenes.city.cameras import Lens, look_at
from leco_plugin.stability.capture import Capture, shots_of
from leco_plugin.stability.coverage import View, shown_by
from leco_plugin.stability.matter import Array, Box, Paint
from leco_plugin.stability.measure import FEWEST_VIEWS
from leco_plugin.stability.stage import Stage, photograph
from leco_plugin.stability.stages import YARD

LENS = Lens(32, 24, 30.0)
GREY = Paint((0.5, 0.5, 0.5))
WALL = Box((-8.0, 0.0, -8.0), (8.0, 1.0, 8.0), GREY)


def view(stage: Stage, position: tuple[float, float, float], target: tuple[float, ...]) -> View:
    pose: Array = look_at(np.array(position), np.array(target))
    return View(pose, LENS, photograph(stage, pose, LENS).depth)


def test_a_picture_shows_what_it_shows_and_nothing_behind_it_or_beside_it() -> None:
    front = view(Stage((WALL,)), (0.0, -4.0, 0.0), (0.0, 0.0, 0.0))
    there = front.points.reshape(-1, 3)
    assert front.shows(there).all()
    assert not front.shows(there + np.array([0.0, 2.0, 0.0])).any()  # in the wall
    assert not front.shows(there - np.array([0.0, 2.0, 0.0])).any()  # in the air
    assert not front.shows(there + np.array([30.0, 0.0, 0.0])).any()  # beside the picture
    assert not front.shows(there - np.array([0.0, 9.0, 0.0])).any()  # behind the camera


def test_as_many_pictures_are_counted_as_show_the_place() -> None:
    left = view(Stage((WALL,)), (-2.0, -4.0, 0.0), (-2.0, 0.0, 0.0))
    both = view(Stage((WALL,)), (0.0, -4.0, 0.0), (0.0, 0.0, 0.0))
    counts = shown_by(left, [both, both, left])
    width = 4.0 * LENS.width / LENS.focal  # of the wall that a picture shows, metres
    overlap = (width - 2.0) / width
    assert (counts >= 1).all()
    assert np.mean(counts == 3) == pytest.approx(overlap, abs=0.05)


def test_what_something_hides_is_not_shown() -> None:
    screen = Box((-1.0, -2.2, -8.0), (1.0, -2.0, 8.0), GREY)
    hidden = view(Stage((WALL, screen)), (0.0, -4.0, 0.0), (0.0, 0.0, 0.0))
    beside = view(Stage((WALL, screen)), (3.0, -1.5, 0.0), (0.0, 0.0, 0.0))
    counts = shown_by(beside, [hidden])
    x = beside.points[..., 0]
    assert not counts[np.abs(x) < 1.0].any()


def test_nothing_shows_the_sky() -> None:
    empty = view(Stage(sky=True), (0.0, -4.0, 0.0), (0.0, 0.0, 0.0))
    assert not shown_by(empty, [empty]).any()


def test_what_the_held_out_pictures_of_a_case_show_can_be_learned() -> None:
    capture = Capture()
    shots = shots_of(capture)
    lens = capture.lens()
    views = [View(shot.pose, lens, photograph(YARD, shot.pose, lens).depth) for shot in shots]
    trained = [one for shot, one in zip(shots, views) if not shot.held_out]
    counts = np.concatenate(
        [
            shown_by(one, trained)[np.isfinite(one.depth)]
            for shot, one in zip(shots, views)
            if shot.held_out
        ]
    )
    assert np.mean(counts < FEWEST_VIEWS) < 1e-3
    assert np.percentile(counts, 1) >= 3
