"""What a city is assembled from: shapes, a canvas of land, and the paints on both.

Everything is a flat-faced solid: columns of a height field, roofs, turned posts and trees, hanging
wires. Each shape adds two descriptions of itself to `Shapes`: convex pieces, which say whether a
point is inside, and the outward faces that touch air, for rays and distances. Faces that another
shape hides are left out, so the faces are exactly the boundary of the pieces.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Rectangle = tuple[float, float, float, float]
"""x0, x1, y0, y1 in metres."""
Colour = tuple[float, float, float]
"""RGB in 0..1."""


def square(half: float, x: float = 0.0, y: float = 0.0) -> Rectangle:
    """A square of twice that side around a place."""
    return x - half, x + half, y - half, y + half


def rounded(bounds: Rectangle) -> Rectangle:
    """A rectangle in whole centimetres, so that edges that meet are the same numbers."""
    x0, x1, y0, y1 = (round(float(value), 2) for value in bounds)
    return x0, x1, y0, y1


def dot(one: Array, other: Array) -> Array:
    """Products [N] of vectors [N, 3]."""
    return np.einsum("nk,nk->n", one, other)


@dataclass
class Shapes:
    """What has been built so far, in metres, +z up. `paint` numbers index the city's palette."""

    boxes: list[Array] = field(default_factory=list)
    """Solid axis-aligned boxes, each [2, 3]: low and high corner."""
    hulls: list[tuple[Array, Array]] = field(default_factory=list)
    """Other convex solids: corners [V, 3] and half-spaces [H, 4]; inside where n . x <= d."""
    rectangles: list[tuple[Array, int, int]] = field(default_factory=list)
    """Axis-aligned faces: corners [2, 3], direction (+1 or -1 along the flat axis), paint."""
    triangles: list[tuple[Array, int]] = field(default_factory=list)
    """Other faces: [T, 3, 3], counter-clockwise seen from the air, and their paint."""

    def add_hull(self, corners: Array, faces: list[list[int]]) -> None:
        """Adds a convex solid given by its corners [V, 3] and planar faces (any winding)."""
        first, second, third = np.moveaxis(corners[[face[:3] for face in faces]], 1, 0)
        normals = np.cross(second - first, third - first)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        offsets = dot(normals, first)
        flip = np.where(normals @ corners.mean(0) > offsets, -1.0, 1.0)
        self.hulls.append((corners, np.column_stack([normals, offsets]) * flip[:, None]))

    def add_polygon(self, polygon: Array, paint: int) -> None:
        """Adds a convex planar face [V, 3], counter-clockwise seen from the air."""
        first = np.broadcast_to(polygon[0], (len(polygon) - 2, 3))
        self.triangles.append((np.stack([first, polygon[1:-1], polygon[2:]], 1), paint))

    def add_between(
        self,
        first: Array,
        second: Array,
        paint: int,
        open_sides: list[bool] | None = None,
        shared: int = 0,
    ) -> None:
        """Adds the convex solid between two rings [V, 3], counter-clockwise where the first is seen
        from outside, and those sides from corner i to i + 1 that are open to the air (None: all).
        Both triangles of a side have its corner `shared`, counted from the first ring."""
        count = len(first)
        corners = np.concatenate([first, second])
        sides = [[i, count + i, count + (i + 1) % count, (i + 1) % count] for i in range(count)]
        for side, is_open in zip(sides, open_sides or count * [True]):
            if is_open:
                self.add_polygon(corners[np.roll(side, -shared)], paint)
        self.add_hull(corners, [*sides, list(range(count)), list(range(count, 2 * count))])


def add_roof(
    shapes: Shapes,
    bounds: Rectangle,
    base: float,
    rise: float,
    hip: float,
    paint: int,
    gable: int,
) -> None:
    """Adds a pitched roof on a rectangle, its ridge along the longer side; the ridge's ends stand
    back by `hip` metres: 0 gives upright gables, painted `gable`."""
    x0, x1, y0, y1 = rounded(bounds)
    along_x = x1 - x0 >= y1 - y0
    base, top = round(float(base), 2), round(float(base + rise), 2)
    if along_x:
        ridge = [[x0 + hip, (y0 + y1) / 2, top], [x1 - hip, (y0 + y1) / 2, top]]
        slopes, ends = [[0, 1, 5, 4], [2, 3, 4, 5]], [[1, 2, 5], [3, 0, 4]]
    else:
        ridge = [[(x0 + x1) / 2, y1 - hip, top], [(x0 + x1) / 2, y0 + hip, top]]
        slopes, ends = [[1, 2, 4, 5], [3, 0, 5, 4]], [[2, 3, 4], [0, 1, 5]]
    corners = np.array([[x0, y0, base], [x1, y0, base], [x1, y1, base], [x0, y1, base], *ridge])
    for face in slopes:
        shapes.add_polygon(corners[face], paint)
    for face in ends:
        shapes.add_polygon(corners[face], gable if hip == 0 else paint)
    shapes.add_hull(corners, [*slopes, *ends, [0, 1, 2, 3]])


def add_wire(shapes: Shapes, path: Array, radius: float, paint: int) -> None:
    """Hangs a wire of four sides along `path` [V, 3], straight in plan; `radius` in metres. Its
    rings stand upright across the path, so that neighbouring pieces share a whole face."""
    along = (path[-1] - path[0]) * [1, 1, 0]
    across = np.cross(along / np.linalg.norm(along), [0.0, 0.0, 1.0])
    turn = 2 * np.pi * np.arange(4) / 4
    ring = radius * (np.cos(turn)[:, None] * across + np.sin(turn)[:, None] * [0.0, 0.0, 1.0])
    for a, b in pairwise(path):
        shapes.add_between(a + ring, b + ring, paint)
    shapes.add_polygon(path[0] + ring, paint)
    shapes.add_polygon((path[-1] + ring)[::-1], paint)


def add_prism(
    shapes: Shapes, top: Array, bottom: float, paint: int, open_sides: list[bool], side: int
) -> None:
    """Adds a solid under a convex polygon [V, 3] (counter-clockwise from above) down to z = bottom;
    those walls of `open_sides`, as of `Shapes.add_between`, are painted `side`."""
    below = np.column_stack([top[:, :2], np.full(len(top), bottom)])
    shapes.add_polygon(top, paint)
    shapes.add_polygon(below[::-1], side)
    shapes.add_between(top, below, side, open_sides)


class Stroke(NamedTuple):
    """A rectangle of land at one height."""

    bounds: Rectangle
    top: float
    """Metres."""
    paint: int
    covered: bool
    """Whether its top is left to a roof."""


@dataclass
class Canvas:
    """Land whose height is painted: later strokes replace earlier ones. It is at height 0 along the
    border, so that canvases join without a wall."""

    bounds: Rectangle
    paint: int
    strokes: list[Stroke] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.bounds = rounded(self.bounds)

    def stroke(self, bounds: Rectangle, top: float, paint: int, covered: bool = False) -> None:
        """Raises or lowers a rectangle; arguments as of `Stroke`."""
        self.strokes.append(Stroke(rounded(bounds), round(float(top), 2), paint, covered))

    def height(self, x: float, y: float) -> float:
        """The painted height at a point, in metres."""
        for (x0, x1, y0, y1), top, _, _ in reversed(self.strokes):
            if x0 <= x <= x1 and y0 <= y <= y1:
                return top
        return 0.0

    def build(self, shapes: Shapes, depth: float) -> None:
        """Turns the strokes into columns standing `depth` metres deep, their tops and walls."""
        ends = np.array([self.bounds, *(stroke.bounds for stroke in self.strokes)])
        xs, ys = np.unique(ends[:, :2]), np.unique(ends[:, 2:])
        height = np.zeros((len(xs) - 1, len(ys) - 1))
        paint = np.full(height.shape, self.paint)
        covered = np.zeros(height.shape, bool)
        for (x0, x1, y0, y1), top, number, hidden in self.strokes:
            i0, i1 = np.searchsorted(xs, [x0, x1])
            j0, j1 = np.searchsorted(ys, [y0, y1])
            cells = np.s_[i0:i1, j0:j1]
            height[cells], paint[cells], covered[cells] = top, number, hidden

        for i0, i1, j0, j1 in _equal_rectangles(height, paint, covered):
            top = height[i0, j0]
            low, high = [xs[i0], ys[j0]], [xs[i1], ys[j1], top]
            shapes.boxes.append(np.array([[*low, -depth], high]))
            if not covered[i0, j0]:
                shapes.rectangles.append((np.array([[*low, top], high]), 1, int(paint[i0, j0])))
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


STOREY = 3.2
"""Height of a storey in metres: of the walls and of the windows painted on them."""


class Material(IntEnum):
    """How a face is coloured; `render.paint_surface` gives each its pattern."""

    STREET, PAVEMENT, WALL, ROOF, TILES, GRASS, EARTH, LEAVES, METAL, TERRAIN = range(10)


class Palette(list[tuple[Material, Colour, Colour, tuple[float, float]]]):
    """The paints of a city, each with its material, base colour, anchor and window pitch."""

    def add(
        self,
        material: Material,
        colour: Colour,
        anchor: tuple[float, float, float] = (0.0, 0.0, 0.0),
        pitch: tuple[float, float] = (3.0, 3.0),
    ) -> int:
        """The number of a new paint: its pattern begins at `anchor`, windows are `pitch` apart."""
        self.append((material, colour, anchor, pitch))
        return len(self) - 1


WALLS = [
    (0.80, 0.74, 0.63),
    (0.67, 0.37, 0.29),
    (0.74, 0.72, 0.70),
    (0.86, 0.80, 0.55),
    (0.52, 0.59, 0.66),
    (0.79, 0.56, 0.42),
    (0.90, 0.88, 0.84),
    (0.45, 0.33, 0.29),
    (0.58, 0.66, 0.57),
]
FLAT_ROOFS = [
    (0.55, 0.54, 0.52),
    (0.42, 0.42, 0.44),
    (0.66, 0.62, 0.56),
    (0.50, 0.46, 0.42),
    (0.47, 0.53, 0.49),
]
TILES = [
    (0.66, 0.30, 0.20),
    (0.52, 0.25, 0.20),
    (0.37, 0.34, 0.35),
    (0.72, 0.42, 0.28),
    (0.30, 0.36, 0.42),
]
CARS = [
    (0.75, 0.10, 0.10),
    (0.90, 0.90, 0.92),
    (0.12, 0.14, 0.17),
    (0.15, 0.30, 0.62),
    (0.60, 0.62, 0.65),
    (0.88, 0.68, 0.10),
]
LEAVES = [(0.20, 0.38, 0.14), (0.30, 0.44, 0.16), (0.40, 0.46, 0.18), (0.16, 0.32, 0.18)]
