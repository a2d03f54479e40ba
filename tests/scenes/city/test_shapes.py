"""Painted land: the last stroke counts, and no wall or top is lost or doubled."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from leco_plugin.scenes.city.shapes import Canvas, Shapes

CELL = st.integers(1, 8)
STROKES = st.lists(st.tuples(CELL, CELL, CELL, CELL, st.integers(0, 5)), max_size=8)


def painted(strokes: list[tuple[int, int, int, int, int]]) -> tuple[Shapes, np.ndarray]:
    """The shapes of some strokes on a 12 x 10 canvas, and the heights of its unit cells."""
    canvas, heights = Canvas((0, 12, 0, 10), paint=0), np.zeros((12, 10))
    for number, (a, b, c, d, top) in enumerate(strokes):
        x0, x1, y0, y1 = min(a, b), max(a, b) + 1, min(c, d), max(c, d) + 1
        canvas.stroke((x0, x1, y0, y1), top, number + 1)
        heights[x0:x1, y0:y1] = top
    shapes = Shapes()
    canvas.build(shapes, depth=2.0)
    return shapes, heights


@settings(deadline=None)
@given(STROKES)
def test_columns_tops_and_walls_add_up_to_the_height_field(strokes: list) -> None:
    shapes, heights = painted(strokes)
    volume = sum(np.prod(high - low) for low, high in shapes.boxes)
    assert volume == (heights + 2).sum()
    sizes = np.array([np.ptp(face, axis=0) for face, _, _ in shapes.rectangles])
    areas = np.where(sizes == 0, 1, sizes).prod(1)
    level = sizes[:, 2] == 0
    assert areas[level].sum() == 240  # what lies on top, and the underside
    walls = np.abs(np.diff(heights, axis=0)).sum() + np.abs(np.diff(heights, axis=1)).sum()
    assert areas[~level].sum() == walls


def test_a_covered_stroke_leaves_its_top_to_a_roof() -> None:
    canvas, shapes = Canvas((0, 10, 0, 10), paint=0), Shapes()
    canvas.stroke((2, 5, 2, 6), 3.0, paint=1, covered=True)
    assert canvas.height(3, 3) == 3.0
    assert canvas.height(8, 8) == 0.0
    canvas.build(shapes, depth=1.0)
    upward = (face for face, direction, _ in shapes.rectangles if direction > 0)
    tops = (np.ptp(face, axis=0) for face in upward)
    assert sum(np.prod(size[:2]) for size in tops if size[2] == 0) == 100 - 12
