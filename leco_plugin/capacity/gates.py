"""Gates and grids of growing size."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.gate import Gate, GateConfig

FREQUENCY_SIZES = ((3, 8, 1), (4, 16, 1), (5, 16, 2), (6, 32, 2), (8, 64, 2), (6, 64, 3))
"""Octaves, width and layers of the gates that `leco capacity` compares."""
HASH_SIZES = ((4, 8, 64), (4, 10, 128), (6, 12, 256), (8, 14, 512), (8, 16, 1024))
"""Levels, binary logarithm of the entries of each, and cells of the finest along an axis."""
PRODUCT_SIZES = ((16, 2), (32, 4), (64, 8), (128, 8))
"""Cells along an axis, and components."""
PLANE_SIZES = ((16, 2, 1), (32, 2, 1), (32, 4, 1), (64, 4, 2), (128, 2, 4))
"""Cells along an axis, features and levels."""
FREQUENCY = (
    *((3, 8, 1), (4, 8, 1), (4, 16, 1), (4, 16, 2), (5, 16, 2), (6, 16, 2), (6, 24, 2)),
    *((6, 32, 2), (6, 32, 3), (6, 48, 3), (6, 64, 3), (8, 64, 3), (8, 96, 3), (8, 128, 4)),
)
"""Octaves, width and layers of the ladder's gates on frequencies."""
ENOUGH_OCTAVES = 5
"""From so many on, a gate without a norm decides as well as one with it, and answers sooner."""
HASH_TABLES = (6, 7, 8)
"""Binary logarithms of the entries a level of the ladder's gates on hash grids."""
PLANES = ((16, 2), (32, 2), (64, 2), (64, 4), (128, 4))
"""Cells, and features or components, of the ladder's gates on K-planes and TensoRF's products."""


@dataclass(frozen=True)
class Candidate:
    """A gate or a grid of one size, as `leco capacity` compares them."""

    family: str
    size: str
    gate: GateConfig | None = None
    resolution: int | None = None

    @property
    def key(self) -> str:
        """Name of its file."""
        return f"{self.family}-{self.size}"

    @property
    def bytes(self) -> int:
        """A gate's numbers in bfloat16, a grid's cells in bits."""
        if self.gate is not None:
            return 2 * values_of(self.gate)
        assert self.resolution is not None
        return math.ceil(self.resolution**3 / 8)


def gates() -> list[Candidate]:
    """Gates of growing size of each kind, for `leco capacity`."""
    found = []
    for octaves, width, layers in FREQUENCY_SIZES:
        gate = GateConfig(EncodingConfig(octaves=octaves), width, layers, 1)
        found.append(Candidate("frequency", f"{octaves}-{width}-{layers}", gate))
    for levels, table, finest in HASH_SIZES:
        encoding = EncodingConfig("hash", levels=levels, log2_table=table, finest=finest)
        found.append(Candidate("hash", f"{levels}-{table}", GateConfig(encoding, 16, 1, 1)))
    for cells, components in PRODUCT_SIZES:
        encoding = EncodingConfig("vm", components=components, plane_cells=cells)
        found.append(Candidate("vm", f"{cells}-{components}", GateConfig(encoding, 16, 1, 1)))
    for cells, features, levels in PLANE_SIZES:
        gate = _on_planes(cells, features, levels)
        found.append(Candidate("k-planes", f"{cells}-{features}-{levels}", gate))
    return found


def grids(resolutions: tuple[int, ...]) -> list[Candidate]:
    """Grids by their cells along an axis."""
    return [Candidate("grid", str(n), resolution=n) for n in sorted(resolutions)]


def ladder(most_values: int) -> list[GateConfig]:
    """The gates that `leco shrink` tries, by size: all that have fewer values than given.

    They have one scene expert, for o(x) is all that is asked of an occupancy.
    """
    found = [
        GateConfig(EncodingConfig(octaves=octaves), width, layers, 1, octaves < ENOUGH_OCTAVES)
        for octaves, width, layers in FREQUENCY
    ]
    for table in HASH_TABLES:
        grid = EncodingConfig("hash", levels=4, log2_table=table, finest=64)
        found.append(GateConfig(grid, 16, 1, 1))
    for cells, features in PLANES:
        products = EncodingConfig(
            "vm", components=features, plane_cells=cells, levels=1, coarsest=cells
        )
        found += [_on_planes(cells, features, 1), GateConfig(products, 16, 1, 1)]
    counted = sorted((values_of(gate), i) for i, gate in enumerate(found))
    return [found[i] for values, i in counted if values < most_values]


def _on_planes(cells: int, features: int, levels: int) -> GateConfig:
    """A gate on K-planes: one level of `cells` along an axis, or several from 16 up to that."""
    coarsest = 16 if levels > 1 else cells
    encoding = EncodingConfig(
        "k-planes", levels=levels, features=features, coarsest=coarsest, plane_cells=cells
    )
    return GateConfig(encoding, 16, 1, 1)


def values_of(config: GateConfig) -> int:
    """Learned numbers of a gate, counted without allocating it."""
    with torch.device("meta"):
        return sum(parameter.numel() for parameter in Gate(config).parameters())


def name_of(config: GateConfig) -> str:
    """A gate in a word or two, as in tables."""
    encoding = config.encoding
    sizes = {
        "frequency": f"{encoding.octaves} octaves",
        "hash": f"hash {encoding.levels} x 2^{encoding.log2_table}",
        "vm": f"VM {encoding.components} x {encoding.plane_cells}",
        "k-planes": f"K-planes {encoding.levels} x {encoding.features} x {encoding.plane_cells}",
    }
    return f"{sizes[encoding.kind]}, {config.layers} x {config.width}"
