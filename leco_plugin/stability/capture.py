"""How a case's scene is photographed: where from, how large, and what goes wrong meanwhile.

What goes wrong touches the training pictures only: the held-out ones show what is really there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from leco_plugin.scenes.city.cameras import Lens, look_at
from leco_plugin.stability.matter import Array

RADIUS = 5.0
"""Of the circle that cameras stand on, metres."""
STRAY_RADIUS = 9.0
"""Of a camera that stands far off, metres."""


@dataclass(frozen=True)
class Capture:
    """All of it as data: two captures that are equal give the same pictures."""

    views: int = 48
    """Training pictures: so many, so wide and from so far that three of them show nearly all that
    the held-out ones show. From 40 narrow ones nearer by, a wall was placed by chance."""
    test_views: int = 16
    """Held-out pictures."""
    width: int = 64
    """Of a picture, pixels."""
    height: int = 48
    """Of a picture, pixels."""
    field_of_view: float = 60.0
    """Horizontal opening angle, degrees."""
    stand: str = "around"
    """`around` the scene and above it, `low` around it with the horizon in view, or `inside`."""
    stray: int = 0
    """Of the training pictures, how many are taken from far outside."""
    exposure: float = 0.0
    """Standard deviation of the exposure, stops."""
    shift: float = 0.0
    """Standard deviation of each coordinate that is written of a camera's position, metres."""
    turn: float = 0.0
    """Standard deviation of each angle that is written of its attitude, degrees."""
    moving: bool = False
    """Whether a car drives through every third picture."""
    sizes: tuple[float, ...] = (1.0,)
    """Multiples of width and height that pictures take in turn."""
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where the scene's middle lies in the coordinates that are written, metres."""
    seed: int = 0
    """Another seed, other places to stand."""

    def lens(self, times: float = 1.0) -> Lens:
        """The camera of pictures of a multiple of the size."""
        width, height = round(times * self.width), round(times * self.height)
        return Lens(width, height, width / 2 / float(np.tan(np.deg2rad(self.field_of_view) / 2)))


@dataclass(frozen=True)
class Shot:
    """One picture to be taken."""

    name: str
    pose: Array
    """[3, 4] where the camera really is, metres, OpenGL axes."""
    written: Array
    """[3, 4] where the scene's description says it is."""
    held_out: bool
    size: float = 1.0
    """Multiple of width and height."""
    gain: float = 1.0
    """Multiple of the light."""
    moving: bool = False
    """Whether the car is there."""


def shots_of(capture: Capture) -> list[Shot]:
    """All pictures of a capture, always the same."""
    random = np.random.default_rng([capture.seed, 21])
    poses = [_pose(capture, random, number) for number in range(capture.views + capture.test_views)]
    places = (np.arange(capture.test_views) + 0.5) * len(poses) / capture.test_views
    held_out = set(places.astype(int).tolist())
    noise = np.random.default_rng([capture.seed, 22])
    shots: list[Shot] = []
    for number, pose in enumerate(poses):
        name = f"view_{number:03d}"
        if number in held_out:
            shots.append(Shot(name, pose, _moved(pose, capture), True))
            continue
        trained = number - sum(other < number for other in held_out)
        if trained < capture.stray:
            pose = pose.copy()
            pose[:, 3] *= STRAY_RADIUS / RADIUS
        shots.append(
            Shot(
                name,
                pose,
                _moved(_misjudged(pose, capture, noise), capture),
                False,
                capture.sizes[trained % len(capture.sizes)],
                float(2.0 ** (capture.exposure * noise.standard_normal())),
                capture.moving and trained % 3 == 0,
            )
        )
    return shots


def _pose(capture: Capture, random: Generator, number: int) -> Array:
    if capture.stand == "inside":
        turn, up = random.uniform(0, 2 * np.pi), random.uniform(-0.35, 0.05)
        x, y = random.uniform((-1.0, -2.9), (1.0, -0.9))
        position = np.array([x, y, random.uniform(1.2, 1.8)])
        return look_at(position, position + np.array([np.cos(turn), np.sin(turn), up]))
    turn = 2 * np.pi * (0.618034 * number + random.uniform(-0.05, 0.05))
    low, high = (1.0, 2.0) if capture.stand == "low" else (2.2, 4.0)
    place = RADIUS * np.array([np.cos(turn), np.sin(turn)])
    position = np.array([*place, random.uniform(low, high)])
    target_height = random.uniform(0.6, 1.6) if capture.stand == "low" else random.uniform(0, 0.6)
    return look_at(position, np.array([*random.uniform(-1.2, 1.2, 2), target_height]))


def _misjudged(pose: Array, capture: Capture, random: Generator) -> Array:
    """The pose as a bad survey would have it."""
    turned = rotation(np.deg2rad(capture.turn) * random.standard_normal(3))
    shifted = pose[:, 3] + capture.shift * random.standard_normal(3)
    return np.column_stack([turned @ pose[:, :3], shifted])


def _moved(pose: Array, capture: Capture) -> Array:
    return np.column_stack([pose[:, :3], pose[:, 3] + np.array(capture.origin)])


def rotation(turn: Array) -> Array:
    """The matrix [3, 3] of a turn around an axis [3] by its length in radians (Rodrigues)."""
    angle = float(np.linalg.norm(turn))
    x, y, z = turn / max(angle, 1e-12)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    matrix: Array = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
    return matrix
