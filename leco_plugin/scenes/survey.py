"""A look at the cameras before the first step: bounds, how many rays meet the scene, probe rays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from leco_plugin.models.rendering import Rays
from leco_plugin.samplers.rays import intersect_box
from leco_plugin.scenes.bounds import SceneBounds, find_bounds
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.photographs import POINTS

SIDE = 8
"""A grid of this many rays a side covers each image, its corners included."""
MOST_CAMERAS = 256


@dataclass(frozen=True)
class Survey:
    """What the cameras of a scene see, in model coordinates."""

    bounds: SceneBounds
    origins: Tensor
    """[K, 3] of rays that cover the training images."""
    directions: Tensor
    """[K, 3] unit vectors."""
    meeting: float
    """Share of those rays that meet the bounds."""
    median_length: float
    """Median length of those rays inside the bounds, scene units."""
    positions: Tensor
    """[C, 3] of up to `MOST_CAMERAS` cameras."""

    def describe(self) -> str:
        """One line for the log."""
        return (
            f"{self.bounds.reason}; rays from {self.bounds.near:.3f} to {self.bounds.far:.3f}; "
            f"{self.meeting:.0%} of all rays meet the scene"
        )

    def probe_rays(self, device: torch.device, aabb: Tensor, march_range: Tensor) -> Rays:
        """The rays of the survey, cut to a model's bounds; rays that miss are left out."""
        origins, directions = self.origins.to(device), self.directions.to(device)
        enters, leaves = intersect_box(origins, directions, aabb)
        t_mins, t_maxs = enters.clamp(min=march_range[0]), leaves.clamp(max=march_range[1])
        hits = (t_maxs > t_mins).nonzero()[:, 0]
        return Rays(origins[hits], directions[hits], t_mins[hits], t_maxs[hits], None)


def survey(datamanager: Any) -> Survey:
    """Looks at the training cameras of any nerfstudio data manager.

    Raises:
        InputError: no cameras, or no ray meets the scene.
    """
    dataset = datamanager.train_dataset
    cameras: Cameras = dataset.cameras
    if len(cameras) == 0:
        raise InputError("the scene has no training cameras")
    metadata = getattr(dataset, "metadata", {}) or {}
    points = metadata.get(POINTS, metadata.get("points3D_xyz"))
    origins, directions = covering_rays(cameras)
    try:
        bounds = find_bounds(cameras.camera_to_worlds, directions, points)
    except ValueError as error:
        raise InputError(str(error)) from None
    flat_origins, flat_directions = origins.reshape(-1, 3), directions.reshape(-1, 3)
    enters, leaves = intersect_box(flat_origins, flat_directions, bounds.aabb)
    lengths = leaves.clamp(max=bounds.far) - enters.clamp(min=bounds.near)
    hits = lengths > 0.0
    if not bool(hits.any()):
        raise InputError(
            "no ray of any camera meets the scene: the sparse points and the camera poses are "
            "probably in different coordinates"
        )
    return Survey(
        bounds,
        flat_origins[hits],
        flat_directions[hits],
        float(hits.float().mean()),
        float(lengths[hits].median()),
        origins[:, 0],
    )


def covering_rays(cameras: Cameras) -> tuple[Tensor, Tensor]:
    """Rays that cover the images of up to `MOST_CAMERAS` cameras.

    Returns:
        origins and unit directions, [C, SIDE * SIDE, 3] float32 on the CPU.
    """
    cameras = cameras.to("cpu")
    chosen = torch.linspace(0, len(cameras) - 1, min(len(cameras), MOST_CAMERAS)).long().unique()
    origins, directions = [], []
    for number in chosen.tolist():
        height, width = float(cameras.height[number]), float(cameras.width[number])
        rows = torch.linspace(0.5, height - 0.5, SIDE)
        columns = torch.linspace(0.5, width - 0.5, SIDE)
        coords = torch.stack(torch.meshgrid(rows, columns, indexing="ij"), dim=-1).view(-1, 2)
        bundle = cameras.generate_rays(camera_indices=number, coords=coords)
        origins.append(bundle.origins.float())
        directions.append(bundle.directions.float())
    return torch.stack(origins), torch.stack(directions)
