"""The `occupancy` of reports: figures of a run's occupancy, measured against the exact city."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from leco_plugin.evaluation.inspection import in_parts
from leco_plugin.evaluation.report import finite_or_null
from leco_plugin.occupancy import CALIBRATED_AT, Occupancy
from leco_plugin.scenes.city.city import DESCRIPTION
from leco_plugin.scenes.city.folder import CityTruth

FROM_REPORT = (
    "train_seconds",
    "empty_fraction",
    "lost_mass",
    "threshold",
    "lost_surface_mass",
    "image_price_db",
)
MOST_SURFACE_POINTS = 100_000
AIR_POINTS = 50_000
"""Positions drawn over the city; those in or near matter are then left out."""


def truth_of(folder: Path, manager: Any) -> CityTruth | None:
    """The exact scene in the coordinates of a data manager, where it is a city; None elsewhere."""
    if not (folder / DESCRIPTION).is_file():
        return None
    return CityTruth.from_dataparser(folder, manager.train_dataparser_outputs)


def occupancy_facts(
    occupancy: Occupancy, file: Path, manager: Any, truth: CityTruth | None
) -> dict[str, Any]:
    """Sizes, calibration, and the comparison with the exact scene: JSON values.

    Args:
        occupancy: in the coordinates of `manager`, from `file`.
        truth: the exact scene; without one its figures are None.
    """
    report = occupancy.report
    measured: dict[str, Any] = {"kept_surface_recall": None, "free_space_skipped": None}
    if truth is not None:
        highest = float(manager.train_dataset.cameras.camera_to_worlds[:, 2, 3].max())
        box = torch.tensor(report["aabb"])
        measured = compare_with_truth(occupancy, truth, box, report["step_size"], highest)
    facts: dict[str, Any] = {"params": occupancy.num_params, "bytes": file.stat().st_size}
    for name in ("recoveries", CALIBRATED_AT):  # not every file says
        facts[name] = report.get(name)
    return finite_or_null(facts | {name: report[name] for name in FROM_REPORT} | measured)


def compare_with_truth(
    occupancy: Occupancy, truth: CityTruth, aabb: Tensor, step_size: float, highest: float
) -> dict[str, Any]:
    """What an occupancy keeps of the surfaces of the city, and skips of its air.

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
    order = torch.randperm(len(surface), generator=torch.Generator().manual_seed(0))
    air = free_points(truth, surface, aabb, step_size, highest)
    return {
        "kept_surface_recall": _share(kept(occupancy, surface[order[:MOST_SURFACE_POINTS]])),
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
    return in_parts(lambda part: occupancy.occupied(part.to(device)).cpu(), points)


def _share(mask: Tensor) -> float | None:
    return round(float(mask.double().mean()), 5) if len(mask) else None
