"""Claims about where the names of points stand."""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text

from leco_plugin.chart.picture import Boxes, covered, name_points, spread


def panel() -> Any:
    figure = Figure(figsize=(9, 3))
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0.0, 1.0), ylim=(0.0, 1.0))
    return axes


def boxes_of(axes: Any) -> Boxes:
    """[N, 4] what the names in a panel cover, as they are drawn."""
    axes.figure.canvas.draw()  # only then an annotation knows its place
    in_axes = axes.transAxes.inverted()
    extents = [Text.get_window_extent(text).transformed(in_axes) for text in axes.texts]
    return np.array([extent.extents for extent in extents])


@settings(deadline=None, max_examples=25)
@given(st.lists(st.tuples(*[st.floats(0.05, 0.95)] * 2), min_size=2, max_size=6))
def test_names_of_points_do_not_overlap(places: list[tuple[float, float]]) -> None:
    axes = panel()
    names = [f"the name {i}" for i in range(len(places))]
    name_points(axes, places, names, ["black"] * len(places))
    boxes = boxes_of(axes)
    assert [text.get_text() for text in axes.texts] == names
    assert boxes.min() > -1e-9 and boxes.max() < 1.0 + 1e-9
    assert no_two_overlap(boxes)


def no_two_overlap(boxes: Boxes) -> bool:
    return all(covered(boxes[i : i + 1], boxes[i + 1 :]) < 1e-9 for i in range(len(boxes)))


def test_long_names_at_one_edge_are_read_one_above_the_other() -> None:
    axes = panel()
    names = ["paper: imbalance and density", "paper without density loss", "as in Switch-NeRF"]
    others = [(0.03, 0.3), (0.07, 0.12), (0.87, 0.27)]
    name_points(axes, [(0.02, 0.12), (0.02, 0.12), (0.03, 0.12)], names, ["red"] * 3, others)
    assert no_two_overlap(boxes_of(axes))


def test_names_at_the_ends_of_curves_keep_apart_and_in_order() -> None:
    places = spread([0.5, 0.5, 0.51, 0.99, 0.98], 0.06)
    assert sorted(range(5), key=lambda i: places[i]) == [0, 1, 2, 4, 3]
    assert np.diff(sorted(places)).min() >= 0.06 - 1e-9
    assert max(places) <= 1.0


@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=12))
def test_names_with_room_enough_never_leave_the_panel(wanted: list[float]) -> None:
    places = spread(wanted, 0.056)
    assert min(places) >= -1e-9 and max(places) <= 1.0 + 1e-9


def test_names_that_are_far_apart_stay_where_they_are() -> None:
    assert spread([0.9, 0.1, 0.5], 0.05) == [0.9, 0.1, 0.5]
