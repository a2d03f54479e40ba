"""Claims about how a scene is photographed, and what goes wrong in that."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from leco_plugin.scenes.rotations import distance_from_rotations
from leco_plugin.stability.capture import Capture, Shot, rotation, shots_of

PLAIN = Capture()


def trained(capture: Capture) -> list[Shot]:
    return [shot for shot in shots_of(capture) if not shot.held_out]


def held_out(capture: Capture) -> list[Shot]:
    return [shot for shot in shots_of(capture) if shot.held_out]


@pytest.mark.parametrize("views", [4, 6, 40])
def test_there_are_as_many_pictures_as_asked_for(views: int) -> None:
    capture = replace(PLAIN, views=views)
    assert (len(trained(capture)), len(held_out(capture))) == (views, capture.test_views)


def test_a_capture_is_always_the_same() -> None:
    capture = Capture(exposure=0.3, shift=0.1, turn=1.0)
    for one, other in zip(shots_of(capture), shots_of(capture)):
        assert one.gain == other.gain and np.array_equal(one.written, other.written)


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


def test_a_quarter_turn() -> None:
    turned = rotation(np.array([0.0, 0.0, np.pi / 2])) @ np.array([1.0, 0.0, 0.0])
    assert turned == pytest.approx([0.0, 1.0, 0.0])
    assert rotation(np.zeros(3)).tolist() == np.eye(3).tolist()


def test_the_origin_moves_what_is_written_and_nothing_else() -> None:
    capture = Capture(origin=(1e4, 0.0, -5.0))
    for shot in shots_of(capture):
        assert (shot.written - shot.pose)[:, 3] == pytest.approx([1e4, 0.0, -5.0])
