"""How a city is photographed: the lens, where cameras stand, and which pictures are held out.

Poses are camera-to-world [3, 4] in metres, OpenGL axes (x right, y up, looking along -z).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from leco_plugin.scenes.city.city import City
from leco_plugin.scenes.city.shapes import Array

EYE_HEIGHT = 2.0
QUINCUNX = ((0.5, 0.5), (0.25, 0.25), (0.75, 0.25), (0.25, 0.75), (0.75, 0.75))
"""Places in a pixel that rays go through. The first gives the depth, all give the colour."""
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
    """Poses [count, 3, 4] above the roofs, a third nearly straight down, the rest at 45 degrees: at
    a place in each block in turn, from each side in turn."""
    random = np.random.default_rng([seed, 11])
    blocks = city.centres[city.built]
    size = city.config.block_size
    rounds = [random.permutation(len(blocks)) for _ in range(count // len(blocks) + 1)]
    poses: list[Array] = []
    for number, block in enumerate(np.concatenate(rounds)[:count]):
        middle = blocks[block]
        # Aimed a little inwards, so that the pictures at the rim show more city than void.
        place = middle * (1 - 0.5 / len(city.built)) + random.uniform(-0.35, 0.35, 2) * size
        target = np.array([*place, random.uniform(0, 8)])
        height = city.roof * random.uniform(1.25, 1.7) + 8
        turn = np.pi / 2 * (number // 3 % 4 + random.uniform(-0.35, 0.35))
        tilt = np.deg2rad(random.uniform(3, 12) if number % 3 == 0 else random.uniform(38, 50))
        away = (height - target[2]) * np.tan(tilt) * np.array([np.cos(turn), np.sin(turn)])
        poses.append(look_at(np.array([*(target[:2] + away), height]), target))
    return np.reshape(poses, (-1, 3, 4))


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
    return np.reshape(poses[:count], (-1, 3, 4))


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


@dataclass(frozen=True)
class Lens:
    """A pinhole camera without distortion; lengths in pixels, pixel middles at half numbers."""

    width: int
    height: int
    focal: float

    @property
    def intrinsics(self) -> dict[str, float]:
        """As transforms.json has them."""
        size = {"w": self.width, "h": self.height, "fl_x": self.focal, "fl_y": self.focal}
        return {**size, "cx": self.width / 2, "cy": self.height / 2}

    def directions(self, offset: tuple[float, float] = (0.5, 0.5)) -> Array:
        """Unit directions [height, width, 3], OpenGL axes, through a place in each pixel."""
        rows, columns = np.mgrid[: self.height, : self.width]
        x = (columns + offset[0] - self.width / 2) / self.focal
        y = (self.height / 2 - rows - offset[1]) / self.focal
        rays = np.stack([x, y, -np.ones_like(x)], -1)
        return rays / np.linalg.norm(rays, axis=-1, keepdims=True)

    def points(self, pose: Array, depth: NDArray[np.floating]) -> Array:
        """Points [height, width, 3] seen by a camera-to-world pose [3, 4] at ray depths."""
        return pose[:, 3] + np.asarray(depth)[..., None] * (self.directions() @ pose[:, :3].T)

    def some_points(
        self,
        pose: Array,
        depth: NDArray[np.floating],
        image: NDArray[np.uint8],
        most: int,
        random: Generator,
    ) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Up to `most` points [P, 3] of a picture [height, width, 3 or 4]; colours [P, 3]."""
        seen = np.argwhere(np.isfinite(depth))
        chosen = tuple(seen[random.permutation(len(seen))[:most]].T)
        return self.points(pose, depth)[chosen].astype(np.float32), image[chosen][:, :3]

    def axial(self, depth: NDArray[np.floating]) -> NDArray[np.float32]:
        """Depth files from ray depths (metres, inf for nothing): see `city.folder`."""
        axial = np.where(np.isfinite(depth), depth, 0) * -self.directions()[..., 2]
        return (1e3 * axial).astype(np.float32)

    def along_ray(self, axial: NDArray[np.floating]) -> Array:
        """The inverse of `axial`: metres along the ray, inf for nothing, [height, width]."""
        depth = axial.astype(np.float64) / (-1e3 * self.directions()[..., 2])
        return np.where(axial > 0, depth, np.inf)


@dataclass(frozen=True)
class CaptureConfig:
    """How a city is photographed, sizes in pixels. ValueError for what cannot be taken."""

    width: int = 160
    height: int = 120
    field_of_view: float = 60.0
    """Horizontal opening angle in degrees."""
    aerial_per_block: float = 8.5
    """Aerial pictures for each built block."""
    street_per_block: float = 1.5
    """Pictures from the street for each built block."""
    test_every: int = 8
    """Every so many-th picture is held out for testing."""

    def __post_init__(self) -> None:
        if not (8 <= self.width <= 8192 and 8 <= self.height <= 8192):
            raise ValueError(
                f"pictures have 8 to 8192 pixels a side, not {self.width} x {self.height}"
            )
        if not 10 <= self.field_of_view <= 120:
            raise ValueError(f"the field of view is 10 to 120 degrees, not {self.field_of_view}")
        if not (0 <= self.aerial_per_block <= 1000 and 0 <= self.street_per_block <= 1000):
            raise ValueError(
                "the pictures for each block are 0 to 1000 from the air and from the street"
            )
        if self.aerial_per_block + self.street_per_block == 0:
            raise ValueError("no pictures are asked for: both counts for each block are 0")
        if self.test_every < 2:
            raise ValueError(f"test_every is at least 2, not {self.test_every}")

    @property
    def lens(self) -> Lens:
        """The camera they are taken with."""
        half_angle = np.deg2rad(self.field_of_view) / 2
        return Lens(self.width, self.height, self.width / 2 / float(np.tan(half_angle)))


@dataclass(frozen=True)
class View:
    """One picture that is taken, or will be."""

    number: int
    """Its place among all views of the city."""
    name: str
    pose: Array
    """[3, 4] camera to world, metres, OpenGL axes."""
    held_out: bool
    """Whether it is for testing only."""


def views_of(city: City, capture: CaptureConfig) -> list[View]:
    """All views of a city, always the same for one configuration. ValueError for fewer than two."""
    blocks, seed = int(city.built.sum()), city.config.seed
    aerial = aerial_cameras(city, round(capture.aerial_per_block * blocks), seed)
    street = street_cameras(city, round(capture.street_per_block * blocks), seed)
    sets = {"aerial": aerial, "street": street}
    names = [f"{kind}_{i:05d}" for kind, poses in sets.items() for i in range(len(poses))]
    if len(names) < 2:
        few = "picture is" if len(names) == 1 else "pictures are"
        raise ValueError(f"{len(names)} {few} too few: at least one is trained on and one held out")
    every = range(len(names))
    held_out = set(every[capture.test_every // 2 :: capture.test_every] or every[-1:])
    return [
        View(number, name, pose, number in held_out)
        for number, (name, pose) in enumerate(zip(names, np.concatenate([aerial, street])))
    ]
