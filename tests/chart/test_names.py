"""Claims about where the names of points stand."""

from __future__ import annotations

from itertools import combinations
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.figure import Figure

from leco_plugin.chart.drawing.names import HALF_HEIGHT, NAME_WIDTH, Box, name_points


def panel() -> Any:
    axes = Figure().add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0.0, 1.0), ylim=(0.0, 1.0))
    return axes


def boxes_of(axes: Any) -> list[Box]:
    """What the names in a panel cover."""
    found = []
    for text in axes.texts:
        (x, y), width = text.get_position(), NAME_WIDTH * len(text.get_text())
        left = x - width if text.get_horizontalalignment() == "right" else x
        found.append(Box(left, y - HALF_HEIGHT, left + width, y + HALF_HEIGHT))
    return found


@settings(deadline=None, max_examples=50)
@given(st.lists(st.tuples(*[st.floats(0.05, 0.95)] * 2), min_size=2, max_size=6))
def test_names_of_points_lie_in_the_panel_and_not_on_one_another(
    places: list[tuple[float, float]],
) -> None:
    axes = panel()
    names = [f"the name {i}" for i in range(len(places))]
    name_points(axes, places, names, ["black"] * len(places))
    boxes = boxes_of(axes)
    assert [text.get_text() for text in axes.texts] == names
    for box in boxes:
        assert min(box.left, box.low) > -1e-9 and max(box.right, box.high) < 1.0 + 1e-9
    assert all(one.covers(other) < 1e-9 for one, other in combinations(boxes, 2))


def test_long_names_at_one_edge_are_read_one_above_the_other() -> None:
    axes = panel()
    names = ["paper: imbalance and density", "paper without density loss", "as in Switch-NeRF"]
    others = [(0.03, 0.3), (0.07, 0.12), (0.87, 0.27)]
    name_points(axes, [(0.02, 0.12), (0.02, 0.12), (0.03, 0.12)], names, ["red"] * 3, others)
    assert all(one.covers(other) < 1e-9 for one, other in combinations(boxes_of(axes), 2))


@pytest.mark.parametrize(("places", "lines"), [([(0.5, 0.5)], 0), ([(0.5, 0.5)] * 30, 20)])
def test_a_name_far_from_its_point_has_a_line_to_it(
    places: list[tuple[float, float]], lines: int
) -> None:
    axes = panel()
    name_points(axes, places, ["name"] * len(places), ["red"] * len(places))
    assert sum(text.arrow_patch is not None for text in axes.texts) >= lines
