"""A look at the cameras before the first step: bounds, rays that meet the scene, and its detail,
counted in the smallest things that the photographs resolve."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from leco_plugin.log import first_of
from leco_plugin.models.objective import DARK
from leco_plugin.samplers.boxes import intersect_box
from leco_plugin.scenes.bounds import (
    FAR_CAMERA,
    BoundsConfig,
    SceneBounds,
    blind_cameras,
    distances_from_middle,
    find_bounds,
    raise_to_cameras,
    usable_points,
    with_range,
)
from leco_plugin.scenes.frames import ALTITUDES, POINTS, DatasetUnits, units_of
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.large_coordinates import rounded_by

SIDE = 8
"""A grid of this many rays a side covers each image, its corners included."""
MOST_CAMERAS = 256
WORTH_IT = 0.005
"""Share of all rays that must show something beyond a survey from the air, to raise its bounds."""
MOST_PICTURES = 16
"""Pictures that are opened to see what lies beyond: those with the most rays that miss."""


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
    rays: int = 0
    """How many rays were looked at."""
    units: DatasetUnits | None = None
    """Those of the dataset, if its dataparser says what it did to them."""
    rounded: str | None = None
    """A line on coordinates that its dataparser has rounded, if it has."""

    def lines(self) -> list[str]:
        """For the log: what was chosen and why, the range in its units, how many rays meet it."""
        bounds, heights, units = self.bounds, self.positions[:, 2], self.units
        lengths, levels = {"near": bounds.near, "far": bounds.far}, {}
        if bounds.kind == "box":
            levels = {"ground, z": bounds.aabb[2], "top, z": bounds.aabb[5]}
            levels |= {"lowest camera, z": heights.min(), "highest camera, z": heights.max()}
        else:
            lengths["inner cube, half"] = bounds.half_extent
        table = [f"{'':18}{'scene units':>12}" + (f"{units.name:>12}" if units else "")]
        for name, value in (lengths | levels).items():
            there = units and _in(units, float(value), name in levels)
            table.append(f"{name:18}{float(value):12.3f}" + (f"{there:12.2f}" if units else ""))
        length = f"{self.median_length:.3f}"
        if units is not None and units.metric:
            length += f" ({_in(units, self.median_length, False):.1f} m)"
        elif units is not None:
            said = "bounds.metres-per-unit says the metres"
            table.append(f"data units are those of the poses; {said}")
        meeting = f"{self.meeting:.1%} of {self.rays} rays meet the scene, half of them for"
        rounded = [self.rounded] if self.rounded else []
        return [bounds.reason, *table, f"{meeting} {length}", *rounded]

    def summary(self) -> list[str]:
        """The same for a short screen: two lines, and a third of what was rounded."""
        bounds, units = self.bounds, self.units
        span = f"{bounds.near:.3g} to {bounds.far:.3g} scene units"
        if units is not None:
            near, far = (_in(units, each, False) for each in (bounds.near, bounds.far))
            span += f" ({near:.3g} to {far:.3g} {units.name})"
        rays = f"rays from {span}; {self.meeting:.1%} of {self.rays} meet the scene"
        return [f"bounds: {bounds.reason}", f"  {rays}", *([self.rounded] if self.rounded else [])]


def _in(units: DatasetUnits, value: float, level: bool) -> float:
    """A length or, as a level, an altitude in the dataset's units."""
    return units.altitude(value) if level else units.per_scene_unit * value


def places_of(metadata: dict[str, Any]) -> Tensor | None:
    """[N, 3] scene units, where the photographs of a dataset were taken, if that is known."""
    cameras = metadata.get(CAMERAS)
    return None if cameras is None else cameras.camera_to_worlds[:, :3, 3].float()


def points_in(metadata: dict[str, Any]) -> Tensor | None:
    """Sparse points [P, 3] in model coordinates in what a reader says of a dataset, or None."""
    points = metadata.get(POINTS)
    return None if points is None else torch.as_tensor(points)


def sparse_points(dataset: Any) -> Tensor | None:
    """The same of a dataset of any reader."""
    return points_in(getattr(dataset, "metadata", {}) or {})


def with_known_altitudes(config: BoundsConfig | None, metadata: dict[str, Any]) -> BoundsConfig:
    """What is configured, with the altitudes that a reader knows where none are set by hand."""
    config = config or BoundsConfig()
    known = metadata.get(ALTITUDES)
    return config if config.altitudes or known is None else replace(config, altitudes=known)


def survey(
    datamanager: Any,
    config: BoundsConfig | None = None,
    near: float | None = None,
    far: float | None = None,
) -> Survey:
    """Looks at the training cameras of a nerfstudio data manager; near and far, scene units, are
    found from the data where they are None. InputError if it hands out whole images or has no
    camera, no ray meets the scene, or what is configured is no range."""
    if hasattr(datamanager, "train_unseen_cameras"):
        kind = type(datamanager).__name__
        raise InputError(
            f"{kind} hands out whole images, and this method trains on rays; leave the method its "
            "own data manager, and see its option `images` to save memory"
        )
    dataset = datamanager.train_dataset
    config = with_known_altitudes(config, getattr(dataset, "metadata", {}) or {})
    cameras: Cameras = dataset.cameras
    origins, directions = covering_rays(cameras)
    chosen = chosen_cameras(len(cameras))
    poses = cameras.camera_to_worlds[chosen]
    flat_origins, flat_directions = origins.reshape(-1, 3), directions.reshape(-1, 3)
    found = find_bounds(poses, directions, sparse_points(dataset), config)
    if found.lowest is not None:
        missing = lengths_inside(found, flat_origins, flat_directions) <= 0.0
        seen = seen_beyond(dataset, chosen, missing.view(-1, SIDE, SIDE))
        if seen >= WORTH_IT:
            found = raise_to_cameras(found, poses[:, 2, 3], seen)
    bounds = with_range(found, near, far)
    units = units_of(datamanager, config.metres_per_unit)
    lengths = lengths_inside(bounds, flat_origins, flat_directions)
    hits = lengths > 0.0
    if not bool(hits.any()):
        cause = "the sparse points and the camera poses are probably in different coordinates"
        if near is not None or far is not None or config.altitudes is not None:
            cause = "near, far and altitudes are in scene units; leave them out to have them found"
        raise InputError(f"0% of the rays meet the scene ({bounds.reason}): {cause}")
    probes = flat_origins[hits], flat_directions[hits]
    meeting, median = float(hits.float().mean()), float(lengths[hits].median())
    positions, rounded = origins[:, 0], rounded_by(datamanager)
    return Survey(bounds, *probes, meeting, median, positions, len(hits), units, rounded)


def lengths_inside(bounds: SceneBounds, origins: Tensor, directions: Tensor) -> Tensor:
    """Lengths [N] of rays [N, 3] inside bounds, at most 0 of those that miss them."""
    enters, leaves = intersect_box(origins, directions, bounds.aabb)
    return leaves.clamp(max=bounds.far) - enters.clamp(min=bounds.near)


def chosen_cameras(count: int, most: int = MOST_CAMERAS) -> Tensor:
    """Numbers of up to `most` of so many cameras, spread evenly."""
    return torch.linspace(0, count - 1, min(count, most)).long().unique()


def covering_rays(
    cameras: Cameras, side: int = SIDE, most: int = MOST_CAMERAS
) -> tuple[Tensor, Tensor]:
    """Rays, `side` along each side of an image, of up to `most` cameras: origins and unit
    directions, [C, side * side, 3] float32 on the CPU. InputError if there are no cameras."""
    if len(cameras) == 0:
        raise InputError("the scene has no training cameras")
    cameras = cameras.to("cpu")
    chosen = chosen_cameras(len(cameras), most)
    sizes = torch.cat([cameras.height, cameras.width], dim=1)[chosen].float() - 1.0
    shares = torch.linspace(0.0, 1.0, side)
    grid = torch.cartesian_prod(shares, shares)
    coords = 0.5 + sizes[:, None] * grid
    bundle = cameras.generate_rays(
        camera_indices=chosen.repeat_interleave(side * side)[:, None], coords=coords.view(-1, 2)
    )
    shape = len(chosen), side * side, 3
    return bundle.origins.float().view(shape), bundle.directions.float().view(shape)


def doubtful_cameras(dataset: Any) -> list[str]:
    """Lines on cameras whose poses may be wrong: far from the middle, which squeezes all others
    into a small part of the scene, or in view of no sparse point, which widens the bounds."""
    poses, lines = dataset.cameras.camera_to_worlds, []
    times = distances_from_middle(poses[:, :3, 3].double().cpu())
    far = (times > FAR_CAMERA).nonzero().flatten().tolist()
    if far:
        most = f"up to {float(times.max()):.0f} times as far from the middle as most cameras"
        why = "the others share a small part of the scene"
        lines.append(f"photographed from {most}: {_named(dataset, far)}; {why}")
    chosen, (_, directions) = chosen_cameras(len(poses)), covering_rays(dataset.cameras)
    found = blind_cameras(poses[chosen], directions, sparse_points(dataset))
    if blind := [number for number in chosen[found].tolist() if number not in far]:
        why = "the bounds become as wide as they are away"
        lines.append(f"in view of no sparse point: {_named(dataset, blind)}; {why}")
    remedy = "if their poses are wrong, leave their frames out or mend them"
    return [f"{line}; {remedy}" for line in lines]


def _named(dataset: Any, numbers: Sequence[int]) -> str:
    return first_of([Path(dataset.image_filenames[number]).name for number in numbers])


def seen_beyond(dataset: Any, numbers: Tensor, misses: Tensor) -> float:
    """Share of the rays that miss the scene but show something, of a dataset's pictures by number
    [C] with bool [C, side, side] of the rays of a grid that miss."""
    counts = misses.flatten(1).sum(dim=1)
    most = counts.argsort(descending=True)[:MOST_PICTURES]
    shown = [bright(dataset.get_data(int(numbers[i])), misses[i]) for i in most if counts[i] > 0]
    if not shown:
        return 0.0
    return float(torch.cat(shown).float().mean() * misses.float().mean())


def bright(data: dict[str, Any], chosen: Tensor) -> Tensor:
    """Whether chosen pixels, bool [side, side] of a grid over a picture [H, W, 3 or 4] in [0, 1],
    show a thing that no mask hides: bool [N]."""
    image = data["image"]
    height, width = image.shape[:2]
    places = chosen.nonzero() / (len(chosen) - 1) * torch.tensor([height - 1, width - 1])
    rows, columns = places.round().long().unbind(dim=-1)
    pixels = image[rows, columns].float()
    shown = pixels[:, :3].amax(dim=-1) * (pixels[:, 3] if pixels.shape[-1] == 4 else 1.0) > DARK
    return shown & data["mask"][rows, columns, 0].bool() if "mask" in data else shown


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
    """Footprints (ground sampling distance, median) along the cube that is encoded."""


def detail_of(
    cameras: Cameras, points: Tensor | None = None, config: BoundsConfig | None = None
) -> SceneDetail:
    """The size of the scene that these cameras see, by sparse points [P, 3] if there are any.
    InputError if there are no cameras, none sees a point, or what is configured is no range."""
    cameras = cameras.to("cpu")
    origins, directions = covering_rays(cameras)
    chosen = chosen_cameras(len(cameras))
    poses = cameras.camera_to_worlds[chosen].float()
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
    """The density of pixels [P], integrated over the surface of places [P, 3]: one side of each
    cubic cell that holds any, of at least `size`, so large that most hold `NEIGHBOURS`."""
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
    """Pixels of a camera (pose [3, 4], unit rays [K, 3] that cover its image, width in pixels) on a
    unit of area at places [P, 3] that faces it: [P], 0 outside of the image."""
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
