"""How much there is to see in a scene, counted in the smallest things that its photographs resolve.

From cameras and sparse points alone: no image is opened.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from leco_plugin.samplers.boxes import intersect_box
from leco_plugin.scenes.bounds import BoundsConfig, SceneBounds, find_bounds, usable_points
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.survey import chosen_cameras, covering_rays

CAMERAS = "leco_cameras"
"""Key of the metadata that a data manager hands to a model: the training cameras."""
MOST_POINTS = 1 << 14
"""Sparse points that are looked up in every camera."""
NEIGHBOURS = 8
"""Points in the cells by which the surface is measured: with fewer, there are holes between."""


@dataclass(frozen=True)
class SceneDetail:
    """The size of a scene in footprints of a pixel, each of the photograph that is nearest."""

    images: int
    """Training photographs."""
    pixels: int
    """Their pixels; masks are not looked at."""
    texels: float
    """Footprints that cover the scene's surface; no more than there are pixels."""
    across: float
    """Footprints (the ground sampling distance, median over the scene) along the cube that is
    encoded."""


def detail_of(
    cameras: Cameras, points: Tensor | None = None, config: BoundsConfig | None = None
) -> SceneDetail:
    """The size of the scene that these cameras see.

    Args:
        cameras: of the training photographs.
        points: [P, 3] sparse points in the same coordinates, or None.
        config: where the scene lies, where the data do not say it.
    Raises:
        InputError: there are no cameras, none sees a point, or what is configured is no range.
    """
    if len(cameras) == 0:
        raise InputError("the scene has no training cameras")
    cameras = cameras.to("cpu")
    chosen = chosen_cameras(len(cameras))
    poses = cameras.camera_to_worlds[chosen].float()
    origins, directions = covering_rays(cameras)
    bounds = find_bounds(poses, directions, points, config)
    places = _places(points, origins, directions, bounds)
    density = torch.zeros(len(places))
    for pose, rays, width in zip(poses, directions, cameras.width[chosen].flatten().tolist()):
        density = torch.maximum(density, _pixel_density(places, pose, rays, width))
    seen = density > 0.0
    if not bool(seen.any()):
        raise InputError("no camera sees the scene: the poses or the points are in other axes")
    typical = density[seen].median()
    footprint = float(typical) ** -0.5
    pixels = int((cameras.height.long() * cameras.width.long()).sum())
    # a contraction gives half of the cube to what lies outside
    cube = (4.0 if bounds.kind == "contraction" else 2.0) * bounds.half_extent
    # few photographs are taken from close by, and what they resolve is not what the rest shows
    texels = _pixels_on_surface(places[seen], density[seen].clamp(max=typical), footprint)
    return SceneDetail(len(cameras), pixels, min(texels, float(pixels)), cube / footprint)


def _pixels_on_surface(places: Tensor, density: Tensor, size: float) -> float:
    """The density of pixels [P], integrated over the surface on which places [P, 3] lie.

    The surface is as large as one side of each of the cubic cells that it passes through, which
    are just large enough for most to hold `NEIGHBOURS` places.

    Args:
        size: of the smallest cells.
    """
    low = places.amin(dim=0)
    widest = max(size, float((places.amax(dim=0) - low).max()))
    while True:
        cells = ((places - low) / size).floor().long()
        _, which, counts = cells.unique(dim=0, return_inverse=True, return_counts=True)
        if float(counts[which].float().median()) >= NEIGHBOURS or size >= widest:
            break
        size *= 2.0**0.5
    total = torch.zeros(len(counts)).index_add_(0, which, density)
    return float((total / counts).sum()) * size**2


def _pixel_density(places: Tensor, pose: Tensor, rays: Tensor, width: int) -> Tensor:
    """Pixels of a camera for a unit of area of a surface that faces it, at places [P, 3].

    Args:
        pose: [3, 4].
        rays: [K, 3] unit directions that cover its image.
        width: of the image in pixels.
    Returns:
        [P], one over the square of a pixel's footprint; 0 where a place is not in the image.
    """
    turn = pose[:, :3]
    local = rays @ turn
    # behind a fisheye's axis there is no tangent
    slopes = local[:, :2] / (-local[:, 2:]).clamp(min=0.1)
    low, high = slopes.amin(dim=0), slopes.amax(dim=0)
    offsets = (places - pose[:, 3]) @ turn
    depths = -offsets[:, 2]
    tangents = offsets[:, :2] / depths[:, None].clamp(min=1e-6)
    inside = (depths > 1e-6) & ((tangents >= low) & (tangents <= high)).all(dim=-1)
    # the outermost rays go through the middles of pixels
    footprints = depths * float(high[0] - low[0]) / max(width - 1, 1)
    return torch.where(inside, footprints.clamp(min=1e-9) ** -2, 0.0)


def _places(
    points: Tensor | None, origins: Tensor, directions: Tensor, bounds: SceneBounds
) -> Tensor:
    """Up to `MOST_POINTS` places [P, 3] of the scene: of its sparse points, or where rays end."""
    points = usable_points(points)
    if points is None:
        origins, directions = origins.reshape(-1, 3), directions.reshape(-1, 3)
        reach = torch.full((len(origins),), bounds.half_extent)
        if bounds.kind == "box":
            reach = intersect_box(origins, directions, bounds.aabb)[1].clamp(0.0, bounds.far)
        points = origins + directions * reach[:, None]
    order = torch.randperm(len(points), generator=torch.Generator().manual_seed(0))
    return points[order[:MOST_POINTS]]
