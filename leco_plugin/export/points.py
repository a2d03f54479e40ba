"""The surface of the kept set as coloured points, for anything that opens PLY."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from leco_plugin.evaluation.inspection import ViewBox, exposed, numbers, query, whole_box
from leco_plugin.export.cell_limit import MOST_CELLS, require_few
from leco_plugin.occupancy import Occupancy
from leco_plugin.scenes.frames import inverse
from leco_plugin.scenes.whole_files import write_whole

COLOURS = "magma"
"""Of matplotlib, for o(x) in [0, 1]: as in the picture of `leco inspect`."""
COLOUR = ("red", "green", "blue", "alpha")
CELLS_AT_ONCE = 1 << 20
"""Of which the places are known together; of the others only o(x)."""


class KeptSurface(NamedTuple):
    """Middles of kept cells that touch a skipped one."""

    positions: Tensor
    """[P, 3] scene units, or float64 in coordinates of the data."""
    values: Tensor
    """[P] o(x)."""


def kept_surface(
    occupancy: Occupancy, resolution: int, on_progress: Callable[[float], None] | None = None
) -> KeptSurface:
    """Where the kept set ends.

    Args:
        resolution: cells along the longest side of the space in which the gate was taught. Those of
            an unbounded scene grow with distance, as its mapping has it.
        on_progress: called with the share that is done.
    Raises:
        ValueError: the resolution is below 2 or makes too many cells, or nothing is kept.
    """
    if resolution < 2:
        raise ValueError(f"a surface takes at least 2 cells along a side, not {resolution}")
    box = _mapped_box(occupancy)
    counts = box.cells(min(resolution, MOST_CELLS))  # which are too many along one side alone
    require_few(math.prod(counts), f"{resolution} along the longest side")
    axes = [box.axis(number, count) for number, count in enumerate(counts)]
    cells, parts = math.prod(counts), []
    for first in range(0, cells, CELLS_AT_ONCE):
        numbers = torch.arange(first, min(first + CELLS_AT_ONCE, cells))
        indices = torch.unravel_index(numbers, counts)
        places = [axis[index] for axis, index in zip(axes, indices)]
        parts.append(query(occupancy, _positions(occupancy, places)))
        if on_progress is not None:
            on_progress((first + len(numbers)) / cells)
    values = torch.cat(parts).view(*counts)
    chosen = exposed(values >= occupancy.threshold)
    if not bool(chosen.any()):
        raise ValueError(
            f"the occupancy keeps nothing in cells of 1/{resolution} of its space: there is no "
            "surface to export"
        )
    places = [axis[index] for axis, index in zip(axes, chosen.nonzero(as_tuple=True))]
    return KeptSurface(_positions(occupancy, places), values[chosen])


def _positions(occupancy: Occupancy, mapped: Sequence[Tensor]) -> Tensor:
    """Scene positions [..., 3] on the CPU, of their three mapped coordinates [...] each."""
    device = occupancy.threshold_value.device
    return occupancy.space.unmap(torch.stack(list(mapped), dim=-1).to(device)).cpu()


def _mapped_box(occupancy: Occupancy) -> ViewBox:
    """The part of the gate's cube in which it was taught."""
    if occupancy.space.kind != "box":
        return ViewBox(-torch.ones(3), torch.ones(3))
    box = whole_box(occupancy)
    device = occupancy.threshold_value.device
    low, high = occupancy.space.map(torch.stack([box.low, box.high]).to(device)).cpu()
    return ViewBox(low, high)


def to_the_data(occupancy: Occupancy) -> Tensor | None:
    """Takes positions of the run to those that the data's own files have: [3, 4] float64.

    None where the file does not say how its run turned, moved and scaled the data. Files of before
    `data_frame` was recorded lead to the coordinates before any `applied_transform`.
    """
    frame = occupancy.report.get("data_frame") or occupancy.report.get("frame")
    rows = [numbers(row) for row in frame] if isinstance(frame, list) else []
    if [len(row) for row in rows] != [4, 4, 4]:
        return None
    known = torch.tensor(rows, dtype=torch.float64)
    return inverse(known) if float(known[:, :3].det()) != 0.0 else None


def write_ply(surface: KeptSurface, path: Path) -> None:
    """Writes binary PLY of float64 with a colour for each point; whole, or not at all.

    Raises:
        OSError: it cannot be written there.
    """
    from matplotlib import colormaps

    names = ("x", "<f8"), ("y", "<f8"), ("z", "<f8"), *((c, "u1") for c in COLOUR)
    rows = np.empty(len(surface.values), dtype=list(names))
    colours = colormaps[COLOURS](surface.values.clamp(0.0, 1.0).numpy(), bytes=True)
    for number, axis in enumerate("xyz"):
        rows[axis] = surface.positions[:, number].numpy()
    for number, name in enumerate(COLOUR):
        rows[name] = colours[:, number]
    properties = [f"property double {axis}" for axis in "xyz"]
    properties += [f"property uchar {name}" for name in COLOUR]
    count = f"element vertex {len(rows)}"
    head = ["ply", "format binary_little_endian 1.0", count, *properties, "end_header\n"]
    content = "\n".join(head).encode() + rows.tobytes()
    write_whole(path, lambda file: file.write(content))
