"""Where a scene lies, found from cameras and sparse points: its mapping and the rays' range.

A scene photographed from above is bounded: its rays are cut at a plane above and one below all
points, as Mega-NeRF cuts them by altitude, and space is not contracted. Everything else is
contracted, with the points in the uncontracted cube.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from leco_plugin.space import NO_WALL, SpaceKind


@dataclass(frozen=True)
class SceneBounds:
    """The space mapping of a scene and the range in which rays are marched; scene units."""

    kind: SpaceKind
    center: Tensor
    """[3], centre of the space mapping."""
    half_extent: float
    """Half extent of the space mapping."""
    near: float
    """Where rays begin."""
    far: float
    """Where rays end."""
    aabb: Tensor
    """[6] corners of the box in which rays are marched; +-NO_WALL where there is no wall."""
    reason: str
    """One line for the log: what was seen in the data."""


def find_bounds(camera_to_worlds: Tensor, directions: Tensor, points: Tensor | None) -> SceneBounds:
    """Bounds from camera poses, some of the cameras' rays, and sparse points.

    Args:
        camera_to_worlds: [C, 3, 4] OpenGL poses, scene units.
        directions: [C, K, 3] unit directions of rays that cover each image, its corners included.
        points: [P, 3] sparse scene points, or None; fewer than 32 count as none.
    Raises:
        ValueError: there are no cameras, a pose is not finite, or no camera sees a point.
    """
    poses = camera_to_worlds.detach().float().cpu()
    if len(poses) == 0:
        raise ValueError("the scene has no cameras")
    if not bool(poses.isfinite().all()):
        raise ValueError("a camera pose holds values that are not finite")
    if points is not None:
        points = points.detach().float().cpu()
        points = points[points.isfinite().all(dim=-1)]
    if points is None or len(points) < 32:
        return _without_points(poses)
    directions = directions.detach().float().cpu()
    low, high = _quantiles(points, 0.001), _quantiles(points, 0.999)
    depths = _depths(poses, directions, points)
    near, far = 0.75 * float(_quantiles(depths, 0.01)), 1.25 * float(_quantiles(depths, 0.999))
    if _seen_from_above(poses, directions, points):
        return _slab(poses, directions, float(low[2]), float(high[2]), near, far)
    half = float((high - low).max()) / 2
    reason = f"contracted outside {half:.3f} around {len(points)} sparse points"
    return SceneBounds("contraction", (low + high) / 2, half, near, far, _no_walls(), reason)


def _slab(
    poses: Tensor, directions: Tensor, low: float, high: float, near: float, far: float
) -> SceneBounds:
    """A bounded scene between two levels; points may miss a cellar or a mast, hence the margins."""
    relief = max(high - low, 0.02 * far)
    # far below, so that a flat picture on the lower plane, seen from two places, is plainly wrong
    ground, top = low - max(0.5 * relief, 0.2 * far), high + 0.3 * relief
    down = directions[..., 2] < -0.05
    reach = ((ground - poses[:, None, 2, 3]) / directions[..., 2]).clamp(0.0, far)[down]
    origins = poses[:, None, :, 3].expand_as(directions)[down]
    hits = (origins + directions[down] * reach[:, None])[:, :2]
    sides = torch.stack([hits.amin(dim=0), hits.amax(dim=0)])
    center = torch.tensor([*sides.mean(dim=0).tolist(), (ground + top) / 2])
    half = 1.02 * max(float((sides[1] - sides[0]).max()), top - ground) / 2
    wall = NO_WALL
    return SceneBounds(
        "box",
        center,
        half,
        near,
        far,
        torch.tensor([-wall, -wall, ground, wall, wall, top]),
        f"photographed from above: bounded, rays cut at z = {ground:.3f} and {top:.3f}",
    )


def _without_points(poses: Tensor) -> SceneBounds:
    """The scene is taken to be as large as the cameras' path; a contraction holds the rest."""
    positions = poses[:, :3, 3]
    low, high = positions.amin(dim=0), positions.amax(dim=0)
    half = max(float((high - low).max()) / 2, 1e-3)
    reason = f"no sparse points: contracted outside {half:.3f} around the cameras"
    center = (low + high) / 2
    return SceneBounds("contraction", center, half, 0.05 * half, 100 * half, _no_walls(), reason)


def _no_walls() -> Tensor:
    return torch.tensor([-NO_WALL] * 3 + [NO_WALL] * 3)


def _quantiles(values: Tensor, share: float) -> Tensor:
    """Quantile along the first dimension; torch.quantile refuses more than 16 million values."""
    ordered = values.sort(dim=0).values
    return ordered[min(round(share * (len(values) - 1)), len(values) - 1)]


def _depths(poses: Tensor, directions: Tensor, points: Tensor) -> Tensor:
    """Distances from each camera to the sparse points in its field of view: [D]."""
    points = points[torch.randperm(len(points), generator=torch.Generator().manual_seed(0))[:2000]]
    found = []
    for pose, rays in zip(poses, directions):
        ahead = -pose[:, 2]
        offsets = points - pose[:, 3]
        distances = offsets.norm(dim=-1)
        found.append(distances[offsets @ ahead > (rays @ ahead).min() * distances])
    depths = torch.cat(found)
    if len(depths) == 0:
        raise ValueError("no camera sees a sparse point: the poses or the points are in other axes")
    return depths


def _seen_from_above(poses: Tensor, directions: Tensor, points: Tensor) -> bool:
    """Whether nearly all rays go down, from cameras of which most are above nearly all points."""
    above = poses[:, 2, 3] > _quantiles(points[:, 2], 0.95)
    downwards = directions[..., 2] < -0.05
    return bool(above.float().mean() >= 0.75 and downwards.float().mean() >= 0.9)
