"""Claims about what is seen in a stage."""

from __future__ import annotations

import numpy as np
import pytest

from leco_plugin.stability.matter import Box, Paint
from leco_plugin.stability.stage import Fog, Pane, Stage, look

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
