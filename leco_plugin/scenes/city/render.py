"""Photographs of the city by ray tracing: colour, and the exact depth at every pixel's middle."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray

from leco_plugin.scenes.city.city import City
from leco_plugin.scenes.city.lens import Lens
from leco_plugin.scenes.city.shapes import Array
from leco_plugin.scenes.city.texture import Colours, paint_surface

SUN = np.array([0.48, -0.36, 0.8])
"""Direction towards the sun, unit length."""
_SUNLIGHT = np.array([1.06, 1.0, 0.9], np.float32)
_SKYLIGHT = np.array([0.42, 0.46, 0.52], np.float32)
_SIGHT = 2500.0
"""Metres of clear air after which a third of the light is its own."""
_GAMMA = 1.5
"""Brightens shadows; less than a screen's 2.2, which would bleach this much light."""
_RAYS = 1 << 18
"""Rays cast at once, to bound the memory of large pictures."""
_QUINCUNX = ((0.5, 0.5), (0.25, 0.25), (0.75, 0.25), (0.25, 0.75), (0.75, 0.75))
"""Places in a pixel that rays go through. The first gives the depth, all give the colour."""


class Tracer:
    """Casts rays at a city."""

    def __init__(self, city: City) -> None:
        self.city = city
        corners = city.triangles.reshape(-1, 3)
        faces = np.arange(len(corners)).reshape(-1, 3)
        self.mesh = trimesh.Trimesh(corners, faces, process=False, validate=False)
        normals = np.cross(
            city.triangles[:, 1] - city.triangles[:, 0], city.triangles[:, 2] - city.triangles[:, 0]
        )
        self.normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)

    def cast(self, origins: Array, directions: Array) -> tuple[NDArray[np.int64], Array]:
        """The first face each ray meets.

        Args:
            origins: [N, 3] metres.
            directions: [N, 3] unit.
        Returns:
            faces: [N] int, -1 for a ray that meets none.
            depths: [N] metres along the ray, inf for a ray that meets none.
        """
        faces = np.asarray(self.mesh.ray.intersects_first(origins, directions), dtype=np.int64)
        depths = np.full(len(faces), np.inf)
        hit = faces >= 0
        # The ray tracer works in single precision; the plane of the face gives the exact depth.
        normals = self.normals[faces[hit]]
        offsets = self.city.triangles[faces[hit], 0] - origins[hit]
        slant = np.einsum("nk,nk->n", normals, directions[hit])
        height = np.einsum("nk,nk->n", normals, offsets)
        depths[hit] = height / np.where(np.abs(slant) < 1e-12, 1e-12, slant)
        return faces, depths

    def colour(
        self, origins: Array, directions: Array, pixel_angle: float
    ) -> tuple[Colours, Array]:
        """Light and depth along rays [N, 3]: RGB in 0..1, [N, 3], and metres, [N]."""
        faces, depths = self.cast(origins, directions)
        colours = (
            sky(directions) if self.city.config.sky else np.zeros(directions.shape, np.float32)
        )
        hit = np.flatnonzero(faces >= 0)
        if not len(hit):
            return colours, depths
        positions = origins[hit] + depths[hit, None] * directions[hit]
        normals = self.normals[faces[hit]]
        slant = np.abs(np.einsum("nk,nk->n", normals, directions[hit]))
        pixel = depths[hit] * pixel_angle / np.sqrt(np.maximum(slant, 0.05))
        albedo = paint_surface(self.city, positions, normals, self.city.paint[faces[hit]], pixel)
        sunlit = np.maximum(normals @ SUN, 0).astype(np.float32)
        facing = np.flatnonzero(sunlit > 0)
        start = positions[facing] + 1e-3 * normals[facing]
        blocked = self.mesh.ray.intersects_first(start, np.broadcast_to(SUN, start.shape)) >= 0
        sunlit[facing[blocked]] = 0
        # Light from the open sky reaches roofs more than walls, and walls more the higher up.
        openness = 0.55 + 0.3 * normals[:, 2] + 0.15 * np.clip(positions[:, 2] / 12, 0, 1)
        light = sunlit[:, None] * _SUNLIGHT + openness.astype(np.float32)[:, None] * _SKYLIGHT
        colours[hit] = albedo * light
        if self.city.config.sky:
            haze = 1 - np.exp(-depths[hit, None].astype(np.float32) / _SIGHT)
            colours[hit] = colours[hit] * (1 - haze) + _HORIZON * haze
        return np.clip(colours, 0, 1), depths

    def photograph(
        self, camera_to_world: Array, lens: Lens
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Takes one antialiased picture.

        Args:
            camera_to_world: [3, 4], metres, OpenGL axes (x right, y up, looking along -z).
            lens: size and focal length.
        Returns:
            image: [height, width, 3] sRGB.
            depth: [height, width] metres along the ray through the pixel's middle; inf where
                it meets nothing.
        """
        size = lens.height, lens.width
        image, depth = np.zeros((*size, 3), np.float32), np.zeros(size, np.float32)
        for number, place in enumerate(_QUINCUNX):
            directions = lens.directions(place) @ camera_to_world[:, :3].T
            for rows in np.array_split(np.arange(lens.height), -(-depth.size // _RAYS)):
                rays = directions[rows].reshape(-1, 3)
                origins = np.broadcast_to(camera_to_world[:, 3], rays.shape)
                colours, depths = self.colour(origins, rays, 1 / lens.focal)
                image[rows] += colours.reshape(len(rows), -1, 3) / len(_QUINCUNX)
                if number == 0:
                    depth[rows] = depths.reshape(len(rows), -1)
        return np.rint(255 * image ** np.float32(1 / _GAMMA)).astype(np.uint8), depth


_HORIZON = np.array([0.74, 0.80, 0.86], np.float32)
_ZENITH = np.array([0.22, 0.42, 0.72], np.float32)


def sky(directions: Array) -> Colours:
    """Colour of a clear sky [N, 3] in directions [N, 3]: pale at the horizon, blue above."""
    up = np.power(np.clip(directions[:, 2:3], 0, 1), 0.6).astype(np.float32)
    return _HORIZON * (1 - up) + _ZENITH * up
