"""The procedural city: one configuration, one exact geometry, and the questions asked of it.

Positions are in metres, +z up, the ground at z = 0, the city centred on the origin.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leco_plugin.scenes.city.plan import centres, choose_blocks, plan_city
from leco_plugin.scenes.city.queries import Faces, Solids
from leco_plugin.scenes.city.shapes import Array
from leco_plugin.scenes.input_error import one_line

DESCRIPTION = "city.json"


@dataclass(frozen=True)
class CityConfig:
    """Everything that determines a city. ValueError for what cannot be built."""

    blocks: int = 3
    """The city covers blocks x blocks blocks, some of them missing at the rim."""
    seed: int = 0
    """Another seed, another city."""
    block_size: float = 40.0
    """From one street's middle to the next, in metres."""
    sky: bool = False
    """A sky behind the city; without it, rays that miss are transparent."""
    far_terrain: bool = False
    """A plain around the city and hills at several times its size."""

    def __post_init__(self) -> None:
        if not 1 <= self.blocks <= 64:
            raise ValueError(f"a city has 1 to 64 blocks a side, not {self.blocks}")
        if self.seed < 0:
            raise ValueError(f"a city's seed is not negative, as {self.seed} is")
        if not 32 <= self.block_size <= 200:
            raise ValueError(f"a block is 32 to 200 metres wide, not {self.block_size}")


class City:
    """The geometry of one city."""

    def __init__(self, config: CityConfig) -> None:
        self.config = config
        self.built = choose_blocks(config.blocks, config.seed)
        """Which cells of the blocks x blocks square hold a block: bool [blocks, blocks]."""
        self.centres = centres(self.built, config.block_size)
        """Centres of all cells, metres: [blocks, blocks, 2]."""
        shapes, palette = plan_city(self.built, config.block_size, config.seed, config.far_terrain)
        self.material, colour, self.anchor, self.pitch = map(np.array, zip(*palette))
        self.colour = colour.astype(np.float32)
        direction = np.array([direction for _, direction, _ in shapes.rectangles])
        flat = np.stack([face for face, _, _ in shapes.rectangles])
        fans = np.concatenate([fan for fan, _ in shapes.triangles])
        self._faces, self._solids = Faces(flat, fans), Solids(shapes)
        self.triangles = np.concatenate([_halves(flat, direction), fans])
        """All faces as triangles, counter-clockwise seen from the air, metres: [T, 3, 3]."""
        of_halves = np.repeat([number for _, _, number in shapes.rectangles], 2)
        of_fans = [np.full(len(fan), number) for fan, number in shapes.triangles]
        self.paint = np.concatenate([of_halves, *of_fans])
        """Row of each triangle in `material`, `colour`, `anchor`, `pitch`: int [T]."""

    @classmethod
    def from_folder(cls, folder: Path) -> City:
        """The city whose pictures `folder` holds. ValueError or OSError if it holds none."""
        return cls(CityConfig(**read_description(folder)["city"]))

    @cached_property
    def bounds(self) -> Array:
        """Low and high corner of all faces, metres: [2, 3]."""
        return np.stack([self.triangles.min((0, 1)), self.triangles.max((0, 1))])

    @cached_property
    def roof(self) -> float:
        """Height of the highest thing in the city proper, metres."""
        reach = np.abs(self.centres).max() + self.config.block_size
        near = np.abs(self.triangles[..., :2]).max((1, 2)) < reach
        return float(self.triangles[near, :, 2].max())

    def on_block(self, places: Array) -> NDArray[np.bool_]:
        """Whether each place [N, 2] (metres) is in a cell that is built: bool [N]."""
        cells = np.floor(places / self.config.block_size + len(self.built) / 2).astype(int)
        inside = ((cells >= 0) & (cells < len(self.built))).all(1)
        return inside & self.built[tuple(np.clip(cells, 0, len(self.built) - 1).T)]

    def occupied(self, positions: NDArray[Any]) -> NDArray[np.bool_]:
        """Whether each position [N, 3] (metres) lies inside solid matter: bool [N]."""
        return self._solids.contain(np.asarray(positions, dtype=np.float64))

    def distance(self, positions: NDArray[Any]) -> Array:
        """Distance (metres, not signed) from each position [N, 3] to the nearest surface: [N]."""
        return self._faces.distance(np.asarray(positions, dtype=np.float64))


def _halves(rectangles: Array, direction: NDArray[np.int64]) -> Array:
    """Two triangles for each axis-aligned rectangle [R, 2, 3], facing +-1 along its flat axis."""
    low, high = rectangles[:, 0], rectangles[:, 1]
    flat = np.argmin(high - low, axis=1)
    rows = np.arange(len(low))
    second, third = low.copy(), low.copy()
    u, v = (flat + 1) % 3, (flat + 2) % 3
    second[rows, u] = high[rows, u]
    third[rows, v] = high[rows, v]
    turn = (direction < 0)[:, None]
    b, d = np.where(turn, third, second), np.where(turn, second, third)
    return np.stack([np.stack([low, b, high], 1), np.stack([low, high, d], 1)], 1).reshape(-1, 3, 3)


def read_description(folder: Path) -> dict[str, Any]:
    """Reads and checks a folder's `city.json`. ValueError or OSError, in one line, if it is bad."""
    path = Path(folder) / DESCRIPTION
    if not path.is_file():
        raise FileNotFoundError(f"{folder} holds no city: there is no {DESCRIPTION}")
    try:
        description = json.loads(path.read_text())
        if description["format"] != 1:
            raise ValueError(f"format {description['format']} is not known")
        CityConfig(**description["city"])
        dict(description["capture"], layout=description["layout"])
    except (ValueError, TypeError, KeyError) as error:
        raise ValueError(f"{path} does not describe a city: {one_line(error)}") from error
    return dict(description)
