"""Land as a height field that is painted: ground, kerbs, walls, flat roofs, courts, cars.

What a painter covers is gone, so no face is ever hidden behind another and none has to be cut.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from leco_plugin.scenes.city.shapes import Array, Shapes


@dataclass
class Canvas:
    """A rectangle of land whose height is painted: later strokes replace earlier ones.

    The land is at height 0 along the canvas' border, so that canvases join without a wall.
    """

    bounds: tuple[float, float, float, float]
    """x0, x1, y0, y1 in metres."""
    paint: int
    strokes: list[tuple[float, float, float, float, float, int, bool]] = field(default_factory=list)

    def stroke(
        self,
        x0: float,
        x1: float,
        y0: float,
        y1: float,
        top: float,
        paint: int,
        covered: bool = False,
    ) -> None:
        """Raises or lowers a rectangle to `top` metres; `covered` leaves its top to a roof."""
        x0, x1, y0, y1, top = (round(float(v), 2) for v in (x0, x1, y0, y1, top))
        self.strokes.append((x0, x1, y0, y1, top, paint, covered))

    def height(self, x: float, y: float) -> float:
        """The painted height at a point, in metres."""
        for x0, x1, y0, y1, top, _, _ in reversed(self.strokes):
            if x0 <= x <= x1 and y0 <= y <= y1:
                return top
        return 0.0

    def build(self, shapes: Shapes, depth: float) -> None:
        """Turns the strokes into columns standing `depth` metres deep, their tops and walls."""
        ends = np.array([self.bounds] + [s[:4] for s in self.strokes])
        xs, ys = np.unique(ends[:, :2]), np.unique(ends[:, 2:])
        height = np.zeros((len(xs) - 1, len(ys) - 1))
        paint = np.full(height.shape, self.paint)
        covered = np.zeros(height.shape, bool)
        for x0, x1, y0, y1, top, number, hidden in self.strokes:
            cells = np.s_[
                np.searchsorted(xs, x0) : np.searchsorted(xs, x1),
                np.searchsorted(ys, y0) : np.searchsorted(ys, y1),
            ]
            height[cells], paint[cells], covered[cells] = top, number, hidden

        for i0, i1, j0, j1 in _equal_rectangles(height, paint, covered):
            low, high = (
                np.array([xs[i0], ys[j0], -depth]),
                np.array([xs[i1], ys[j1], height[i0, j0]]),
            )
            shapes.boxes.append(np.stack([low, high]))
            if not covered[i0, j0]:
                face = np.stack([[low[0], low[1], high[2]], high])
                shapes.rectangles.append((face, 1, int(paint[i0, j0])))
        _walls(shapes, xs, ys, height, paint, flip=False)
        _walls(shapes, ys, xs, height.T, paint.T, flip=True)
        x0, x1, y0, y1 = self.bounds
        shapes.rectangles.append((np.array([[x0, y0, -depth], [x1, y1, -depth]]), -1, self.paint))


def _equal_rectangles(*layers: NDArray) -> list[tuple[int, int, int, int]]:
    """Covers a grid with few rectangles of cells that agree in all layers [I, J]."""
    _, label = np.unique(np.stack([layer.ravel() for layer in layers]), axis=1, return_inverse=True)
    label = label.reshape(layers[0].shape)
    done: list[tuple[int, int, int, int]] = []
    open_runs: dict[tuple[int, int, int], int] = {}
    for i in range(len(label) + 1):
        runs: dict[tuple[int, int, int], int] = {}
        if i < len(label):
            cuts = [0, *(np.flatnonzero(np.diff(label[i])) + 1), label.shape[1]]
            for j0, j1 in pairwise(cuts):
                key = (int(j0), int(j1), int(label[i, j0]))
                runs[key] = open_runs.get(key, i)
        done += [(start, i, key[0], key[1]) for key, start in open_runs.items() if key not in runs]
        open_runs = runs
    return done


def _walls(shapes: Shapes, us: Array, vs: Array, height: Array, paint: NDArray, flip: bool) -> None:
    """Adds the walls between neighbouring cells along the first axis of `height` [U, V]."""
    for i in range(1, len(height)):
        before, after = height[i - 1], height[i]
        owner = np.where(before > after, paint[i - 1], paint[i])
        changes = (np.diff(before) != 0) | (np.diff(after) != 0) | (np.diff(owner) != 0)
        cuts = [0, *(np.flatnonzero(changes) + 1), len(before)]
        for j0, j1 in pairwise(cuts):
            if before[j0] == after[j0]:
                continue
            bottom, top = sorted((before[j0], after[j0]))
            low, high = np.array([us[i], vs[j0], bottom]), np.array([us[i], vs[j1], top])
            if flip:
                low, high = low[[1, 0, 2]], high[[1, 0, 2]]
            direction = 1 if before[j0] > after[j0] else -1
            shapes.rectangles.append((np.stack([low, high]), direction, int(owner[j0])))
