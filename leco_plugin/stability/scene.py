"""Small scenes and what is seen in them: exact colours and depths along any ray.

Rays meet surfaces in closed form. Fog is integrated in fine steps, and glass is laid over what is
behind it, both as exactly as a picture of eight bits can show. Positions are in metres, +z up. A
ray that begins inside a shape meets it from within: a box around the camera is a room.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from leco_plugin.scenes.city.cameras import QUINCUNX, Lens
from leco_plugin.scenes.city.render import SUN
from leco_plugin.scenes.city.shapes import Array, dot

Triple = tuple[float, float, float]
_TINY = 1e-9
_SHADE = 0.45
"""Light where the sun does not reach."""
_FOG_STEPS = 32
SAME_PLACE = 0.05
"""Share of the distance by which a surface in another picture may be off: pixels are wide at the
size of these pictures."""
_HORIZON, _ZENITH = np.array([0.86, 0.90, 0.94]), np.array([0.35, 0.55, 0.86])


@dataclass(frozen=True)
class Paint:
    colour: Triple
    """RGB in 0..1."""
    grain: float = 0.6
    """Wavelength of its pattern, metres; training needs something to grip."""
    contrast: float = 0.35
    """Of the pattern, in 0..1."""

    def at(self, positions: Array) -> Array:
        """RGB [N, 3] at positions [N, 3]."""
        waves = np.zeros(len(positions))
        for times, share in ((1.0, 0.6), (2.7, 0.4)):
            phase = 2.0 * np.pi * times * positions / self.grain
            waves += share * np.sin(phase[:, 0] + 0.7) * np.sin(phase[:, 1]) * np.cos(phase[:, 2])
        return np.clip(np.array(self.colour) * (1.0 + self.contrast * waves[:, None]), 0.0, 1.0)


@dataclass(frozen=True)
class Box:
    """A solid along the axes."""

    low: Triple
    high: Triple
    paint: Paint

    def span(self, origins: Array, directions: Array) -> tuple[Array, Array]:
        """Distances [N] at which rays [N, 3] enter and leave it; a ray that misses leaves first."""
        along = np.where(np.abs(directions) < _TINY, _TINY, directions)
        sides = (np.array(self.low) - origins) / along, (np.array(self.high) - origins) / along
        return np.minimum(*sides).max(1), np.maximum(*sides).min(1)

    def meet(self, origins: Array, directions: Array) -> tuple[Array, Array]:
        """Where rays [N, 3] first meet the surface: distances [N], metres along unit directions,
        inf for none; and outward normals [N, 3]."""
        low, high = np.array(self.low), np.array(self.high)
        enters, leaves = self.span(origins, directions)
        t = np.where(enters > _TINY, enters, leaves)
        t[(leaves <= np.maximum(enters, _TINY))] = np.inf
        offsets = (_points(origins, t, directions) - (low + high) / 2) / ((high - low) / 2)
        rows, axes = np.arange(len(t)), np.abs(offsets).argmax(1)
        normals = np.zeros_like(origins)
        normals[rows, axes] = -np.sign(directions[rows, axes])
        return t, normals


@dataclass(frozen=True)
class Ball:
    centre: Triple
    radius: float
    paint: Paint

    def meet(self, origins: Array, directions: Array) -> tuple[Array, Array]:
        """As of `Box`."""
        offsets = origins - np.array(self.centre)
        t = _first_root(dot(offsets, directions), dot(offsets, offsets) - self.radius**2)
        return t, _points(offsets, t, directions) / self.radius


@dataclass(frozen=True)
class Rod:
    """A pole or a stretched wire: a cylinder between two points, open at its ends."""

    start: Triple
    end: Triple
    radius: float
    paint: Paint

    def meet(self, origins: Array, directions: Array) -> tuple[Array, Array]:
        """As of `Box`."""
        start, axis = np.array(self.start), np.array(self.end) - np.array(self.start)
        length = float(np.linalg.norm(axis))
        axis = axis / length
        offsets = origins - start
        across = directions - np.outer(directions @ axis, axis)
        beside = offsets - np.outer(offsets @ axis, axis)
        slope = np.maximum(dot(across, across), _TINY)
        rest = (dot(beside, beside) - self.radius**2) / slope
        t = _first_root(dot(beside, across) / slope, rest)
        places = _points(offsets, t, directions)
        height = places @ axis
        t = np.where((height >= 0.0) & (height <= length), t, np.inf)
        return t, (places - np.outer(height, axis)) / self.radius


Shape = Box | Ball | Rod


def _points(origins: Array, t: Array, directions: Array) -> Array:
    """Points [N, 3] at distances t [N]; the origins where those are infinite."""
    return origins + np.where(np.isfinite(t), t, 0.0)[:, None] * directions


def _first_root(half: Array, rest: Array) -> Array:
    """Smallest positive t [N] with t^2 + 2 half t + rest = 0; inf where there is none."""
    under = half**2 - rest
    root = np.sqrt(np.maximum(under, 0.0))
    t = np.where(-half - root > _TINY, -half - root, -half + root)
    return np.where((under > 0.0) & (t > _TINY), t, np.inf)


@dataclass(frozen=True)
class Pane:
    """A thin translucent plate."""

    box: Box
    opacity: float
    """Share of the light that it replaces by its own colour."""


@dataclass(frozen=True)
class Fog:
    """Matter of low density everywhere in a box."""

    box: Box
    """Where it is, and its colour."""
    density: float
    """Per metre."""


@dataclass(frozen=True)
class Stage:
    """Everything that is there."""

    shapes: tuple[Shape, ...] = ()
    details: tuple[Shape, ...] = ()
    """Shapes that the case is about: how well they are seen is measured by itself."""
    panes: tuple[Pane, ...] = ()
    fog: Fog | None = None
    sky: bool = False
    """Whether a sky is behind everything; without one, rays that meet nothing are transparent."""


class Seen(NamedTuple):
    """A picture that was taken, and how far away what it shows is."""

    pose: Array
    """[3, 4] camera to world, metres, OpenGL axes."""
    lens: Lens
    image: NDArray[np.uint8]
    """[height, width, 4]."""
    depth: NDArray[np.float32]
    """[height, width] metres along the ray through the pixel's middle; inf for no surface."""
    detail: NDArray[np.bool_]
    """[height, width] pixels in which some of the details is seen."""

    def shows(self, points: Array) -> NDArray[np.bool_]:
        """Which points [N, 3] lie in the picture and are hidden by nothing."""
        seen = (points - self.pose[:, 3]) @ self.pose[:, :3]
        ahead = -seen[:, 2]
        shown = ahead > 0
        ahead = np.where(shown, ahead, 1.0)
        columns = np.floor(self.lens.focal * seen[:, 0] / ahead + self.lens.width / 2)
        rows = np.floor(self.lens.height / 2 - self.lens.focal * seen[:, 1] / ahead)
        shown &= (columns >= 0) & (columns < self.lens.width)
        shown &= (rows >= 0) & (rows < self.lens.height)
        depth = np.full(len(points), np.inf)
        depth[shown] = self.depth[rows[shown].astype(int), columns[shown].astype(int)]
        distance = np.linalg.norm(seen, axis=-1)
        return shown & (np.abs(depth - distance) <= SAME_PLACE * distance)


def photograph(stage: Stage, camera_to_world: Array, lens: Lens) -> Seen:
    """Takes one antialiased picture from a pose [3, 4], metres, OpenGL axes."""
    found = []
    for place in QUINCUNX:
        directions = (lens.directions(place) @ camera_to_world[:, :3].T).reshape(-1, 3)
        origins = np.broadcast_to(camera_to_world[:, 3], directions.shape)
        found.append(look(stage, origins, directions))
    colours, depths, are_details = map(np.stack, zip(*found))
    total, size = (colours / len(QUINCUNX)).sum(axis=0), (lens.height, lens.width)
    alpha = total[:, 3:]
    straight = np.concatenate([total[:, :3] / np.maximum(alpha, 1e-9), alpha], axis=-1)
    image = np.rint(255 * straight.clip(0, 1)).astype(np.uint8).reshape(*size, 4)
    depth = depths[0].astype(np.float32).reshape(size)
    detail = are_details.any(axis=0).reshape(size)
    return Seen(camera_to_world, lens, image, depth, detail)


def look(stage: Stage, origins: Array, directions: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """What rays [N, 3] meet: RGBA with the colour multiplied by alpha [N, 4]; distance to the first
    surface [N], metres, inf for none; whether that is one of the details, [N]."""
    colours = np.zeros((len(origins), 4))
    if stage.sky:
        up = np.power(np.clip(directions[:, 2:], 0.0, 1.0), 0.6)
        colours[:, :3], colours[:, 3] = _HORIZON * (1 - up) + _ZENITH * up, 1.0
    nearest, is_detail = np.full(len(origins), np.inf), np.zeros(len(origins), bool)
    for number, shape in enumerate((*stage.shapes, *stage.details)):
        t, normals = shape.meet(origins, directions)
        closer = np.flatnonzero(t < nearest)
        nearest[closer], is_detail[closer] = t[closer], number >= len(stage.shapes)
        places = origins[closer] + t[closer, None] * directions[closer]
        colours[closer, :3] = _light(shape.paint, places, normals[closer])
        colours[closer, 3] = 1.0
    if stage.panes:
        colours = _lay_glass(stage.panes, origins, directions, colours, nearest)
    if stage.fog is not None:
        colours = _lay_fog(stage.fog, origins, directions, colours, nearest)
    return colours, nearest, is_detail


def _light(paint: Paint, positions: Array, normals: Array) -> Array:
    light = _SHADE + (1.0 - _SHADE) * np.maximum(normals @ SUN, 0.0)
    return np.clip(paint.at(positions) * light[:, None], 0.0, 1.0)


def _lay(front: Array, alpha: Array, behind: Array) -> Array:
    """A colour [N, 3] of opacity [N] before premultiplied RGBA [N, 4]."""
    laid = np.pad(front, ((0, 0), (0, 1)), constant_values=1.0)
    return alpha[:, None] * laid + (1.0 - alpha[:, None]) * behind


def _lay_glass(
    panes: tuple[Pane, ...], origins: Array, directions: Array, colours: Array, depths: Array
) -> Array:
    """Panes before the surfaces, the farthest first."""
    distances, tints, alphas = [], [], []
    for pane in panes:
        t, normals = pane.box.meet(origins, directions)
        t = np.where(t < depths, t, np.inf)
        distances.append(np.where(np.isfinite(t), t, -1.0))
        tints.append(_light(pane.box.paint, _points(origins, t, directions), normals))
        alphas.append(np.where(np.isfinite(t), pane.opacity, 0.0))
    tint, alpha, rays = np.stack(tints), np.stack(alphas), np.arange(len(origins))
    for farthest in np.argsort(-np.stack(distances), axis=0):
        colours = _lay(tint[farthest, rays], alpha[farthest, rays], colours)
    return colours


def _lay_fog(fog: Fog, origins: Array, directions: Array, colours: Array, depths: Array) -> Array:
    """The stretch of each ray in the fog, from back to front."""
    enters, leaves = fog.box.span(origins, directions)
    enters, leaves = enters.clip(min=0.0), np.minimum(leaves, depths)
    step = np.maximum(leaves - enters, 0.0) / _FOG_STEPS
    alpha = 1.0 - np.exp(-fog.density * step)
    for number in reversed(range(_FOG_STEPS)):
        places = origins + (enters + (number + 0.5) * step)[:, None] * directions
        colours = _lay(fog.box.paint.at(places), alpha, colours)
    return colours
