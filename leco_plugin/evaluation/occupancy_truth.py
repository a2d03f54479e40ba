"""An occupancy against the exact city: what it keeps of surfaces, and what it skips of air."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from leco_plugin.occupancy import Occupancy
from leco_plugin.scenes.city.truth import CityTruth

MOST_SURFACE_POINTS = 100_000
AIR_POINTS = 50_000
"""Positions drawn in the air over the city; those in or near matter are then left out."""


def compare_with_truth(
    occupancy: Occupancy, truth: CityTruth, aabb: Tensor, step_size: float, highest: float
) -> dict[str, Any]:
    """Both figures, over points that no training pixel has chosen.

    Args:
        occupancy: on any device.
        truth: the city in the model's coordinates.
        aabb: [6] the box in which rays are marched, scene units; far walls are no limit.
        step_size: of marching, scene units.
        highest: z of the highest camera, scene units.
    Returns:
        `kept_surface_recall`: share of the surface points in the middle of the test pixels that
        are kept; `free_space_skipped`: share of the points of `free_points` that are skipped. None
        where there is no such point.
    """
    surface = truth.visible_surface("test")
    air = free_points(truth, surface, aabb, step_size, highest)
    return {
        "kept_surface_recall": _share(kept(occupancy, _spread(surface, MOST_SURFACE_POINTS))),
        "free_space_skipped": _share(~kept(occupancy, air)),
    }


def free_points(
    truth: CityTruth, surface: Tensor, aabb: Tensor, step_size: float, highest: float
) -> Tensor:
    """Positions spread evenly over the air of the city, between its ground and its cameras.

    Args:
        surface: [P, 3] visible surface points, whose extent is that of the city.
    Returns:
        [F, 3], all inside `aabb`, outside matter, and farther than a step from every surface.
    """
    aabb = aabb.detach().cpu()
    low, high = surface.amin(dim=0), surface.amax(dim=0)
    high[2] = max(highest, float(high[2]))
    low, high = torch.maximum(low, aabb[:3]), torch.minimum(high, aabb[3:])
    unit = torch.rand(AIR_POINTS, 3, generator=torch.Generator().manual_seed(0))
    points = low + unit * (high - low)
    points = points[~truth.occupied(points)]
    return points[truth.distance(points) * truth.scale > step_size]


@torch.no_grad()
def kept(occupancy: Occupancy, points: Tensor) -> Tensor:
    """Whether each of the positions [N, 3] is kept: bool [N] on the CPU."""
    device = occupancy.threshold_value.device
    parts = [occupancy.occupied(part.to(device)).cpu() for part in points.split(1 << 16)]
    return torch.cat(parts) if parts else torch.zeros(0, dtype=torch.bool)


def _spread(points: Tensor, most: int) -> Tensor:
    """At most so many of the points, drawn evenly."""
    order = torch.randperm(len(points), generator=torch.Generator().manual_seed(0))
    return points[order[:most]]


def _share(mask: Tensor) -> float | None:
    return round(float(mask.double().mean()), 5) if len(mask) else None
