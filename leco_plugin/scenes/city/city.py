"""The procedural city: one configuration, one exact geometry, and the questions asked of it.

Positions are in metres, +z up, the ground at z = 0, the city centred on the origin. Queried points
are halved along their longest side until few shapes can matter to a group of them. The group is
then computed outright: memory is bounded by `_PAIRS`, and close points share the search.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leco_plugin.scenes.city.plan import centres, choose_blocks, plan_city
from leco_plugin.scenes.city.shapes import Array, Shapes, dot
from leco_plugin.scenes.input_error import one_line

Indices = NDArray[np.int64]
_PAIRS = 1 << 15
"""Pairs of point and shape computed at once: small enough for the cache, large enough for numpy."""


def _groups(
    points: Array, shapes: int, prune: Callable[[Array, Array, Indices], Indices]
) -> Iterator[tuple[Indices, Indices]]:
    """Indices of groups of points [N, 3], and of the shapes that `prune` keeps for their boxes."""
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
    """Axis-aligned rectangles [R, 2, 3], low and high corners, then triangles [T, 3, 3]."""

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
        """Faces that can be nearest to a point of the box low..high: a rectangle is as far as its
        bounds, any other face as far at least, and no farther than their farthest corner."""
        middle, radius = (low + high) / 2, np.linalg.norm(high - low) / 2
        bounds = self.bounds[candidates]
        least = np.maximum(np.maximum(bounds[:, 0] - middle, middle - bounds[:, 1]), 0)
        least = np.sqrt(dot(least, least))
        first = np.searchsorted(candidates, self.first)
        most = np.maximum(bounds[first:, 1] - middle, middle - bounds[first:, 0])
        reach = np.sqrt(dot(most, most).min(initial=np.inf))
        reach = min(reach, least[:first].min(initial=np.inf)) + 2 * radius
        return candidates[least <= reach * (1 + 1e-9)]

    def _nearest(self, points: Array, candidates: Indices) -> Array:
        """Squared distance [N] from points [N, 3] to the nearest of `candidates`. Triangles are
        measured only where their bounds are nearer than what is known already."""
        limits = np.zeros((len(points), len(candidates)))
        for axis in range(3):
            column, bounds = points[:, axis, None], self.bounds[candidates, :, axis]
            gap = np.maximum(bounds[:, 0] - column, column - bounds[:, 1])
            limits += np.square(np.maximum(gap, 0, out=gap), out=gap)
        first = int(np.searchsorted(candidates, self.first))
        nearest = limits[:, :first].min(1, initial=np.inf)
        if first == len(candidates):
            return nearest
        limits, others = limits[:, first:], self.triangles[candidates[first:] - self.first]
        nearest = np.minimum(nearest, squared_to_triangles(points, others[limits.argmin(1)]))
        rows, columns = np.nonzero(limits < nearest[:, None])
        np.minimum.at(nearest, rows, squared_to_triangles(points[rows], others[columns]))
        return nearest


def squared_to_triangles(points: Array, triangles: Array) -> Array:
    """Squared distances [M] from points [M, 3] to triangles [M, 3, 3]. A machine that has torch
    alone, as of the GPU suite, lacks trimesh, which could do this."""
    start, away = triangles[:, 0], points - triangles[:, 0]
    u, v = triangles[:, 1] - start, triangles[:, 2] - start
    uu, uv, vv = dot(u, u), dot(u, v), dot(v, v)
    pu, pv = dot(away, u), dot(away, v)
    area = uu * vv - uv**2
    b, c = (vv * pu - uv * pv) / area, (uu * pv - uv * pu) / area
    over = (b >= 0) & (c >= 0) & (b + c <= 1)
    height = away - b[:, None] * u - c[:, None] * v
    squared = np.where(over, dot(height, height), np.inf)
    third, from_second = v - u, away - u
    for offset, edge, along in (
        (away, u, pu / uu),
        (away, v, pv / vv),
        (from_second, third, dot(from_second, third) / dot(third, third)),
    ):
        rest = offset - np.clip(along, 0, 1)[:, None] * edge
        squared = np.minimum(squared, dot(rest, rest))
    return squared


DESCRIPTION = "city.json"


@dataclass(frozen=True)
class CityConfig:
    """What determines a city, as `leco city` asks for it. ValueError for what cannot be built."""

    blocks: int = 3
    """The city covers blocks x blocks blocks, some of them missing at the rim."""
    seed: int = 0
    block_size: float = 40.0
    """From one street's middle to the next, in metres."""
    sky: bool = False
    far_terrain: bool = False

    def __post_init__(self) -> None:
        if not 1 <= self.blocks <= 64:
            raise ValueError(f"a city has 1 to 64 blocks a side, not {self.blocks}")
        if self.seed < 0:
            raise ValueError(f"a city's seed is not negative, as {self.seed} is")
        if not 32 <= self.block_size <= 200:
            raise ValueError(f"a block is 32 to 200 metres wide, not {self.block_size}")


class City:
    """The geometry of one city."""

    def __init__(self, config: CityConfig) -> None:
        self.config = config
        self.built = choose_blocks(config.blocks, config.seed)
        """Which cells of the blocks x blocks square hold a block: bool [blocks, blocks]."""
        self.centres = centres(self.built, config.block_size)
        """Centres of all cells, metres: [blocks, blocks, 2]."""
        shapes, palette = plan_city(self.built, config.block_size, config.seed, config.far_terrain)
        self.material, colour, self.anchor, self.pitch = map(np.array, zip(*palette))
        self.colour = colour.astype(np.float32)
        direction = np.array([direction for _, direction, _ in shapes.rectangles])
        flat = np.stack([face for face, _, _ in shapes.rectangles])
        fans = np.concatenate([fan for fan, _ in shapes.triangles])
        self._faces, self._solids = Faces(flat, fans), Solids(shapes)
        self.triangles = np.concatenate([_halves(flat, direction), fans])
        """All faces as triangles, counter-clockwise seen from the air, metres: [T, 3, 3]."""
        of_halves = np.repeat([number for _, _, number in shapes.rectangles], 2)
        of_fans = [np.full(len(fan), number) for fan, number in shapes.triangles]
        self.paint = np.concatenate([of_halves, *of_fans])
        """Row of each triangle in `material`, `colour`, `anchor`, `pitch`: int [T]."""

    @classmethod
    def from_folder(cls, folder: Path) -> City:
        """The city whose pictures `folder` holds. ValueError or OSError if it holds none."""
        return cls(CityConfig(**read_description(folder)["city"]))

    @cached_property
    def bounds(self) -> Array:
        """Low and high corner of all faces, metres: [2, 3]."""
        return np.stack([self.triangles.min((0, 1)), self.triangles.max((0, 1))])

    @cached_property
    def roof(self) -> float:
        """Height of the highest thing in the city proper, metres."""
        reach = np.abs(self.centres).max() + self.config.block_size
        near = np.abs(self.triangles[..., :2]).max((1, 2)) < reach
        return float(self.triangles[near, :, 2].max())

    def on_block(self, places: Array) -> NDArray[np.bool_]:
        """Whether each place [N, 2] (metres) is in a cell that is built: bool [N]."""
        cells = np.floor(places / self.config.block_size + len(self.built) / 2).astype(int)
        inside = ((cells >= 0) & (cells < len(self.built))).all(1)
        return inside & self.built[tuple(np.clip(cells, 0, len(self.built) - 1).T)]

    def occupied(self, positions: NDArray[Any]) -> NDArray[np.bool_]:
        """Whether each position [N, 3] (metres) lies inside solid matter: bool [N]."""
        return self._solids.contain(np.asarray(positions, dtype=np.float64))

    def distance(self, positions: NDArray[Any]) -> Array:
        """Distance (metres, not signed) from each position [N, 3] to the nearest surface: [N]."""
        return self._faces.distance(np.asarray(positions, dtype=np.float64))


def _halves(rectangles: Array, direction: NDArray[np.int64]) -> Array:
    """Two triangles for each axis-aligned rectangle [R, 2, 3], facing +-1 along its flat axis."""
    low, high = rectangles[:, 0], rectangles[:, 1]
    flat = np.argmin(high - low, axis=1)
    rows = np.arange(len(low))
    second, third = low.copy(), low.copy()
    u, v = (flat + 1) % 3, (flat + 2) % 3
    second[rows, u] = high[rows, u]
    third[rows, v] = high[rows, v]
    turn = (direction < 0)[:, None]
    b, d = np.where(turn, third, second), np.where(turn, second, third)
    return np.stack([np.stack([low, b, high], 1), np.stack([low, high, d], 1)], 1).reshape(-1, 3, 3)


def read_description(folder: Path) -> dict[str, Any]:
    """Reads and checks a folder's `city.json`. ValueError or OSError, in one line, if it is bad."""
    path = folder / DESCRIPTION
    if not path.is_file():
        raise FileNotFoundError(f"{folder} holds no city: there is no {DESCRIPTION}")
    try:
        description = json.loads(path.read_text())
        if description["format"] != 1:
            raise ValueError(f"format {description['format']} is not known")
        CityConfig(**description["city"])
        dict(description["capture"], layout=description["layout"])
    except (ValueError, TypeError, KeyError) as error:
        raise ValueError(f"{path} does not describe a city: {one_line(error)}") from error
    return dict(description)
