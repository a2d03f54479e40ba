"""The surface of `leco export`: where the rays of the photographs first meet what is kept.

The kept set itself is wider than what it is about, because a threshold that loses nothing keeps
air around every surface.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from leco_plugin.evaluation.inspection import ViewBox, cameras_of, exposed, query, whole_box
from leco_plugin.occupancy import Occupancy
from leco_plugin.scenes.whole_files import write_points

CELLS = 128
"""Along each side of a cube."""
MOST_CELLS = 1 << 28
"""Of an export: each holds some bytes until the file is written, which makes gigabytes."""
CELLS_AT_ONCE = 1 << 20
"""Cells whose places are known together; of the others only o(x) is."""
NEAR_PEAK = 0.9
"""Of the largest o(x) along a ray: from there on is matter."""
REACH = 1 / 16
"""Of the longest side, before and behind a cell, along which o(x) is compared."""
COLOURS = "magma"
"""Of matplotlib, for o(x) in [0, 1]: as in the picture of `leco inspect`."""

Progress = Callable[[float], None]
"""Called with the share that is done."""


class KeptSurface(NamedTuple):
    """Middles of kept cells on the surface."""

    positions: Tensor
    """[P, 3] scene units, or float64 in coordinates of the data."""
    values: Tensor
    """[P] o(x)."""


def kept_surface(
    occupancy: Occupancy, resolution: int, on_progress: Progress = lambda share: None
) -> KeptSurface:
    """Kept cells at which rays from the nearest camera first meet matter.

    Where the file names no cameras, all kept cells that touch a skipped one.

    Args:
        resolution: cells along the longest side of the space in which the gate was taught. Those of
            an unbounded scene grow with distance, as its mapping has it.
    Raises:
        ValueError: the resolution is below 2 or makes too many cells, or nothing is kept.
    """
    if resolution < 2:
        raise ValueError(f"a surface takes at least 2 cells along a side, not {resolution}")
    box = mapped_box(occupancy)
    counts = box.cells(min(resolution, MOST_CELLS))  # which are too many along one side alone
    require_few(math.prod(counts), f"{resolution} along the longest side")
    axes = [box.axis(number, count) for number, count in enumerate(counts)]
    cells, parts = math.prod(counts), []
    for first in range(0, cells, CELLS_AT_ONCE):
        numbers = torch.arange(first, min(first + CELLS_AT_ONCE, cells))
        indices = torch.unravel_index(numbers, counts)
        places = torch.stack([axis[index] for axis, index in zip(axes, indices)], dim=-1)
        parts.append(query(occupancy, _unmap(occupancy, places)))
        on_progress(0.3 * (first + len(numbers)) / cells)
    values = torch.cat(parts).view(*counts)
    kept, cameras = values >= occupancy.threshold, cameras_of(occupancy)
    if not bool(kept.any()):
        raise ValueError(
            f"the occupancy keeps nothing in cells of 1/{resolution} of its space: there is no "
            "surface to export"
        )
    chosen = kept if len(cameras) else exposed(kept)
    places = torch.stack(
        [axis[index] for axis, index in zip(axes, chosen.nonzero(as_tuple=True))], dim=-1
    )
    if len(cameras):
        cell = float((box.high - box.low).max()) / resolution
        met = []
        for number, part in enumerate(places.split(CELLS_AT_ONCE >> 4)):
            met.append(_first_met(occupancy, part, cameras, cell, round(REACH * resolution)))
            on_progress(0.3 + 0.7 * (number + 1) * (CELLS_AT_ONCE >> 4) / len(places))
        places = places[torch.cat(met)]
        chosen = chosen.masked_scatter(kept, torch.cat(met))
    return KeptSurface(_unmap(occupancy, places), values[chosen])


def _first_met(
    occupancy: Occupancy, places: Tensor, cameras: Tensor, cell: float, steps: int
) -> Tensor:
    """Whether rays from the nearest camera meet matter at mapped places [K, 3], and not before:
    bool [K].

    Args:
        cameras: [C, 3] scene units.
        cell: mapped size of a cell.
        steps: cells before and behind a place that are asked.
    """
    from scipy.spatial import KDTree

    eyes = occupancy.space.map(cameras.to(occupancy.threshold_value.device)).cpu()
    _, nearest = KDTree(eyes.numpy()).query(places.numpy())
    towards = torch.nn.functional.normalize(eyes[torch.from_numpy(nearest)] - places, dim=-1)
    shifts = range(-max(steps, 1), max(steps, 1) + 1)
    asked = torch.stack([places + shift * cell * towards for shift in shifts])
    inside = asked.abs().amax(dim=-1) < 1.0
    values = query(occupancy, _unmap(occupancy, torch.where(inside[..., None], asked, places)))
    values = torch.where(inside, values, 0.0)
    enough = values >= NEAR_PEAK * values.amax(dim=0)
    middle = len(shifts) // 2
    return enough[middle] & ~enough[middle + 1 :].any(dim=0)


def _unmap(occupancy: Occupancy, mapped: Tensor) -> Tensor:
    """Scene positions [..., 3] on the CPU, of mapped ones."""
    return occupancy.space.unmap(mapped.to(occupancy.threshold_value.device)).cpu()


def mapped_box(occupancy: Occupancy) -> ViewBox:
    """The part of the gate's cube in which it was taught."""
    if occupancy.space.kind != "box":
        return ViewBox(-torch.ones(3), torch.ones(3))
    box = whole_box(occupancy)
    device = occupancy.threshold_value.device
    low, high = occupancy.space.map(torch.stack([box.low, box.high]).to(device)).cpu()
    return ViewBox(low, high)


def finest(box: ViewBox) -> int:
    """Cells along the longest side with which a box has as many as a cube of `CELLS`."""
    return round(CELLS * (CELLS**3 / math.prod(box.cells(CELLS))) ** (1 / 3))


def require_few(cells: int, said: str) -> None:
    """Refuses more than `MOST_CELLS` cells, with a ValueError that says how they lie."""
    if cells > MOST_CELLS:
        raise ValueError(
            f"{said} are too many cells: an export has at most {MOST_CELLS} in all, as "
            f"{int(MOST_CELLS ** (1 / 3))}^3 are; give a smaller --resolution"
        )


def write_ply(
    surface: KeptSurface,
    path: Path,
    colours: np.ndarray | None = None,
    comments: Sequence[str] = (),
) -> None:
    """Writes binary PLY of float64 with a colour for each point.

    Args:
        colours: [P, 3] uint8; None colours by o(x).
        comments: lines for its head.
    Raises:
        OSError: it cannot be written there.
    """
    from matplotlib import colormaps

    rows = np.empty(len(surface.values), dtype=[("xyz", "<f8", 3), ("rgb", "u1", 4)])
    rows["xyz"] = surface.positions.numpy()
    if colours is None:
        rows["rgb"] = colormaps[COLOURS](surface.values.clamp(0.0, 1.0).numpy(), bytes=True)
    else:
        rows["rgb"] = np.pad(colours, ((0, 0), (0, 1)), constant_values=255)
    write_points(path, rows, comments)
