"""An occupancy grid that fits a scene's bounds, found from the data."""

from __future__ import annotations

import torch
from torch import Tensor

from leco_plugin.samplers.grid import OccupancyGridEstimator
from leco_plugin.space import Space


def scene_grid(space: Space, aabb: Tensor, resolution: int, levels: int) -> OccupancyGridEstimator:
    """An empty grid, whose innermost box is what the space maps without contraction.

    Args:
        aabb: [6] corners of the box in which rays are marched; the grid ends there too.
        resolution: cells along each axis.
        levels: nested boxes; a bounded scene needs one.
    """
    low, high = aabb.view(2, 3)
    low = low.maximum(space.center - space.half_extent)
    high = high.minimum(space.center + space.half_extent)
    return OccupancyGridEstimator(torch.cat([low, high]), resolution, levels)
