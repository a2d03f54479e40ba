"""Simple shapes that rays meet in closed form: what the cases' scenes are built of.

Positions are in metres, +z up. A ray that begins inside a shape meets it from within, so that a box
around the camera is a room.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Triple = tuple[float, float, float]
_TINY = 1e-9


@dataclass(frozen=True)
class Paint:
    """How a surface looks."""

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


class Shape(Protocol):
    """What a ray can meet."""

    @property
    def paint(self) -> Paint:
        """Of its surface."""
        ...

    def meet(self, origins: Array, directions: Array) -> tuple[Array, Array]:
        """Where rays [N, 3] first meet it.

        Returns:
            distances [N], metres along unit directions, inf for none; and outward normals [N, 3].
        """
        ...


@dataclass(frozen=True)
class Box:
    """A solid along the axes."""

    low: Triple
    high: Triple
    paint: Paint

    def meet(self, origins: Array, directions: Array) -> tuple[Array, Array]:
        """As of `Shape`."""
        low, high = np.array(self.low), np.array(self.high)
        along = np.where(np.abs(directions) < _TINY, _TINY, directions)
        sides = (low - origins) / along, (high - origins) / along
        enters, leaves = np.minimum(*sides).max(1), np.maximum(*sides).min(1)
        t = np.where(enters > _TINY, enters, leaves)
        t[(leaves <= np.maximum(enters, _TINY))] = np.inf
        met = np.where(np.isfinite(t), t, 0.0)
        offsets = (origins + met[:, None] * directions - (low + high) / 2) / ((high - low) / 2)
        rows, axes = np.arange(len(t)), np.abs(offsets).argmax(1)
        normals = np.zeros_like(origins)
        normals[rows, axes] = -np.sign(directions[rows, axes])
        return t, normals


@dataclass(frozen=True)
class Ball:
    """A sphere."""

    centre: Triple
    radius: float
    paint: Paint

    def meet(self, origins: Array, directions: Array) -> tuple[Array, Array]:
        """As of `Shape`."""
        offsets = origins - np.array(self.centre)
        half = np.einsum("nk,nk->n", offsets, directions)
        t = _first_root(half, np.einsum("nk,nk->n", offsets, offsets) - self.radius**2)
        met = np.where(np.isfinite(t), t, 0.0)
        return t, (offsets + met[:, None] * directions) / self.radius


@dataclass(frozen=True)
class Rod:
    """A pole or a stretched wire: a cylinder between two points, open at its ends."""

    start: Triple
    end: Triple
    radius: float
    paint: Paint

    def meet(self, origins: Array, directions: Array) -> tuple[Array, Array]:
        """As of `Shape`."""
        start, axis = np.array(self.start), np.array(self.end) - np.array(self.start)
        length = float(np.linalg.norm(axis))
        axis = axis / length
        offsets = origins - start
        across = directions - np.outer(directions @ axis, axis)
        beside = offsets - np.outer(offsets @ axis, axis)
        slope = np.maximum(np.einsum("nk,nk->n", across, across), _TINY)
        half = np.einsum("nk,nk->n", beside, across) / slope
        rest = (np.einsum("nk,nk->n", beside, beside) - self.radius**2) / slope
        t = _first_root(half, rest)
        met = np.where(np.isfinite(t), t, 0.0)
        places = offsets + met[:, None] * directions
        height = places @ axis
        t = np.where((height >= 0.0) & (height <= length), t, np.inf)
        return t, (places - np.outer(height, axis)) / self.radius


def _first_root(half: Array, rest: Array) -> Array:
    """Smallest positive t [N] with t^2 + 2 half t + rest = 0; inf where there is none."""
    under = half**2 - rest
    root = np.sqrt(np.maximum(under, 0.0))
    t = np.where(-half - root > _TINY, -half - root, -half + root)
    return np.where((under > 0.0) & (t > _TINY), t, np.inf)
