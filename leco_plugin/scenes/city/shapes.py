"""The surfaces and solids a city is assembled from, so that both describe the same matter.

Everything is a flat-faced solid: columns of a height field, roofs, turned posts and trees,
hanging wires. Each shape adds two descriptions of itself to `Shapes`: convex pieces (for "is
this point inside?") and the outward faces that touch air (for rays and distances). Faces that
another shape hides are left out, so the faces are exactly the boundary of the pieces.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from leco_plugin.scenes.city.canvas import Canvas

Array = NDArray[np.float64]


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
    feet: list[tuple[float, ...]] = field(default_factory=list)
    """Squares around the base of turned solids, as `squared_to_feet` takes them."""
    stretches: list[tuple[float, ...]] = field(default_factory=list)
    """Sides and lids of turned solids, as `squared_to_stretches` takes them."""
    facets: list[tuple[Array, int]] = field(default_factory=list)
    """The same feet and stretches as triangles, like `triangles`."""

    def add_hull(self, corners: Array, faces: list[list[int]]) -> None:
        """Adds a convex solid given by its corners [V, 3] and planar faces (any winding)."""
        first, second, third = np.moveaxis(corners[[face[:3] for face in faces]], 1, 0)
        normals = np.cross(second - first, third - first)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        offsets = np.einsum("hk,hk->h", normals, first)
        flip = np.where(normals @ corners.mean(0) > offsets, -1.0, 1.0)
        self.hulls.append((corners, np.column_stack([normals, offsets]) * flip[:, None]))

    def add_polygon(self, polygon: Array, paint: int) -> None:
        """Adds a convex planar face [V, 3], counter-clockwise seen from the air."""
        self.triangles.append((_fan(polygon), paint))


def add_roof(
    shapes: Shapes,
    bounds: tuple[float, float, float, float],
    base: float,
    rise: float,
    hip: float,
    paint: int,
    gable: int,
) -> None:
    """Adds a pitched roof on the rectangle x0, x1, y0, y1; the ridge follows its longer side.

    `hip` is how far (metres) the ridge's ends stand back: 0 gives upright gables, painted `gable`.
    """
    x0, x1, y0, y1 = (round(float(v), 2) for v in bounds)
    along_x = x1 - x0 >= y1 - y0
    base, top = round(float(base), 2), round(float(base + rise), 2)
    if along_x:
        ridge = [[x0 + hip, (y0 + y1) / 2, top], [x1 - hip, (y0 + y1) / 2, top]]
    else:
        ridge = [[(x0 + x1) / 2, y1 - hip, top], [(x0 + x1) / 2, y0 + hip, top]]
    corners = np.array([[x0, y0, base], [x1, y0, base], [x1, y1, base], [x0, y1, base], *ridge])
    if along_x:
        slopes, ends = [[0, 1, 5, 4], [2, 3, 4, 5]], [[1, 2, 5], [3, 0, 4]]
    else:
        slopes, ends = [[1, 2, 4, 5], [3, 0, 5, 4]], [[2, 3, 4], [0, 1, 5]]
    for face in slopes:
        shapes.add_polygon(corners[face], paint)
    for face in ends:
        shapes.add_polygon(corners[face], gable if hip == 0 else paint)
    shapes.add_hull(corners, [*slopes, *ends, [0, 1, 2, 3]])


def add_turned(
    shapes: Shapes,
    canvas: Canvas,
    x: float,
    y: float,
    profile: list[tuple[float, float, int]],
    foot: int,
    sides: int = 8,
) -> None:
    """Stands a turned solid (pole, tree, tank) on the canvas at x, y, on a low square foot.

    `profile` lists radius and height above the foot in metres, from the foot up, with the paint
    of the stretch that ends there; `sides` is a multiple of 4. The foot keeps the hidden face
    under the solid simple: a square without a regular polygon.
    """
    reach = round(profile[0][0] + 0.12, 2)
    x, y = round(float(x), 2), round(float(y), 2)
    base = round(canvas.height(x, y) + 0.12, 2)
    canvas.stroke(x - reach, x + reach, y - reach, y + reach, base, foot, covered=True)
    turn = 2 * np.pi * np.arange(sides) / sides
    circle = np.stack([np.cos(turn), np.sin(turn)], 1)

    def ring(radius: float, z: float) -> Array:
        return np.column_stack(
            [x + radius * circle[:, 0], y + radius * circle[:, 1], np.full(sides, base + z)]
        )

    x0, x1, y0, y1 = (round(v, 2) for v in (x - reach, x + reach, y - reach, y + reach))
    corners = np.array([[x1, y1, base], [x0, y1, base], [x0, y0, base], [x1, y0, base]])
    lower, quarter = ring(profile[0][0], profile[0][1]), sides // 4
    for k in range(4):
        arc = np.arange(k * quarter, (k + 1) * quarter + 1) % sides
        for a, b in pairwise(arc):
            shapes.facets.append((np.stack([lower[b], lower[a], corners[k]])[None], foot))
        shapes.facets.append(
            (np.stack([lower[arc[-1]], corners[k], corners[(k + 1) % 4]])[None], foot)
        )
    shapes.feet.append((x, y, sides, base, profile[0][0], reach))

    walls = [[i, (i + 1) % sides, sides + (i + 1) % sides, sides + i] for i in range(sides)]
    caps = [list(range(sides)), list(range(sides, 2 * sides))]
    for (below, start, _), (radius, z, paint) in pairwise(profile):
        upper = ring(radius, z)
        corners = np.concatenate([lower, upper])
        shapes.facets += [(_fan(corners[wall]), paint) for wall in walls]
        shapes.stretches.append((x, y, sides, base + start, below, base + z, radius))
        shapes.add_hull(corners, [*walls, *caps])
        lower = upper
    radius, z, paint = profile[-1]
    shapes.facets.append((_fan(lower), paint))
    shapes.stretches.append((x, y, sides, base + z, radius, base + z, 0.0))


def add_wire(shapes: Shapes, path: Array, radius: float, paint: int, sides: int = 4) -> None:
    """Hangs a wire along `path` [V, 3], which runs straight in plan; `radius` in metres.

    The rings stand upright across the path, so neighbouring pieces share a whole face.
    """
    along = (path[-1] - path[0]) * [1, 1, 0]
    across = np.cross(along / np.linalg.norm(along), [0.0, 0.0, 1.0])
    turn = 2 * np.pi * np.arange(sides) / sides
    ring = radius * (np.cos(turn)[:, None] * across + np.sin(turn)[:, None] * [0.0, 0.0, 1.0])
    faces = [[i, sides + i, sides + (i + 1) % sides, (i + 1) % sides] for i in range(sides)]
    caps = [list(range(sides)), list(range(sides, 2 * sides))]
    for a, b in pairwise(path):
        corners = np.concatenate([a + ring, b + ring])
        for face in faces:
            shapes.add_polygon(corners[face], paint)
        shapes.add_hull(corners, [*faces, *caps])
    shapes.add_polygon((path[0] + ring), paint)
    shapes.add_polygon((path[-1] + ring)[::-1], paint)


def add_prism(
    shapes: Shapes, top: Array, bottom: float, paint: int, open_sides: list[bool], side: int
) -> None:
    """Adds a solid under a convex polygon [V, 3] (counter-clockwise from above) down to z = bottom.

    `open_sides[i]` says whether the wall from corner i to i + 1 touches air (painted `side`).
    """
    count = len(top)
    below = np.column_stack([top[:, :2], np.full(count, bottom)])
    corners = np.concatenate([top, below])
    walls = [[i, count + i, count + (i + 1) % count, (i + 1) % count] for i in range(count)]
    shapes.add_polygon(top, paint)
    shapes.add_polygon(below[::-1], side)
    for wall, is_open in zip(walls, open_sides):
        if is_open:
            shapes.add_polygon(corners[wall], side)
    shapes.add_hull(corners, [*walls, list(range(count)), list(range(count, 2 * count))])


def _fan(polygon: Array) -> Array:
    """A convex polygon [V, 3] as triangles [V - 2, 3, 3] of the same winding."""
    first = np.broadcast_to(polygon[0], (len(polygon) - 2, 3))
    return np.stack([first, polygon[1:-1], polygon[2:]], 1)
