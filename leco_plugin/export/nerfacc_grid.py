"""An occupancy as the buffers of nerfacc's `OccGridEstimator`, for hosts that know only grids.

A cell is marked where any probed point of it is kept, so that a grid keeps more than the gate and
loses next to nothing of what the gate keeps.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import max_pool3d

from leco_plugin.evaluation.inspection import numbers, query
from leco_plugin.export.cell_limit import require_few
from leco_plugin.occupancy import Occupancy
from leco_plugin.samplers.grid import OccupancyGridEstimator
from leco_plugin.scenes.whole_files import write_whole

STEPS = 2
"""Steps from one corner of a cell to the next: 27 probed points, those on faces shared."""
POINTS_AT_ONCE = 1 << 20
MOST_LEVELS = 8


def grid_buffers(
    occupancy: Occupancy,
    resolution: int = 128,
    levels: int | None = None,
    on_progress: Callable[[float], None] | None = None,
) -> dict[str, Tensor]:
    """What `OccGridEstimator(aabb, resolution, levels).load_state_dict` takes.

    Args:
        resolution: cells along each axis of each level.
        levels: nested boxes, each twice as wide as the one inside it. None is one for a bounded
            scene, and as many as its rays reach, at most `MOST_LEVELS`, for an unbounded one.
        on_progress: called with the share that is done.
    Returns:
        `resolution` int32 [3], `aabbs` [levels, 6] scene units, `occs` [levels * cells] with the
        largest o(x) probed in each cell, `binaries` bool [levels, n, n, n].
    Raises:
        ValueError: a size is out of range, or an unbounded scene is to fit one box.
    """
    unbounded = occupancy.space.kind != "box"
    if levels is None:
        levels = reaching_levels(occupancy) if unbounded else 1
    if resolution < 1 or levels < 1:
        raise ValueError(
            f"{levels} levels of {resolution}^3 cells: a grid has at least one level and one cell"
        )
    require_few(levels * resolution**3, f"{levels} x {resolution}^3")
    if unbounded and levels == 1:
        raise ValueError(
            "the scene is unbounded, and a grid of one level ends at its innermost box: give two "
            "levels or more, or none to have them counted"
        )
    grid = OccupancyGridEstimator(innermost_box(occupancy), resolution, levels)
    parts = []
    slabs = sum(len(range(0, resolution, _layers(resolution))) for _ in range(levels))
    for box in grid.aabbs:
        for values in _largest_in_cells(occupancy, box, resolution):
            parts.append(values)
            if on_progress is not None:
                on_progress(len(parts) / slabs)
    largest = torch.cat(parts).view(levels, resolution, resolution, resolution)
    return {
        "resolution": grid.resolution,
        "aabbs": grid.aabbs,
        "occs": largest.reshape(-1).clone(),
        "binaries": largest >= occupancy.threshold,
    }


def innermost_box(occupancy: Occupancy) -> Tensor:
    """Corners [6] of the box of a bounded scene, or of the uncontracted cube of another one."""
    center, half = occupancy.space.center.cpu(), occupancy.space.half_extent.cpu()
    low, high = center - half, center + half
    if occupancy.space.kind == "box":
        walls = occupancy.walls.cpu()
        low, high = torch.maximum(low, walls[:3]), torch.minimum(high, walls[3:])
    return torch.cat([low, high])


def reaching_levels(occupancy: Occupancy) -> int:
    """Levels with which the outermost box holds the rays of all cameras, 2 to `MOST_LEVELS`."""
    far = numbers([occupancy.report.get("far")])
    listed = occupancy.report.get("cameras")
    rows = [numbers(row) for row in listed] if isinstance(listed, list) else []
    center = occupancy.space.center.tolist()
    reach = max(
        (abs(x - c) for row in rows if len(row) == 3 for x, c in zip(row, center)), default=0.0
    )
    if not far:
        return MOST_LEVELS
    widest = (reach + max(far[0], 0.0)) / float(occupancy.space.half_extent)
    return min(max(1 + math.ceil(math.log2(max(widest, 1.0))), 2), MOST_LEVELS)


def write_grid(buffers: dict[str, Tensor], path: Path) -> None:
    """Writes the buffers as `torch.save` does; `torch.load(..., weights_only=True)` reads them.

    Raises:
        OSError: it cannot be written there.
    """
    write_whole(path, lambda file: torch.save(buffers, file))


def _layers(resolution: int) -> int:
    """Layers of cells that are asked about together."""
    return max(1, POINTS_AT_ONCE // (STEPS * (STEPS * resolution + 1) ** 2))


def _largest_in_cells(occupancy: Occupancy, box: Tensor, resolution: int) -> Iterator[Tensor]:
    """The largest o(x) probed in each cell of a box, some layers [k, n, n] at a time."""
    low, high = box[:3], box[3:]
    shares = torch.linspace(0.0, 1.0, STEPS * resolution + 1)
    x, y, z = (torch.lerp(low[axis], high[axis], shares) for axis in range(3))
    layers = _layers(resolution)
    for first in range(0, resolution, layers):
        last = min(first + layers, resolution)
        of_slab = x[STEPS * first : STEPS * last + 1]
        positions = torch.stack(torch.meshgrid(of_slab, y, z, indexing="ij"), dim=-1)
        values = query(occupancy, positions)
        yield max_pool3d(values[None, None], STEPS + 1, STEPS)[0, 0]
