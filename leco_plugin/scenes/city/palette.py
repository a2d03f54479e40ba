"""What the city is painted with: materials, and the paints that the plan mixes from them."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum

STOREY = 3.2
"""Height of a storey in metres: of the walls and of the windows painted on them."""


class Material(IntEnum):
    """How a face is coloured; `texture` gives each its pattern."""

    STREET, PAVEMENT, WALL, ROOF, TILES, GRASS, EARTH, LEAVES, METAL, TERRAIN = range(10)


@dataclass
class Palette:
    """One row per painted thing: material, base colour (RGB in 0..1), anchor and window pitch."""

    material: list[int] = field(default_factory=list)
    colour: list[tuple[float, float, float]] = field(default_factory=list)
    anchor: list[tuple[float, float, float]] = field(default_factory=list)
    """Where the pattern starts, metres."""
    pitch: list[tuple[float, float]] = field(default_factory=list)
    """Spacing of the windows along x and along y, metres."""

    def add(
        self,
        material: Material,
        colour: tuple[float, float, float],
        anchor: tuple[float, float, float] = (0.0, 0.0, 0.0),
        pitch: tuple[float, float] = (3.0, 3.0),
    ) -> int:
        """Returns the number of the new paint."""
        self.material.append(int(material))
        self.colour.append(colour)
        self.anchor.append(anchor)
        self.pitch.append(pitch)
        return len(self.material) - 1


WALLS = [
    (0.80, 0.74, 0.63),
    (0.67, 0.37, 0.29),
    (0.74, 0.72, 0.70),
    (0.86, 0.80, 0.55),
    (0.52, 0.59, 0.66),
    (0.79, 0.56, 0.42),
    (0.90, 0.88, 0.84),
    (0.45, 0.33, 0.29),
    (0.58, 0.66, 0.57),
]
FLAT_ROOFS = [
    (0.55, 0.54, 0.52),
    (0.42, 0.42, 0.44),
    (0.66, 0.62, 0.56),
    (0.50, 0.46, 0.42),
    (0.47, 0.53, 0.49),
]
TILES = [
    (0.66, 0.30, 0.20),
    (0.52, 0.25, 0.20),
    (0.37, 0.34, 0.35),
    (0.72, 0.42, 0.28),
    (0.30, 0.36, 0.42),
]
CARS = [
    (0.75, 0.10, 0.10),
    (0.90, 0.90, 0.92),
    (0.12, 0.14, 0.17),
    (0.15, 0.30, 0.62),
    (0.60, 0.62, 0.65),
    (0.88, 0.68, 0.10),
]
LEAVES = [(0.20, 0.38, 0.14), (0.30, 0.44, 0.16), (0.40, 0.46, 0.18), (0.16, 0.32, 0.18)]
