"""Exact queries on all shapes of a city at once: what holds this point, what is nearest to it.

Points are halved along their longest side until few shapes can matter to a group of them. The group
is then computed outright. There is no grid to size: memory is bounded by `_PAIRS`, and points that
lie close together share the search.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from leco_plugin.scenes.city.shapes import Array, Shapes

Indices = NDArray[np.int64]
_PAIRS = 1 << 15
"""Pairs of point and shape computed at once: small enough for the cache, large enough for numpy."""


def _groups(
    points: Array, shapes: int, prune: Callable[[Array, Array, Indices], Indices]
) -> Iterator[tuple[Indices, Indices]]:
    """Splits points [N, 3] into groups; yields their indices and those of the shapes that matter.

    `prune(low, high, candidates)` keeps the shapes that matter to some point of a box.
    """
    stack = [(np.arange(len(points)), np.arange(shapes))] if len(points) else []
    while stack:
        group, candidates = stack.pop()
        low, high = points[group].min(0), points[group].max(0)
        candidates = prune(low, high, candidates)
        if len(group) == 1 or len(group) * len(candidates) <= _PAIRS:
            yield group, candidates
            continue
        half = len(group) // 2
        order = np.argpartition(points[group, np.argmax(high - low)], half)
        stack += [(group[order[:half]], candidates), (group[order[half:]], candidates)]


class Solids:
    """The matter of some shapes: axis-aligned boxes and convex hulls."""

    def __init__(self, shapes: Shapes) -> None:
        self.boxes = len(shapes.boxes)
        corners = [[corners.min(0), corners.max(0)] for corners, _ in shapes.hulls]
        self.bounds = np.concatenate([np.array(shapes.boxes), np.array(corners).reshape(-1, 2, 3)])
        most = max((len(planes) for _, planes in shapes.hulls), default=0)
        self.planes = np.zeros((len(shapes.hulls), most, 4))
        """Half-spaces n . x <= d of each hull; unused rows are 0 . x <= 0."""
        for padded, (_, planes) in zip(self.planes, shapes.hulls, strict=True):
            padded[: len(planes)] = planes

    def contain(self, points: Array) -> NDArray[np.bool_]:
        """Whether each of points [N, 3] lies in some solid (borders included): bool [N]."""
        inside = np.zeros(len(points), bool)
        for group, candidates in _groups(points, len(self.bounds), self._touching):
            here, bounds = points[group], self.bounds[candidates]
            within = np.ones((len(group), len(candidates)), bool)
            for axis in range(3):
                column = here[:, axis, None]
                within &= (bounds[:, 0, axis] <= column) & (column <= bounds[:, 1, axis])
            # The bounds of a box are the box; only the hulls need their planes.
            hulls = candidates >= self.boxes
            inside[group] = within[:, ~hulls].any(1)
            rows, columns = np.nonzero(within & hulls)
            planes = self.planes[candidates[columns] - self.boxes]
            beyond = np.einsum("phk,pk->ph", planes[..., :3], here[rows]) - planes[..., 3]
            inside[group[rows[(beyond <= 1e-9).all(1)]]] = True
        return inside

    def _touching(self, low: Array, high: Array, candidates: Indices) -> Indices:
        bounds = self.bounds[candidates]
        return candidates[((bounds[:, 0] <= high) & (bounds[:, 1] >= low)).all(1)]


class Faces:
    """The surface of some shapes: rectangles, then triangles.

    Args:
        rectangles: [R, 2, 3] low and high corners of axis-aligned ones.
        triangles: [T, 3, 3].
    """

    def __init__(self, rectangles: Array, triangles: Array) -> None:
        self.first, self.triangles = len(rectangles), triangles
        boxes = np.stack([triangles.min(1), triangles.max(1)], 1)
        self.bounds = np.concatenate([rectangles, boxes])

    def distance(self, points: Array) -> Array:
        """Distance in metres from each of points [N, 3] to the nearest face: [N]."""
        nearest = np.empty(len(points))
        for group, candidates in _groups(points, len(self.bounds), self._reachable):
            nearest[group] = self._nearest(points[group], candidates)
        return np.sqrt(nearest)

    def _reachable(self, low: Array, high: Array, candidates: Indices) -> Indices:
        """Faces that can be nearest to some point of the box low..high.

        Seen from its middle, a rectangle is as far as its bounds, and any other face is at least
        that far and no farther than their farthest corner.
        """
        middle, radius = (low + high) / 2, np.linalg.norm(high - low) / 2
        bounds = self.bounds[candidates]
        least = np.maximum(np.maximum(bounds[:, 0] - middle, middle - bounds[:, 1]), 0)
        least = np.sqrt(np.einsum("fk,fk->f", least, least))
        first = np.searchsorted(candidates, self.first)
        most = np.maximum(bounds[first:, 1] - middle, middle - bounds[first:, 0])
        reach = np.sqrt(np.einsum("fk,fk->f", most, most).min(initial=np.inf))
        reach = min(reach, least[:first].min(initial=np.inf)) + 2 * radius
        return candidates[least <= reach * (1 + 1e-9)]

    def _nearest(self, points: Array, candidates: Indices) -> Array:
        """Squared distance [N] from each of points [N, 3] to the nearest of `candidates`.

        The bounds give a rectangle's distance and a lower limit of the others'; only faces whose
        limit undercuts what is known already are measured.
        """
        limits = np.zeros((len(points), len(candidates)))
        for axis in range(3):
            column, bounds = points[:, axis, None], self.bounds[candidates, :, axis]
            gap = np.maximum(bounds[:, 0] - column, column - bounds[:, 1])
            limits += np.square(np.maximum(gap, 0, out=gap), out=gap)
        first = int(np.searchsorted(candidates, self.first))
        nearest = limits[:, :first].min(1, initial=np.inf)
        if first == len(candidates):
            return nearest
        limits, others = limits[:, first:], candidates[first:]
        nearest = np.minimum(nearest, self._measure(points, others[limits.argmin(1)]))
        rows, columns = np.nonzero(limits < nearest[:, None])
        if len(rows):
            starts = np.flatnonzero(np.diff(rows, prepend=-1))
            found = self._measure(points[rows], others[columns])
            touched = rows[starts]
            nearest[touched] = np.minimum(nearest[touched], np.minimum.reduceat(found, starts))
        return nearest

    def _measure(self, points: Array, face: Indices) -> Array:
        """Squared distance [M] from points [M, 3] to a triangle each, numbered by `face` [M]."""
        return squared_to_triangles(points, self.triangles[face - self.first])


def squared_to_triangles(points: Array, triangles: Array) -> Array:
    """Squared distances [M] from points [M, 3] to triangles [M, 3, 3].

    Over a triangle's inside the height above its plane counts, elsewhere the nearest edge.
    """
    start, away = triangles[:, 0], points - triangles[:, 0]
    u, v = triangles[:, 1] - start, triangles[:, 2] - start
    uu, uv, vv = _dot(u, u), _dot(u, v), _dot(v, v)
    pu, pv = _dot(away, u), _dot(away, v)
    area = uu * vv - uv**2
    b, c = (vv * pu - uv * pv) / area, (uu * pv - uv * pu) / area
    over = (b >= 0) & (c >= 0) & (b + c <= 1)
    height = away - b[:, None] * u - c[:, None] * v
    squared = np.where(over, _dot(height, height), np.inf)
    third, from_second = v - u, away - u
    for offset, edge, along in (
        (away, u, pu / uu),
        (away, v, pv / vv),
        (from_second, third, _dot(from_second, third) / _dot(third, third)),
    ):
        rest = offset - np.clip(along, 0, 1)[:, None] * edge
        squared = np.minimum(squared, _dot(rest, rest))
    return squared


def _dot(a: Array, b: Array) -> Array:
    """Scalar products of rows: [M, 3], [M, 3] -> [M]."""
    return np.einsum("mk,mk->m", a, b)
