"""Where the city is photographed from: a drone above the roofs, and people in the streets.

Poses are camera-to-world [3, 4] in metres, OpenGL axes (x right, y up, looking along -z).
"""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from leco_plugin.scenes.city.city import City
from leco_plugin.scenes.city.shapes import Array

EYE_HEIGHT = 2.0
_AHEAD = 0.6
"""How many blocks ahead of a street camera there must still be city."""
_CLEARANCE = 0.7
"""No camera is nearer to a surface than this, in metres."""


def look_at(position: Array, target: Array) -> Array:
    """Pose [3, 4] at `position` looking at `target`, upright where that means anything."""
    back = (position - target) / np.linalg.norm(position - target)
    up = np.array([0.0, 0.0, 1.0]) if abs(back[2]) < 0.999 else np.array([0.0, 1.0, 0.0])
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    return np.column_stack([right, np.cross(back, right), back, position])


def aerial_cameras(city: City, count: int, seed: int) -> Array:
    """Poses [count, 3, 4] above the roofs: a third nearly straight down, the rest at 45 degrees.

    Each looks at a place in a block, all blocks in turn, from each side in turn.
    """
    random = np.random.default_rng([seed, 11])
    blocks = city.centres[city.built]
    size = city.config.block_size
    order = np.concatenate(
        [random.permutation(len(blocks)) for _ in range(count // len(blocks) + 1)]
    )
    poses: list[Array] = []
    while len(poses) < count:
        number = len(poses)
        middle = blocks[order[number]]
        # Aimed a little inwards, so that the pictures at the rim show more city than void.
        place = middle * (1 - 0.5 / len(city.built)) + random.uniform(-0.35, 0.35, 2) * size
        target = np.array([*place, random.uniform(0, 8)])
        height = city.roof * random.uniform(1.25, 1.7) + 8
        turn = np.pi / 2 * (number // 3 % 4 + random.uniform(-0.35, 0.35))
        tilt = np.deg2rad(random.uniform(3, 12) if number % 3 == 0 else random.uniform(38, 50))
        away = (height - target[2]) * np.tan(tilt) * np.array([np.cos(turn), np.sin(turn)])
        poses.append(look_at(np.array([*(target[:2] + away), height]), target))
    return np.stack(poses) if poses else np.zeros((0, 3, 4))


def street_cameras(city: City, count: int, seed: int) -> Array:
    """Poses [count, 3, 4] in the streets at eye height, looking along them and a little up."""
    random = np.random.default_rng([seed, 12])
    poses: list[Array] = []
    while len(poses) < count:
        batch = np.stack([_street_pose(city, random) for _ in range(2 * count)])
        places, ahead = batch[:, :, 3], -batch[:, :, 2] * _AHEAD * city.config.block_size
        # Some streets lead out of the city; a picture of nothing teaches nothing.
        fit = city.on_block((places + ahead)[:, :2]) & ~city.occupied(places)
        poses += list(batch[fit & (city.distance(places) > _CLEARANCE)])
    return np.stack(poses[:count]) if count else np.zeros((0, 3, 4))


def _street_pose(city: City, random: Generator) -> Array:
    """A candidate pose [3, 4] in one of the four streets around some block."""
    blocks = city.centres[city.built]
    middle = blocks[random.integers(len(blocks))]
    size = city.config.block_size
    turn = np.pi / 2 * random.integers(4)
    out = np.round([np.cos(turn), np.sin(turn)])
    along = np.array([-out[1], out[0]]) * random.choice([-1, 1])
    place = middle + out * (size / 2 - random.uniform(0.0, 0.05) * size)
    place = place - along * random.uniform(0.1, 0.48) * size
    swing = random.uniform(-0.6, 0.6)
    ahead = along * np.cos(swing) + out * np.sin(swing)
    position = np.array([*place, EYE_HEIGHT + random.uniform(-0.3, 0.6)])
    return look_at(position, position + np.array([*ahead, random.uniform(0.02, 0.22)]))
