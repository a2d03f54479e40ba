"""How far a point is from one face: a triangle, the side of a turned solid, the foot it stands on.

Every function pairs points with faces, row by row, and returns squared distances. A turned solid
has n equal sides. Turning and mirroring the point into the wedge of one side answers for all.
"""

from __future__ import annotations

import numpy as np

from leco_plugin.scenes.city.shapes import Array


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


def squared_to_stretches(points: Array, stretches: Array) -> Array:
    """Squared distances [M] from points [M, 3] to sides of turned solids.

    Args:
        points: [M, 3] metres.
        stretches: [M, 7] rows of x, y, number of sides, and height and radius (of the corners)
            of the lower and of the upper ring. A radius of 0 makes a point, equal heights a lid.
    """
    x, y, sides, z0, r0, z1, r1 = stretches.T
    out, aside = _fold(points[:, 0] - x, points[:, 1] - y, sides)
    cosine, sine = np.cos(np.pi / sides), np.sin(np.pi / sides)
    # The side is a trapezium: s runs up its slope, `aside` across it, h off its plane.
    run, rise = (r1 - r0) * cosine, z1 - z0
    length = np.hypot(run, rise)
    out, up = out - r0 * cosine, points[:, 2] - z0
    s, h = (out * run + up * rise) / length, (up * run - out * rise) / length
    half, taper = r0 * sine, (r1 - r0) * sine
    beside = aside - half
    t = np.clip((s * length + beside * taper) / (length**2 + taper**2), 0, 1)
    rim = (s - t * length) ** 2 + (beside - t * taper) ** 2
    rim = np.minimum(rim, s**2 + np.maximum(beside, 0) ** 2)
    rim = np.minimum(rim, (s - length) ** 2 + np.maximum(beside - taper, 0) ** 2)
    over = (s >= 0) & (s <= length) & (beside * length <= s * taper)
    return h**2 + np.where(over, 0, rim)


def squared_to_feet(points: Array, feet: Array) -> Array:
    """Squared distances [M] from points [M, 3] to level squares with a polygon cut out.

    Args:
        points: [M, 3] metres.
        feet: [M, 6] rows of x, y, number of sides, height, radius of the hole's corners, and
            half the side of the square.
    """
    x, y, sides, z, radius, reach = feet.T
    dx, dy = points[:, 0] - x, points[:, 1] - y
    out, _ = _fold(dx, dy, sides)
    in_hole = np.maximum(radius * np.cos(np.pi / sides) - out, 0)
    beyond = np.maximum(np.abs(dx) - reach, 0) ** 2 + np.maximum(np.abs(dy) - reach, 0) ** 2
    return (points[:, 2] - z) ** 2 + in_hole**2 + beyond


def _fold(dx: Array, dy: Array, sides: Array) -> tuple[Array, Array]:
    """A place [M] as distance out along the middle of its wedge, and aside from that (>= 0)."""
    wedge = 2 * np.pi / sides
    turn = np.mod(np.arctan2(dy, dx), wedge) - wedge / 2
    radius = np.hypot(dx, dy)
    return radius * np.cos(turn), np.abs(radius * np.sin(turn))


def _dot(a: Array, b: Array) -> Array:
    """Scalar products of rows: [M, 3], [M, 3] -> [M]."""
    return np.einsum("mk,mk->m", a, b)
