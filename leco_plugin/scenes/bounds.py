"""Where a scene lies, found from cameras and sparse points: its mapping and the rays' range.

A scene photographed from above is bounded: its rays are cut at a plane above and one below all
points, as Mega-NeRF cuts them by altitude. Everything else is contracted, with the points in the
uncontracted cube. Either choice can be made by hand.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from leco_plugin.scenes.input_error import InputError
from leco_plugin.space import NO_WALL, SpaceKind


@dataclass
class BoundsConfig:
    """Where the scene lies, in scene units, where the data do not say it right"""

    space: Literal["auto", "box", "contraction"] = "auto"
    """box: bounded, nothing is contracted, as for a survey from the air. contraction: goes on into
    the distance, as in the street. auto: chosen from cameras and sparse points."""
    altitudes: tuple[float, float] | None = None
    """z below and above everything; rays are cut there. None is found from the sparse points."""
    metres_per_unit: float | None = None
    """Metres in a unit of the dataset's own poses, for the log: 1 for OpenDroneMap. None takes what
    the dataparser knows."""


Span = tuple[float, float]
"""The lesser of two lengths, and the greater."""
MOST_POINTS = 100_000
"""Of which it is told whether a camera sees any."""
FEWEST_POINTS = 32
"""Fewer sparse points say nothing of a scene."""
STRAY, STRAY_SEEN, FEW_STRAYS = 25.0, 0.3, 0.02
"""Distance of a point to its eighth neighbour, over that of most points, from which on it is a
mistake: real scenes without any have 23 at most. Of what is not seen from above it is also over the
distance to the nearest camera. A larger share of points is a part of the scene."""
CLOUD = 100_000
"""Sparse points, evenly of all, that bound a scene."""
FAR_CAMERA, NEARER = 20.0, 0.75
"""Distance of a camera from the middle, over that within which this share of them lies, from which
on it is far. Half of them may lie at one place, as of a panorama."""
OVER_CAMERAS = 0.06
"""Share of the way from the ground to the highest camera by which raised bounds end above it."""
NEAR_CAMERAS = 0.04
"""Share of the farthest distance at which rays begin in raised bounds."""


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
    lowest: float | None = None
    """z of the lowest sparse point, but for one in a thousand, of a scene from above whose planes
    were found by its points: what lies below is hidden. None of others."""


def find_bounds(
    camera_to_worlds: Tensor,
    directions: Tensor,
    points: Tensor | None,
    config: BoundsConfig | None = None,
) -> SceneBounds:
    """Bounds from poses [C, 3, 4], OpenGL's, in scene units, unit directions [C, K, 3] that cover
    each image, its corners included, and points [P, 3] or None. InputError if a pose is not finite,
    no camera sees a point, or configured altitudes are no range that rays go down to."""
    config = config or BoundsConfig()
    poses, directions = (part.detach().float().cpu() for part in (camera_to_worlds, directions))
    if not bool(poses.isfinite().all()):
        raise InputError("a camera pose holds values that are not finite")
    points = usable_points(points)
    if config.altitudes is not None and config.space != "contraction":
        return _between(config.altitudes, poses, directions, points)
    if points is None:
        if config.space == "box":
            lack = "a bounded scene without sparse points needs its altitudes"
            remedy = "give bounds.altitudes with the z of its ground and of its top"
            raise InputError(f"{lack}: {remedy}")
        return _without_points(poses, directions)
    from_above, seen = _seen_from_above(poses, directions, points)
    count = len(points)
    points, left_out = _without_strays(points, None if from_above else poses)
    low, high = _quantiles(points, 0.001), _quantiles(points, 0.999)
    near, far = _range(_depths(poses, directions, points))
    if from_above and config.space != "contraction":
        relief = max(float(high[2] - low[2]), 0.02 * far)
        # far below, so that a flat picture on the lower plane is plainly wrong from two places
        ground = float(low[2]) - max(0.5 * relief, 0.2 * far)
        top = float(high[2]) + 0.3 * relief
        why = f"photographed from above ({seen}): bounded"
        found = _slab(poses, directions, (ground, top), (near, far), why)
        found = replace(found, lowest=float(low[2]))
    elif config.space == "box":
        found = _room(poses, low, high, near, far)
    else:
        half = float((high - low).max()) / 2
        why = "as configured" if config.space == "contraction" else f"not from above ({seen})"
        why += f": contracted outside {half:.3f} around {count} sparse points"
        found = SceneBounds("contraction", (low + high) / 2, half, near, far, _no_walls(), why)
    return replace(found, reason=found.reason + left_out)


def usable_points(points: Tensor | None) -> Tensor | None:
    """The finite ones of points [P, 3], float32 on the CPU; None of fewer than `FEWEST_POINTS`, and
    of those that all lie at one place, as a writer's zeros do."""
    if points is None:
        return None
    points = points.detach().float().cpu()
    points = points[points.isfinite().all(dim=-1)]
    is_cloud = len(points) >= FEWEST_POINTS and bool((points != points[0]).any())
    return points if is_cloud else None


def _without_strays(points: Tensor, poses: Tensor | None) -> tuple[Tensor, str]:
    """Up to `CLOUD` of finite points [P, 3] without the few far from all others, also over the
    distance to the nearest of poses [C, 3, 4] if given; and words on these."""
    from scipy.spatial import KDTree  # only here: a suite on a GPU has torch alone

    step = -(-len(points) // CLOUD)
    points = points[::step]
    places, which = np.unique(points.numpy(), axis=0, return_inverse=True)  # thousands may be 0
    gaps = KDTree(places).query(places, k=[min(9, len(places))])[0][:, 0]
    strays = gaps > STRAY * np.median(gaps)
    if poses is not None:
        strays &= gaps > STRAY_SEEN * KDTree(poses[:, :, 3].numpy()).query(places)[0]
    if not 0.0 < strays.mean() <= FEW_STRAYS:
        return points, ""
    left = torch.from_numpy(~strays[which.reshape(-1)])
    count = step * int((~left).sum())
    what = "point far from all others is" if count == 1 else "points far from all others are"
    return points[left], f"; {count} sparse {what} left out"


def distances_from_middle(places: Tensor) -> Tensor:
    """Distances [C] of places [C, 3] from their middle, over that within which most lie; 0 if
    most lie at one place."""
    away = (places - places.median(dim=0).values).norm(dim=-1)
    return (away / away.quantile(NEARER)).nan_to_num(0.0, posinf=0.0)


def with_range(bounds: SceneBounds, near: float | None, far: float | None) -> SceneBounds:
    """The bounds with near and far set by hand, if not None. InputError unless 0 < near < far."""
    near, far = bounds.near if near is None else near, bounds.far if far is None else far
    if not 0.0 < near < far < math.inf:
        raise InputError(f"rays need 0 < near < far, got near {near:g} and far {far:g}")
    return replace(bounds, near=near, far=far)


def raise_to_cameras(bounds: SceneBounds, heights: Tensor, seen: float) -> SceneBounds:
    """The bounds of a scene from above, raised to its cameras, of heights z [C]: for pictures in
    which rays beyond the sparse points show something (`seen`, a share of all), as fog or a sky."""
    ground, highest = float(bounds.aabb[2]), float(heights.max())
    top = max(float(bounds.aabb[5]), highest + OVER_CAMERAS * (highest - ground))
    x, y = bounds.center[:2].tolist()
    half = max(bounds.half_extent, 1.02 * (top - ground) / 2)
    center = torch.tensor([x, y, (ground + top) / 2])
    aabb = torch.tensor([x - half, y - half, ground, x + half, y + half, top])
    reason = f"{bounds.reason}; raised to z = {top:.3f}, above the cameras: {seen:.1%} of the rays"
    reason += " go beyond and show something"
    near = min(bounds.near, NEAR_CAMERAS * bounds.far)
    return SceneBounds("box", center, half, near, bounds.far, aabb, reason, bounds.lowest)


def _range(depths: Tensor) -> Span:
    """Near and far of distances [D] to what is seen, with margins."""
    return 0.75 * float(_quantiles(depths, 0.01)), 1.25 * float(_quantiles(depths, 0.999))


def _between(
    altitudes: Span, poses: Tensor, directions: Tensor, points: Tensor | None
) -> SceneBounds:
    """A bounded scene between two given levels, with or without points."""
    ground, top = altitudes
    if not -math.inf < ground < top < math.inf:
        raise InputError(f"bounds.altitudes are ground < top, got {ground:g} and {top:g}")
    heights = poses[:, None, 2, 3]
    down = _go_down(directions) & (heights > ground)
    if not bool(down.any()):
        none = f"no ray of any camera goes down to the ground at z = {ground:g}"
        raise InputError(f"{none}: bounds.altitudes are in scene units, +z up")
    if points is not None:
        near, far = _range(_depths(poses, directions, points))
    else:
        reaches, begins = (
            ((level - heights) / directions[..., 2])[down].clamp(min=0.0) for level in altitudes
        )
        far = 1.05 * float(_quantiles(reaches, 0.999))
        near = max(0.75 * float(_quantiles(begins, 0.01)), 1e-3 * far)
    return _slab(poses, directions, altitudes, (near, far), "altitudes as configured: bounded")


def _slab(
    poses: Tensor, directions: Tensor, levels: Span, distances: Span, why: str
) -> SceneBounds:
    """A bounded scene between two levels, as wide as the rays reach in it from near to far."""
    (ground, top), (near, far) = levels, distances
    down = _go_down(directions)
    reach = ((ground - poses[:, None, 2, 3]) / directions[..., 2]).clamp(0.0, far)[down]
    origins = poses[:, None, :, 3].expand_as(directions)[down]
    hits = (origins + directions[down] * reach[:, None])[:, :2]
    sides = torch.stack([hits.amin(dim=0), hits.amax(dim=0)])
    center = torch.tensor([*sides.mean(dim=0).tolist(), (ground + top) / 2])
    half = 1.02 * max(float((sides[1] - sides[0]).max()), top - ground) / 2
    aabb = _no_walls()
    aabb[2], aabb[5] = ground, top
    reason = f"{why}, rays cut at z = {ground:.3f} and {top:.3f}"
    return SceneBounds("box", center, half, near, far, aabb, reason)


def _room(poses: Tensor, low: Tensor, high: Tensor, near: float, far: float) -> SceneBounds:
    """A bounded scene with walls around its points and its cameras."""
    places = poses[:, :, 3]
    low, high = torch.minimum(low, places.amin(dim=0)), torch.maximum(high, places.amax(dim=0))
    margin = 0.125 * float((high - low).max())  # an eighth of the longest side
    low, high = low - margin, high + margin
    half = float((high - low).max()) / 2
    reason = "as configured: bounded, rays cut at walls around points and cameras"
    return SceneBounds("box", (low + high) / 2, half, near, far, torch.cat([low, high]), reason)


def _without_points(poses: Tensor, directions: Tensor) -> SceneBounds:
    """The scene is taken to be as large as the cameras' path; a contraction holds the rest."""
    positions = poses[:, :3, 3]
    low, high = positions.amin(dim=0), positions.amax(dim=0)
    half = max(float((high - low).max()) / 2, 1e-3)
    reason = f"no sparse points: contracted outside {half:.3f} around the cameras"
    if float(_go_down(directions).float().mean()) >= MOSTLY_DOWN:
        reason += "; all look down: give bounds.altitudes with the z of ground and top"
    center = (low + high) / 2
    return SceneBounds("contraction", center, half, 0.05 * half, 100 * half, _no_walls(), reason)


def _go_down(directions: Tensor) -> Tensor:
    """Whether unit vectors [..., 3] go down clearly: bool [...]."""
    return directions[..., 2] < -0.05


def _no_walls() -> Tensor:
    return torch.tensor([-NO_WALL] * 3 + [NO_WALL] * 3)


def _quantiles(values: Tensor, share: float) -> Tensor:
    """Quantile along the first dimension; torch.quantile refuses more than 16 million values."""
    ordered = values.sort(dim=0).values
    return ordered[min(round(share * (len(values) - 1)), len(values) - 1)]


def _depths(poses: Tensor, directions: Tensor, points: Tensor) -> Tensor:
    """Distances from each camera to the sparse points in its field of view: [D]."""
    depths = torch.cat(_depths_of_each(poses, directions, points, 2000))
    if len(depths) == 0:
        raise InputError("no camera sees a sparse point: the poses or the points are in other axes")
    return depths


def _depths_of_each(poses: Tensor, directions: Tensor, points: Tensor, most: int) -> list[Tensor]:
    """The same of each camera, of up to `most` of the points."""
    points = points[torch.randperm(len(points), generator=torch.Generator().manual_seed(0))[:most]]
    found = []
    for pose, rays in zip(poses, directions):
        ahead = -pose[:, 2]
        offsets = points - pose[:, 3]
        distances = offsets.norm(dim=-1)
        found.append(distances[offsets @ ahead > (rays @ ahead).min() * distances])
    return found


def blind_cameras(camera_to_worlds: Tensor, directions: Tensor, points: Tensor | None) -> list[int]:
    """Numbers of the cameras that see no point; none without points. Arguments as `find_bounds`."""
    points = usable_points(points)
    if points is None:
        return []
    poses, directions = (part.detach().float().cpu() for part in (camera_to_worlds, directions))
    blind = list(range(len(poses)))
    for most in (2000, MOST_POINTS):  # nearly all see one of the few
        depths = _depths_of_each(poses[blind], directions[blind], points, most)
        blind = [number for number, seen in zip(blind, depths) if not len(seen)]
    return blind


MOSTLY_ABOVE, MOSTLY_DOWN = 0.75, 0.9
"""Share of cameras above nearly all points, and of rays that go down, of a survey from the air."""


def _seen_from_above(poses: Tensor, directions: Tensor, points: Tensor) -> tuple[bool, str]:
    """Whether rays go down and cameras are above the points, nearly all; and shares in words."""
    above = float((poses[:, 2, 3] > _quantiles(points[:, 2], 0.95)).float().mean())
    down = float(_go_down(directions).float().mean())
    words = f"{down:.0%} of rays go down, {above:.0%} of cameras are above the points"
    return above >= MOSTLY_ABOVE and down >= MOSTLY_DOWN, words
