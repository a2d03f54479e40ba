"""The rays of a batch inside a scene's bounds and a crop, and the steps of their march."""

from __future__ import annotations

from itertools import product
from typing import Any

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.model_components.renderers import RGBRenderer
from torch import Tensor, nn

from leco_plugin.models.rendering import Rays, Shaded
from leco_plugin.samplers.boxes import intersect_box
from leco_plugin.scenes.survey import covering_rays
from leco_plugin.space import Space, SpaceKind

DIRECTIONS = 16
"""Cells a side of the grid over directions: 7 degrees each."""
TOLERANCE = 0.02
"""Of the z of a unit direction, 1 degree at the horizon: between the rays that cover an image."""
SIDE = 32
"""Rays a side that cover each training image: 12 degrees apart in a panorama."""


def cut_to_bounds(
    bundle: RayBundle, aabb: Tensor, near: Tensor, far: Tensor, with_images: bool
) -> Rays:
    """A bundle's rays, cut to the scene's bounds; one that misses them ends before it begins.

    Args:
        aabb: [6] corners of the box in which rays are marched.
        near, far: scalars, where all rays begin and end, scene units.
        with_images: whether each ray keeps the number of its training image.
    """
    enters, leaves = intersect_box(bundle.origins, bundle.directions, aabb)
    images = bundle.camera_indices if with_images else None
    return Rays(
        bundle.origins,
        bundle.directions,
        # finite also for a ray that runs along a wall outside, so that its backdrop has a place
        enters.clamp(min=near).clamp(max=far),
        leaves.clamp(min=0.0).clamp(max=far),
        images[:, 0] if images is not None else None,
    )


def with_ends_for_all(rays: Rays, far: Tensor, length: Tensor) -> Rays:
    """Gives rays that miss the bounds a piece as long as a backdrop at the far end: their sky.

    The piece of a ray without a backdrop has no length.

    Args:
        far, length: scalars, scene units.
    """
    missed = ~(rays.t_maxs > rays.t_mins)
    starts = far - length
    starts = starts if rays.cut_off is None else torch.where(rays.cut_off, far, starts)
    return rays._replace(
        t_mins=torch.where(missed, starts, rays.t_mins), t_maxs=rays.t_maxs.where(~missed, far)
    )


def within_crop(rays: Rays, nears: Tensor | None, fars: Tensor | None) -> Rays:
    """Rays between the nears and fars that a crop gives a bundle.

    A ray that the crop ends before its own end has no backdrop.

    Args:
        nears, fars: [R] or [R, 1], scene units; None is no crop.
    """
    if nears is None or fars is None:
        return rays
    t_maxs = rays.t_maxs.minimum(fars.reshape(-1))
    t_mins = rays.t_mins.maximum(nears.reshape(-1)).minimum(t_maxs)
    ended = (t_maxs < rays.t_maxs) | (t_mins >= t_maxs)
    cut_off = ended if rays.cut_off is None else rays.cut_off | ended
    return rays._replace(t_mins=t_mins, t_maxs=t_maxs, cut_off=cut_off)


def over_background(shaded: Shaded, rays: Rays) -> Tensor:
    """Colours [R, 3] over nerfstudio's background where rays are cut off: black, or a crop's."""
    if rays.cut_off is None:
        return shaded.rgb
    color = RGBRenderer.get_background_color("black", shaded.rgb.shape, shaded.rgb.device)
    through = (1.0 - shaded.accumulation).clamp(min=0.0) * rays.cut_off
    return shaded.rgb + through[:, None] * color


class SeenBackdrops(nn.Module):
    """Directions in which training rays miss the scene, or leave it but not through its floor.

    Only there has a backdrop learned its colour: a sky, or the distance. Before it has looked at
    cameras it takes every direction for seen.
    """

    limits: Tensor
    """[4, cells]: of z and of -z of the directions in each cell, the largest; first of rays that
    meet the scene, then of those that miss it."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("limits", torch.full((4, DIRECTIONS**3), 2.0))

    @torch.no_grad()
    def look(self, cameras: Cameras, space: Space, aabb: Tensor, near: Tensor, far: Tensor) -> None:
        """Notes the directions of rays that cover the images of training cameras."""
        origins, directions = (
            part.reshape(-1, 3).to(aabb) for part in covering_rays(cameras, SIDE)
        )
        bundle = RayBundle(origins, directions, pixel_area=origins[:, :1])
        cut = cut_to_bounds(bundle, aabb, near, far, with_images=False)
        beyond, missed = ~ends_on_floor(cut, space, aabb), cut.t_maxs <= cut.t_mins
        heights, cells = directions[:, 2], cells_of(directions)
        limits = torch.full_like(self.limits, -2.0)
        for number, (which, z) in enumerate(product((~missed, missed), (heights, -heights))):
            noted = beyond & which
            limits[number].scatter_reduce_(0, cells[noted], z[noted], "amax")
        # neighbours count too, so that the cells of neighbouring rays leave no gap
        grids = limits.view(1, 4, DIRECTIONS, DIRECTIONS, DIRECTIONS)
        self.limits.copy_(nn.functional.max_pool3d(grids, 3, 1, 1).view_as(limits))

    def forward(self, cut: Rays, space: Space, aabb: Tensor) -> Tensor:
        """Whether the backdrop of rays was seen while training: bool [R].

        Args:
            cut: as `cut_to_bounds` gives them.
        """
        of_each = self.limits[:, cells_of(cut.directions)] + TOLERANCE
        high, low = torch.where(cut.t_maxs > cut.t_mins, of_each[:2], of_each[2:])
        heights = cut.directions[:, 2]
        return ends_on_floor(cut, space, aabb) | ((heights <= high) & (-heights <= low))

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *rest: Any) -> None:
        """A state without limits, of an earlier release or a part of one, changes nothing."""
        if f"{prefix}limits" in state_dict:
            super()._load_from_state_dict(state_dict, prefix, *rest)


def cells_of(directions: Tensor) -> Tensor:
    """Cells of unit directions [R, 3] in the grid over directions: [R] int64."""
    x, y, z = ((0.5 * directions + 0.5) * DIRECTIONS).long().clamp(0, DIRECTIONS - 1).unbind(-1)
    return (x * DIRECTIONS + y) * DIRECTIONS + z


def ends_on_floor(cut: Rays, space: Space, aabb: Tensor) -> Tensor:
    """Whether rays leave a bounded scene through its floor, inside its cube: bool [R]."""
    ends = torch.addcmul(cut.origins, cut.directions, cut.t_maxs[:, None])
    at_floor = (ends[:, 2] - aabb[2]).abs() <= 1e-3 * (aabb[5] - aabb[2])
    inside = space.map(ends).abs().amax(dim=-1) <= 1.0
    return at_floor & inside & (cut.t_maxs > cut.t_mins)


def marching_rule(
    kind: SpaceKind, near: float, far: float, candidates: int, median_length: float
) -> tuple[float, float]:
    """Step size and cone angle with which a ray has about so many candidates.

    A box is marched evenly; an unbounded scene in steps that grow with distance.

    Args:
        near, far: where rays begin and end, scene units.
        median_length: median length of rays inside the bounds, scene units.
    """
    if kind == "box":
        return median_length / candidates, 0.0
    cone_angle: float = (far / near) ** (1.0 / candidates) - 1.0
    return near * cone_angle, cone_angle
