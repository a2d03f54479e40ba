"""Photographs of the city by ray tracing: colour, and the exact depth at every pixel's middle.

Surfaces are painted with solid patterns by position, the same whatever camera looks at them.
Photometric training needs something to grip on every surface, at every distance: noise in four
octaves from metres to decimetres, each faded out where a pixel is larger than its waves.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from leco_plugin.scenes.city.cameras import QUINCUNX, Lens
from leco_plugin.scenes.city.city import City
from leco_plugin.scenes.city.shapes import STOREY, Array, Material, dot

Colours = NDArray[np.float32]
Spacing = Array | float
_WAVES = (9.0, 2.4, 0.7, 0.22)
"""Wavelengths of the noise, metres."""
_CURTAIN = np.array([0.78, 0.74, 0.62], np.float32)
_GLASS = np.array([0.13, 0.17, 0.22], np.float32)
_STRENGTH = np.array([0.16, 0.16, 0.10, 0.16, 0.16, 0.26, 0.2, 0.42, 0.08, 0.16], np.float32)
"""Of the noise on each material."""
_TABLE = np.random.default_rng(7).random((256, 256), dtype=np.float32)


def _noise(u: Array, v: Array) -> Colours:
    """Smooth noise in -1..1 at places u, v [N]; one wave per unit, repeating after 256."""
    i, j = np.floor(u), np.floor(v)
    s, t = (u - i).astype(np.float32), (v - j).astype(np.float32)
    s, t = s * s * (3 - 2 * s), t * t * (3 - 2 * t)
    i0, j0 = i.astype(np.int64) & 255, j.astype(np.int64) & 255
    i1, j1 = (i0 + 1) & 255, (j0 + 1) & 255
    near = _TABLE[i0, j0] * (1 - t) + _TABLE[i0, j1] * t
    far = _TABLE[i1, j0] * (1 - t) + _TABLE[i1, j1] * t
    return 2 * (near * (1 - s) + far * s) - 1


def _covered(position: Array, period: Spacing, width: Spacing, pixel: Array) -> Colours:
    """Share of a pixel, metres wide, that stripes of `width` every `period` cover, exactly."""

    def integral(x: Array) -> Array:
        whole = np.floor(x / period)
        return whole * width + np.minimum(x - whole * period, width)

    pixel = np.maximum(pixel, 1e-3)
    share = (integral(position + pixel / 2) - integral(position - pixel / 2)) / pixel
    return share.astype(np.float32)


def paint_surface(
    city: City, positions: Array, normals: Array, paint: NDArray[np.int64], pixel: Array
) -> Colours:
    """Reflectance [N, 3] float32, RGB in 0..1, of positions [N, 3] in metres with outward unit
    normals [N, 3], rows of the palette [N], and the width of a pixel there [N] in metres."""
    material = city.material[paint]
    colour = city.colour[paint].copy()
    local = positions - city.anchor[paint]
    upright = np.abs(normals[:, 2]) < 0.5
    east = np.abs(normals[:, 0]) > np.abs(normals[:, 1])
    # The pattern lies in the plane that the face looks at most.
    u = np.where(upright & east, positions[:, 1], positions[:, 0])
    v = np.where(upright, positions[:, 2], positions[:, 1])

    walls = np.flatnonzero((material == Material.WALL) & upright)
    _facades(colour, walls, local, east, city.pitch[paint], paint, pixel)
    _streets(colour, (material == Material.STREET) & ~upright, local, city.anchor[paint, 2], pixel)
    flagstones = material == Material.PAVEMENT
    joints = np.maximum(
        *(_covered(along[flagstones], 1.2, 0.1, pixel[flagstones]) for along in (u, v))
    )
    colour[flagstones] *= (1 - 0.4 * joints)[:, None]
    tiled = material == Material.TILES
    courses = _covered(positions[tiled, 2], 0.35, 0.1, pixel[tiled])
    colour[tiled] *= (1 - 0.35 * courses)[:, None]
    _hills(colour, material == Material.TERRAIN, positions[:, 2], normals[:, 2])

    strength = _STRENGTH[material]
    tone = np.zeros(len(colour), np.float32)
    for octave, wave in enumerate(_WAVES):
        seen = np.clip(wave / np.maximum(pixel, 1e-3) - 1, 0, 1).astype(np.float32)
        tone += seen * _noise(u / wave + 31.7 * octave, v / wave + 11.3 * octave)
    colour *= (1 + strength * tone)[:, None]
    return np.clip(colour, 0, 1)


def _facades(
    colour: Colours,
    chosen: NDArray,
    local: Array,
    east: NDArray,
    pitch: Array,
    paint: NDArray,
    pixel: Array,
) -> None:
    """Windows, storey by storey, some with drawn curtains; every storey has a ledge."""
    local, pixel = local[chosen], pixel[chosen]
    along = np.where(east[chosen], local[:, 1], local[:, 0])
    spacing = np.where(east[chosen], pitch[chosen, 1], pitch[chosen, 0])
    width = 0.52 * spacing
    across = _covered(along - 0.24 * spacing, spacing, width, pixel)
    upward = _covered(local[:, 2] - 1.0, STOREY, 1.6, pixel)
    column, storey = np.floor(along / spacing), np.floor(local[:, 2] / STOREY)
    pane = _TABLE[
        (column.astype(np.int64) * 7 + paint[chosen] * 13) & 255,
        (storey.astype(np.int64) * 5 + paint[chosen]) & 255,
    ]
    glass = np.where(pane[:, None] > 0.8, _CURTAIN, _GLASS)
    glass = glass * (0.75 + 0.5 * pane[:, None])
    share = (across * upward)[:, None]
    ledge = _covered(local[:, 2], STOREY, 0.3, pixel)
    wall = colour[chosen] * (1 - 0.22 * ledge)[:, None]
    colour[chosen] = wall * (1 - share) + glass * share


def _streets(colour: Colours, chosen: NDArray, local: Array, size: Array, pixel: Array) -> None:
    """Dashed middle lines, kerb lines and crossings; `size` is the distance of the streets."""
    chosen = chosen & (size > 1)
    if not chosen.any():
        return
    x, y = np.abs(local[chosen, :2]).T
    size, pixel = size[chosen], pixel[chosen]
    middle, lot = size / 2, 0.35 * size
    far, near = np.maximum(x, y), np.minimum(x, y)
    in_street = near < lot
    dash = _covered(near, 4.0, 2.2, pixel)
    line = np.clip((0.12 - (middle - far)) / np.maximum(pixel, 0.02) + 0.5, 0, 1)
    line *= np.minimum(0.24 / pixel, 1)
    white = dash * line * (near < lot - 3.5)
    bars = _covered(far - lot, 1.0, 0.5, pixel)
    white = np.maximum(white, bars * ((near > lot - 3.0) & (near < lot - 0.6)))
    white = (white * in_street).astype(np.float32)[:, None]
    colour[chosen] = colour[chosen] * (1 - white) + 0.85 * white


def _hills(colour: Colours, chosen: NDArray, height: Array, slope: Array) -> None:
    """Rock where it is steep or high."""
    steep_or_high = (0.93 - slope[chosen]) * 6 + height[chosen] / 150
    rock = np.clip(steep_or_high, 0, 1).astype(np.float32)[:, None]
    colour[chosen] = colour[chosen] * (1 - rock) + np.array([0.48, 0.45, 0.42], np.float32) * rock


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


class Tracer:
    """Casts rays at a city."""

    def __init__(self, city: City) -> None:
        import trimesh  # only here: the paint is also used on machines without it

        self.city = city
        corners = city.triangles.reshape(-1, 3)
        faces = np.arange(len(corners)).reshape(-1, 3)
        self.mesh = trimesh.Trimesh(corners, faces, process=False, validate=False)
        first, second, third = city.triangles.swapaxes(0, 1)
        normals = np.cross(second - first, third - first)
        self.normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)

    def cast(self, origins: Array, directions: Array) -> tuple[NDArray[np.int64], Array]:
        """The first face [N] that each ray meets, -1 for none, and its depth [N] in metres along
        the ray, inf for none; origins [N, 3] in metres, unit directions [N, 3]."""
        faces = np.asarray(self.mesh.ray.intersects_first(origins, directions), dtype=np.int64)
        depths = np.full(len(faces), np.inf)
        hit = faces >= 0
        # The ray tracer works in single precision; the plane of the face gives the exact depth.
        normals = self.normals[faces[hit]]
        offsets = self.city.triangles[faces[hit], 0] - origins[hit]
        slant = dot(normals, directions[hit])
        height = dot(normals, offsets)
        depths[hit] = height / np.where(np.abs(slant) < 1e-12, 1e-12, slant)
        return faces, depths

    def colour(self, origins: Array, directions: Array, angle: float) -> tuple[Colours, Array]:
        """Light [N, 3], RGB in 0..1, and depth [N], metres, along rays [N, 3] whose
        pixels are `angle` radians wide."""
        faces, depths = self.cast(origins, directions)
        has_sky = self.city.config.sky
        colours = sky(directions) if has_sky else np.zeros(directions.shape, np.float32)
        hit = np.flatnonzero(faces >= 0)
        if not len(hit):
            return colours, depths
        positions = origins[hit] + depths[hit, None] * directions[hit]
        normals = self.normals[faces[hit]]
        slant = np.abs(dot(normals, directions[hit]))
        pixel = depths[hit] * angle / np.sqrt(np.maximum(slant, 0.05))
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
        if has_sky:
            haze = 1 - np.exp(-depths[hit, None].astype(np.float32) / _SIGHT)
            colours[hit] = colours[hit] * (1 - haze) + _HORIZON * haze
        return np.clip(colours, 0, 1), depths

    def photograph(
        self, camera_to_world: Array, lens: Lens
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """An antialiased picture [height, width, 3], sRGB, from a pose [3, 4] in metres, OpenGL
        axes, and the depth [height, width] in metres along the ray through each pixel's middle, inf
        for nothing."""
        size = lens.height, lens.width
        image, depth = np.zeros((*size, 3), np.float32), np.zeros(size, np.float32)
        for number, place in enumerate(QUINCUNX):
            directions = lens.directions(place) @ camera_to_world[:, :3].T
            for rows in np.array_split(np.arange(lens.height), -(-depth.size // _RAYS)):
                rays = directions[rows].reshape(-1, 3)
                origins = np.broadcast_to(camera_to_world[:, 3], rays.shape)
                colours, depths = self.colour(origins, rays, 1 / lens.focal)
                image[rows] += colours.reshape(len(rows), -1, 3) / len(QUINCUNX)
                if number == 0:
                    depth[rows] = depths.reshape(len(rows), -1)
        return np.rint(255 * image ** np.float32(1 / _GAMMA)).astype(np.uint8), depth


_HORIZON = np.array([0.74, 0.80, 0.86], np.float32)
_ZENITH = np.array([0.22, 0.42, 0.72], np.float32)


def sky(directions: Array) -> Colours:
    """Colour of a clear sky [N, 3] in directions [N, 3]: pale at the horizon, blue above."""
    up = np.power(np.clip(directions[:, 2:3], 0, 1), 0.6).astype(np.float32)
    return _HORIZON * (1 - up) + _ZENITH * up
