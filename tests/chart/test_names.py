"""Claims about where the names of points stand."""

from __future__ import annotations

from itertools import combinations
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text

from leco_plugin.chart.drawing.names import Box, name_points, size_of


def panel() -> Any:
    figure = Figure(figsize=(9, 3))
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0.0, 1.0), ylim=(0.0, 1.0))
    return axes


def boxes_of(axes: Any) -> list[Box]:
    """What the names in a panel cover, as they are drawn."""
    axes.figure.canvas.draw()  # only then an annotation knows its place
    in_axes = axes.transAxes.inverted()
    extents = [Text.get_window_extent(text).transformed(in_axes) for text in axes.texts]
    return [Box(*extent.extents) for extent in extents]


@settings(deadline=None, max_examples=25)
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


def test_the_line_to_a_name_crosses_no_other_name() -> None:
    axes = panel()
    points = [(0.02, 0.12), (0.02, 0.12), (0.03, 0.12)]
    name_points(axes, points, ["the first", "the second", "the third"], ["red"] * 3)
    for text, box in zip(axes.texts, boxes_of(axes)):
        end = text.get_position()
        for other in boxes_of(axes):
            on_the_way = [
                Box(x - 1e-3, y - 1e-3, x + 1e-3, y + 1e-3)
                for t in (0.3, 0.5, 0.7, 0.9)
                for x, y in [(text.xy[0] * (1 - t) + end[0] * t, text.xy[1] * (1 - t) + end[1] * t)]
            ]
            assert other == box or not any(other.covers(dot) for dot in on_the_way)


def test_a_name_is_as_wide_as_it_is_drawn() -> None:
    axes = panel()
    name_points(axes, [(0.5, 0.5)], ["wwww iiii"], ["red"])
    (box,) = boxes_of(axes)
    assert box.right - box.left == pytest.approx(size_of(axes, "wwww iiii")[0], rel=0.02)


@pytest.mark.parametrize(("places", "lines"), [([(0.5, 0.5)], 0), ([(0.5, 0.5)] * 30, 15)])
def test_a_name_far_from_its_point_has_a_line_to_it(
    places: list[tuple[float, float]], lines: int
) -> None:
    axes = panel()
    name_points(axes, places, ["name"] * len(places), ["red"] * len(places))
    assert sum(text.arrow_patch is not None for text in axes.texts) >= lines
