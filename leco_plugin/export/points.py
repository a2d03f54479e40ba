"""The surface of the kept set as coloured points, for anything that opens PLY."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from leco_plugin.evaluation.inspection import ViewBox, exposed, query, whole_box
from leco_plugin.occupancy import Occupancy
from leco_plugin.scenes.whole_files import write_whole

COLOURS = "magma"
"""Of matplotlib, for o(x) in [0, 1]: as in the picture of `leco inspect`."""


class KeptSurface(NamedTuple):
    """Middles of kept cells that touch a skipped one."""

    positions: Tensor
    """[P, 3] scene units."""
    values: Tensor
    """[P] o(x)."""


def kept_surface(occupancy: Occupancy, resolution: int) -> KeptSurface:
    """Where the kept set ends.

    Args:
        resolution: cells along the longest side of the space in which the gate was taught. Those of
            an unbounded scene grow with distance, as its mapping has it.
    Raises:
        ValueError: the resolution is not positive, or nothing is kept.
    """
    if resolution < 2:
        raise ValueError(f"a surface takes at least 2 cells along a side, not {resolution}")
    device = occupancy.threshold_value.device
    box = _mapped_box(occupancy)
    axes = [box.axis(number, count) for number, count in enumerate(box.cells(resolution))]
    mapped = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).to(device)
    positions = occupancy.space.unmap(mapped).cpu()
    values = query(occupancy, positions)
    chosen = exposed(values >= occupancy.threshold)
    if not bool(chosen.any()):
        raise ValueError(
            f"the occupancy keeps nothing in cells of 1/{resolution} of its space: there is no "
            "surface to export"
        )
    return KeptSurface(positions[chosen], values[chosen])


def _mapped_box(occupancy: Occupancy) -> ViewBox:
    """The part of the gate's cube in which it was taught."""
    if occupancy.space.kind != "box":
        return ViewBox(-torch.ones(3), torch.ones(3))
    box = whole_box(occupancy)
    device = occupancy.threshold_value.device
    low, high = occupancy.space.map(torch.stack([box.low, box.high]).to(device)).cpu()
    return ViewBox(low, high)


def write_ply(surface: KeptSurface, path: Path) -> None:
    """Writes binary PLY with a colour for each point; whole, or not at all.

    Raises:
        OSError: it cannot be written there.
    """
    import trimesh
    from matplotlib import colormaps

    colours = colormaps[COLOURS](surface.values.clamp(0.0, 1.0).numpy(), bytes=True)
    cloud = trimesh.PointCloud(surface.positions.numpy(), colors=colours)
    content = cloud.export(file_type="ply")
    write_whole(path, lambda file: file.write(content))
