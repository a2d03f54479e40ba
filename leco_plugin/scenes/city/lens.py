"""The pinhole camera the city is photographed with, and the way back from depth to points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from leco_plugin.scenes.city.shapes import Array


@dataclass(frozen=True)
class Lens:
    """A pinhole camera without distortion; lengths in pixels, pixel middles at half numbers."""

    width: int
    height: int
    focal: float

    def directions(self, offset: tuple[float, float] = (0.5, 0.5)) -> Array:
        """Unit directions [height, width, 3] through all pixels, OpenGL camera axes.

        `offset` is the place in the pixel, in pixels from its upper left corner; (0.5, 0.5) is
        its middle.
        """
        rows, columns = np.mgrid[: self.height, : self.width]
        x = (columns + offset[0] - self.width / 2) / self.focal
        y = (self.height / 2 - rows - offset[1]) / self.focal
        rays = np.stack([x, y, -np.ones_like(x)], -1)
        return rays / np.linalg.norm(rays, axis=-1, keepdims=True)

    def points(self, pose: Array, depth: NDArray[np.floating]) -> Array:
        """Points [height, width, 3] seen by a camera-to-world pose [3, 4] at ray depths."""
        return pose[:, 3] + np.asarray(depth)[..., None] * (self.directions() @ pose[:, :3].T)

    def axial(self, depth: NDArray[np.floating]) -> NDArray[np.float32]:
        """Depth files from ray depths (metres, inf for nothing): see `city.folder`."""
        axial = np.where(np.isfinite(depth), depth, 0) * -self.directions()[..., 2]
        return (1e3 * axial).astype(np.float32)

    def along_ray(self, axial: NDArray[np.floating]) -> Array:
        """The inverse of `axial`: metres along the ray, inf for nothing, [height, width]."""
        depth = axial.astype(np.float64) / (-1e3 * self.directions()[..., 2])
        return np.where(axial > 0, depth, np.inf)
