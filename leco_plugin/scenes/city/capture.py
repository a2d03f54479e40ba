"""How a city is photographed: the camera, how many pictures, and which of them are held out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from leco_plugin.scenes.city.cameras import aerial_cameras, street_cameras
from leco_plugin.scenes.city.city import City
from leco_plugin.scenes.city.lens import Lens
from leco_plugin.scenes.city.shapes import Array


@dataclass(frozen=True)
class CaptureConfig:
    """How a city is photographed. ValueError for what cannot be taken."""

    width: int = 160
    """Width of the pictures in pixels."""
    height: int = 120
    """Height of the pictures in pixels."""
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
        return Lens(
            self.width,
            self.height,
            self.width / 2 / float(np.tan(np.deg2rad(self.field_of_view) / 2)),
        )


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
    """All views of a city, always the same for one configuration.

    Raises:
        ValueError: there is not one to train on and one to hold out.
    """
    blocks, seed = int(city.built.sum()), city.config.seed
    aerial = aerial_cameras(city, round(capture.aerial_per_block * blocks), seed)
    street = street_cameras(city, round(capture.street_per_block * blocks), seed)
    names = [f"aerial_{i:05d}" for i in range(len(aerial))]
    names += [f"street_{i:05d}" for i in range(len(street))]
    if len(names) < 2:
        raise ValueError(
            f"{len(names)} pictures are too few: at least one is trained on and one held out"
        )
    every = range(len(names))
    held_out = set(every[capture.test_every // 2 :: capture.test_every] or every[-1:])
    return [
        View(number, name, pose, number in held_out)
        for number, (name, pose) in enumerate(zip(names, np.concatenate([aerial, street])))
    ]
