"""Which way is up in a reconstruction, and how it lies in metres where GPS is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from leco_plugin.scenes.frames import rotation
from leco_plugin.scenes.upright import turn_to_upright

Array = NDArray[np.float64]
TOLERANCE, TOLERATED = 10.0, 0.1
"""How far a position by GPS may be from its pose: metres, and share of the survey's spread."""
RECEIVER, LEAST_TOLD = 5.0, 0.3
"""How far a position of an ordinary receiver may always be: metres, and share of the spread. Of
shuffled positions one survey in fifty agrees by this, and of right ones within 25 m nearly all do,
where half do by `TOLERATED`."""
FEWEST = 4
"""Photographs with GPS for which a similarity, of seven numbers, can be doubted."""
AGREEING, ALWAYS = 0.5, 3
"""Share of positions that must agree with the poses, beside those few that always can."""
WANDERING = 0.3
"""Length of the mean of the cameras' top axes below which they do not say what is up."""


Position = tuple[float, float, float]
"""Latitude and longitude in degrees, altitude in metres."""


@dataclass(frozen=True)
class Placement:
    """A reconstruction in the world: world = scale * turn @ x + shift."""

    scale: float
    turn: Array
    """[3, 3], a rotation."""
    shift: Array
    """[3]."""
    residuals: Array | None = None
    """[C] metres between pose and GPS, nan where there is none. None: not by GPS."""
    reason: str = ""
    """Why GPS is not used."""

    def apply(self, points: Array) -> Array:
        """World coordinates [N, 3] of points of the reconstruction."""
        return np.asarray(self.scale * points @ self.turn.T + self.shift)


def local_places(
    pycolmap: Any, positions: Sequence[Position | None]
) -> tuple[Position | None, Array]:
    """Positions in metres east, north and up of an origin at sea level.

    Args:
        pycolmap: the module, for its ellipsoid (WGS 84).
        positions: None is not known. Of a nan altitude the median of the others is taken, or 0.
    Returns:
        The origin, the median of the positions, or None where none is known; and places [N, 3],
        nan where nothing is known.
    """
    places = np.array([each or (np.nan,) * 3 for each in positions], dtype=float).reshape(-1, 3)
    there = np.isfinite(places[:, 0])
    if not there.any():
        return None, places
    known = places[there]
    given = known[np.isfinite(known[:, 2]), 2]
    known[~np.isfinite(known[:, 2]), 2] = np.median(given) if len(given) else 0.0
    turns = (known[:, 1] - known[0, 1] + 180.0) % 360.0 - 180.0  # -179.9 is near 179.9
    longitude = (known[0, 1] + np.median(turns) + 180.0) % 360.0 - 180.0
    origin = (float(np.median(known[:, 0])), float(longitude), 0.0)
    places[there] = pycolmap.GPSTransform().ellipsoid_to_enu(known, *origin)
    return origin, places


def upright(poses: Array, points: Array) -> Array:
    """The direction [3] that is up in a reconstruction.

    Of surveys from the air it is seen from ground and cameras. Of others it is the mean of the
    photographs' top edges, or against the mean view where these point in all directions.

    Args:
        poses: [C, 3, 4] OpenGL camera to world.
        points: [P, 3] sparse points.
    """
    # a survey that lies within 20 degrees of upright is not turned: laid down, it is
    for base in (np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), np.eye(3)):
        turn = turn_to_upright(torch.from_numpy(base @ poses), torch.from_numpy(points @ base.T))
        if turn is not None:
            return np.asarray((turn.double().numpy() @ base)[2])
    top = poses[:, :, 1].mean(axis=0)
    up = top if np.linalg.norm(top) > WANDERING else poses[:, :, 2].mean(axis=0)
    return np.asarray(up / max(float(np.linalg.norm(up)), 1e-9))


def place(pycolmap: Any, centres: Array, gps: Array, up: Array) -> Placement:
    """The similarity that takes a reconstruction to metres, or a rotation that sets it upright.

    Args:
        pycolmap: the module, for its robust estimate.
        centres: [C, 3] of the cameras, in the reconstruction.
        gps: [C, 3] their positions in metres, nan where not known.
        up: [3] in the reconstruction, which a flight along one line needs.
    """
    known = np.isfinite(gps).all(axis=1)
    if known.sum() < FEWEST:
        number = int(known.sum()) or "no"
        return _by_direction(
            up, f"{number} placed photographs have a GPS position, and {FEWEST} are needed"
        )
    spread = float(np.sqrt(((gps[known] - gps[known].mean(axis=0)) ** 2).sum(axis=1).mean()))
    options = pycolmap.RANSACOptions()
    options.max_error, options.random_seed = tolerance(spread), 0
    found: Any = None
    if options.max_error > 0.0:  # else all positions are the same
        found = pycolmap.estimate_sim3d_robust(centres[known], gps[known], options)
    agreeing = 0 if found is None else int(np.sum(found["inlier_mask"]))
    if agreeing - ALWAYS < AGREEING * (known.sum() - ALWAYS):
        reason = (
            f"GPS contradicts the poses: {agreeing} of {known.sum()} positions agree within "
            f"{options.max_error:.1f} m; mend EXIF, or set metres_per_unit in transforms.json"
        )
        if spread < TOLERANCE:
            reason = (
                f"the positions by GPS lie {spread:.1f} m apart, too near for what GPS is off by; "
                "set metres_per_unit in transforms.json"
            )
        return _by_direction(up, reason)
    matrix, inlier = found["tgt_from_src"].matrix(), np.asarray(found["inlier_mask"], dtype=bool)
    scale = float(np.linalg.det(matrix[:, :3])) ** (1.0 / 3.0)
    turn = roll_upright(matrix[:, :3] / scale, gps[known][inlier], up, options.max_error)
    middles = gps[known][inlier].mean(axis=0), centres[known][inlier].mean(axis=0)
    placed = Placement(scale, turn, middles[0] - scale * turn @ middles[1])
    residuals = np.linalg.norm(placed.apply(centres) - gps, axis=1)
    return Placement(scale, turn, placed.shift, residuals)


def tolerance(spread: float) -> float:
    """How far a position may be from its pose, metres, of positions with that spread in metres."""
    return min(TOLERANCE, max(TOLERATED * spread, min(RECEIVER, LEAST_TOLD * spread)))


def roll_upright(turn: Array, places: Array, up: Array, width: float) -> Array:
    """A rotation [3, 3], rolled about the line of flight so that `up` goes up.

    Places [N, 3] on a line say nothing of that roll. Of places that are wider than `width` metres
    across, the rotation stays as it is.
    """
    away = places - places.mean(axis=0)
    _, lengths, axes = np.linalg.svd(away, full_matrices=False)
    across = lengths[1] / np.sqrt(len(places))
    if across > width:
        return turn
    line = axes[0]
    wanted, is_up = (each - (each @ line) * line for each in (np.array([0, 0, 1.0]), turn @ up))
    if min(np.linalg.norm(wanted), np.linalg.norm(is_up)) < WANDERING:
        return turn
    angle = np.arctan2(line @ np.cross(is_up, wanted), is_up @ wanted)
    return rotation(angle * line) @ turn


def _by_direction(up: Array, reason: str) -> Placement:
    """Upright, in the reconstruction's own units."""
    axis = np.cross(up, [0.0, 0.0, 1.0])
    angle = np.arctan2(np.linalg.norm(axis), up[2])
    axis = axis / np.linalg.norm(axis) if np.linalg.norm(axis) > 1e-9 else np.eye(3)[0]
    return Placement(1.0, rotation(angle * axis), np.zeros(3), reason=reason)
