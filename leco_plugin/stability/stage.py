"""A small scene and what is seen in it: exact colours and depths along any ray.

Surfaces are met in closed form. Fog is integrated in fine steps, glass is laid over what is behind
it, so both are as exact as a picture of eight bits can show.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from leco_plugin.scenes.city.cameras import Lens
from leco_plugin.stability.matter import Array, Box, Paint, Shape

_SUN = np.array([0.48, -0.36, 0.8])
_SHADE = 0.45
"""Light where the sun does not reach."""
_QUINCUNX = ((0.5, 0.5), (0.25, 0.25), (0.75, 0.25), (0.25, 0.75), (0.75, 0.75))
"""Places in a pixel that rays go through. The first gives the depth, all give the colour."""
_FOG_STEPS = 32
_HORIZON, _ZENITH = np.array([0.86, 0.90, 0.94]), np.array([0.35, 0.55, 0.86])


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
    """A sky behind everything; without one, rays that meet nothing are transparent."""

    def with_shapes(self, *more: Shape) -> Stage:
        """The same with more shapes in it."""
        return replace(self, shapes=(*self.shapes, *more))


class Seen(NamedTuple):
    """What one picture shows."""

    image: NDArray[np.uint8]
    """[height, width, 4]."""
    depth: NDArray[np.float32]
    """[height, width] metres along the ray through the pixel's middle; inf for no surface."""
    detail: NDArray[np.bool_]
    """[height, width] pixels in which some of the details is seen."""


def photograph(stage: Stage, camera_to_world: Array, lens: Lens) -> Seen:
    """Takes one antialiased picture.

    Args:
        stage: what is there.
        camera_to_world: [3, 4], metres, OpenGL axes.
        lens: size and focal length.
    """
    size = lens.height, lens.width
    total, detail, depth = np.zeros((*size, 4)), np.zeros(size, bool), np.zeros(size)
    for number, place in enumerate(_QUINCUNX):
        directions = (lens.directions(place) @ camera_to_world[:, :3].T).reshape(-1, 3)
        origins = np.broadcast_to(camera_to_world[:, 3], directions.shape)
        colours, depths, is_detail = look(stage, origins, directions)
        total += colours.reshape(*size, 4) / len(_QUINCUNX)
        detail |= is_detail.reshape(size)
        if number == 0:
            depth = depths.reshape(size)
    alpha = total[..., 3:]
    straight = np.concatenate([total[..., :3] / np.maximum(alpha, 1e-9), alpha], axis=-1)
    image = np.rint(255 * straight.clip(0, 1)).astype(np.uint8)
    return Seen(image, depth.astype(np.float32), detail)


def look(stage: Stage, origins: Array, directions: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """What rays [N, 3] meet.

    Returns:
        RGBA with the colour multiplied by alpha [N, 4]; distance to the first surface [N], metres,
        inf for none; whether that is one of the details, [N].
    """
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
        colours[closer, :3] = _lit(shape.paint, places, normals[closer])
        colours[closer, 3] = 1.0
    colours = _behind_glass(stage.panes, origins, directions, colours, nearest)
    if stage.fog is not None:
        colours = _in_fog(stage.fog, origins, directions, colours, nearest)
    return colours, nearest, is_detail


def _lit(paint: Paint, positions: Array, normals: Array) -> Array:
    light = _SHADE + (1.0 - _SHADE) * np.maximum(normals @ _SUN, 0.0)
    return np.clip(paint.at(positions) * light[:, None], 0.0, 1.0)


def _over(front: Array, alpha: Array, behind: Array) -> Array:
    """A colour [N, 3] of opacity [N] before premultiplied RGBA [N, 4]."""
    laid = np.concatenate([front, np.ones((len(front), 1))], axis=1)
    result: Array = alpha[:, None] * laid + (1.0 - alpha[:, None]) * behind
    return result


def _behind_glass(
    panes: tuple[Pane, ...], origins: Array, directions: Array, colours: Array, depths: Array
) -> Array:
    """Panes before the surfaces, the farthest first."""
    if not panes:
        return colours
    met = [pane.box.meet(origins, directions) for pane in panes]
    distances = np.stack([t for t, _ in met])
    order = np.argsort(-np.where(np.isfinite(distances), distances, -1.0), axis=0)
    for rank in range(len(panes)):
        for number, pane in enumerate(panes):
            t, normals = met[number]
            here = (order[rank] == number) & (t < depths)
            places = origins + np.where(here, t, 0.0)[:, None] * directions
            tint = _lit(pane.box.paint, places, normals)
            colours = _over(tint, np.where(here, pane.opacity, 0.0), colours)
    return colours


def _in_fog(fog: Fog, origins: Array, directions: Array, colours: Array, depths: Array) -> Array:
    """The stretch of each ray in the fog, from back to front."""
    low, high = np.array(fog.box.low), np.array(fog.box.high)
    along = np.where(np.abs(directions) < 1e-9, 1e-9, directions)
    sides = (low - origins) / along, (high - origins) / along
    enters = np.minimum(*sides).max(1).clip(min=0.0)
    leaves = np.minimum(np.maximum(*sides).min(1), depths)
    step = np.maximum(leaves - enters, 0.0) / _FOG_STEPS
    alpha = 1.0 - np.exp(-fog.density * step)
    for number in reversed(range(_FOG_STEPS)):
        places = origins + (enters + (number + 0.5) * step)[:, None] * directions
        colours = _over(fog.box.paint.at(places), alpha, colours)
    return colours
