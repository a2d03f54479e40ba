"""The coordinates of Mega-NeRF's format, and whether its first axis really points down.

Its world is (down, right, back), in units of `pose_scale_factor` metres around `origin_drb`; the
model's is (right, forward, up) in the same units. Camera axes are OpenGL's in both.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from leco_plugin.scenes.city.shapes import Array

TO_DRB = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""(right, forward, up) to (down, right, back). A rotation; its inverse is its transpose."""
_DIRECTIONS = {
    "down": (0, 1.0),
    "up": (0, -1.0),
    "right": (1, 1.0),
    "left": (1, -1.0),
    "back": (2, 1.0),
    "forward": (2, -1.0),
}
"""What the format calls its axes and their opposites: axis and sign."""
_UPRIGHT, _CLEARLY = 0.6, 0.9
"""Shares of cameras that are upright: fewer is suspicious, more is clear. Street views with a roll
and nadir strips of one heading lie in between, and pass."""


@dataclass(frozen=True)
class Coordinates:
    """What `coordinates.pt` says."""

    origin_drb: Array
    """[3] metres, (down, right, back): where the scene's origin lies."""
    metres: float
    """Metres in a unit, `pose_scale_factor`."""

    def to_model(self, poses: Array) -> Array:
        """Poses [C, 3, 4] of the files as (right, forward, up), still in units of `metres`."""
        return TO_DRB.T @ poses

    def to_file(self, poses: Array) -> Array:
        """Poses [C, 3, 4] in metres, (right, forward, up), as the files hold them."""
        turned = TO_DRB @ poses
        turned[:, :, 3] = (turned[:, :, 3] - self.origin_drb) / self.metres
        return turned

    def altitudes(self, poses: Array) -> Array:
        """Metres above the datum, up is positive, of poses [C, 3, 4] of the files: [C]."""
        return -(poses[:, 0, 3] * self.metres + self.origin_drb[0])

    def height_of(self, down: float) -> float:
        """The model's z of a level that lies so many metres down from the datum."""
        return float(self.origin_drb[0] - down) / self.metres

    def transform(self) -> Array:
        """[3, 4] from metres (down, right, back) to the model's axes, before scaling."""
        return np.column_stack([TO_DRB.T, -TO_DRB.T @ self.origin_drb])


def around(positions: Array) -> Coordinates:
    """Coordinates in which cameras at [C, 3] metres, (right, forward, up), lie within [-1, 1]."""
    places = positions @ TO_DRB.T
    origin = (places.min(0) + places.max(0)) / 2
    return Coordinates(origin, max(float(np.abs(places - origin).max()), 1e-3))


def wrong_axis(poses: Array) -> str | None:
    """Why the poses [C, 3, 4] of a scene are not (down, right, back), or None if they may be.

    A camera is taken to be upright: its right axis is level, it does not look far above the
    horizon, and its top is not below. Whichever direction is down, nearly all cameras of a survey
    agree on it.
    """
    rights, tops, looks = poses[:, :, 0], poses[:, :, 1], -poses[:, :, 2]

    def upright(axis: int, sign: float) -> float:
        level = np.abs(rights[:, axis]) < 0.35
        return float(
            np.mean(level & (sign * looks[:, axis] > -0.35) & (sign * tops[:, axis] < 0.35))
        )

    shares = {name: upright(*where) for name, where in _DIRECTIONS.items()}
    # Of directions that fit equally well, down is the one that cameras look along.
    downward = {name: float(s * looks[:, a].mean()) for name, (a, s) in _DIRECTIONS.items()}
    best = max(shares, key=lambda name: (shares[name] >= _CLEARLY, downward[name]))
    if shares["down"] > _UPRIGHT or shares[best] < _CLEARLY:
        return None
    if best == "up":
        return "the first axis of its world points up and not down: nearly all cameras look up"
    return (
        f"the first axis of its world does not point down, as the cameras look {best}; poses "
        "aligned to east, north, up are to be turned before they are converted"
    )
