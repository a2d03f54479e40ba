"""The gates that are tried, from small to large."""

from __future__ import annotations

from dataclasses import replace

from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.gate import Gate, GateConfig

FREQUENCY = (
    *((3, 8, 1), (4, 8, 1), (4, 16, 1), (4, 16, 2), (5, 16, 2), (6, 16, 2), (6, 24, 2)),
    *((6, 32, 2), (6, 32, 3), (6, 48, 3), (6, 64, 3), (8, 64, 3), (8, 96, 3), (8, 128, 4)),
)
"""Octaves, width and layers of gates on frequencies."""
ENOUGH_OCTAVES = 5
"""From so many on, a gate without a norm decides as well as one with it, and answers sooner."""
HASH_TABLES = (6, 7, 8)
"""Binary logarithms of the entries a level of gates on hash grids."""
PLANES = ((16, 2), (32, 2), (64, 2), (64, 4), (128, 4))
"""Cells, and features or components, of gates on K-planes and on vector-matrix products."""


def ladder(most_values: int) -> list[GateConfig]:
    """Gates with fewer values than given, by their number; one scene expert, for o(x) is all that
    is asked of an occupancy."""
    gates = [
        GateConfig(EncodingConfig(octaves=octaves), width, layers, 1, octaves < ENOUGH_OCTAVES)
        for octaves, width, layers in FREQUENCY
    ]
    for table in HASH_TABLES:
        grid = EncodingConfig("hash", levels=4, log2_table=table, finest=64)
        gates.append(GateConfig(grid, 16, 1, 1))
    for cells, features in PLANES:
        planes = EncodingConfig(plane_cells=cells, levels=1, coarsest=cells)
        gates += [
            GateConfig(replace(planes, kind="k-planes", features=features), 16, 1, 1),
            GateConfig(replace(planes, kind="vm", components=features), 16, 1, 1),
        ]
    counted = sorted((values_of(gate), i) for i, gate in enumerate(gates))
    return [gates[i] for values, i in counted if values < most_values]


def values_of(config: GateConfig) -> int:
    """Learned numbers of a gate, counted without allocating it."""
    import torch

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
