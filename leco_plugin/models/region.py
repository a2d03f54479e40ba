"""The marched part of space: its mapping, box and range, and the directions that show a sky."""

from __future__ import annotations

from itertools import product
from typing import Any

import torch
from torch import Tensor, nn

from leco_plugin.models.rendering import Rays
from leco_plugin.samplers import marching
from leco_plugin.samplers.boxes import intersect_box
from leco_plugin.scenes.bounds import BoundsConfig, SceneBounds
from leco_plugin.scenes.input_error import InputError
from leco_plugin.seen import SeenSpace
from leco_plugin.space import Space, SpaceKind

DIRECTIONS = 16
"""Cells a side of the grid over directions: 7 degrees each."""
TOLERANCE = 0.02
"""Of the z of a unit direction, 1 degree at the horizon: between the rays that cover an image."""
FARTHEST = 1e3
"""Half extents of the space after which a ray has left it."""
SIDE = 32
"""Rays a side that cover each training image: 12 degrees apart in a panorama."""


class Region(nn.Module):
    """Where a scene lies: buffers, so that a checkpoint restores it.

    Attributes:
        space: the mapping of positions.
        known: scalar bool, whether `set` was called.
        near, far: scalars, where all rays begin and end, scene units.
        aabb: [6] corners of the box in which rays are marched.
        lowest: scalar, z below which ground hides everything; minus infinity if not known.
        backdrops: directions in which training has seen what lies beyond.
        seen: the space that training rays cross.
    """

    known: Tensor
    near: Tensor
    far: Tensor
    aabb: Tensor
    lowest: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.space = Space()
        self.register_buffer("known", torch.tensor(False))
        self.register_buffer("near", torch.tensor(0.05))
        self.register_buffer("far", torch.tensor(4.0))
        self.register_buffer("aabb", torch.tensor([-1.0] * 3 + [1.0] * 3))
        self.register_buffer("lowest", torch.tensor(-torch.inf))
        self.backdrops = SeenBackdrops()
        self.seen = SeenSpace()

    @torch.no_grad()
    def set(self, bounds: SceneBounds) -> None:
        """Fixes mapping, box and range."""
        self.space.set(bounds.kind, bounds.center, bounds.half_extent)
        self.aabb.copy_(bounds.aabb)
        self.near.fill_(bounds.near)
        self.far.fill_(bounds.far)
        self.lowest.fill_(-torch.inf if bounds.lowest is None else bounds.lowest)
        self.known.fill_(True)

    def refuse_others(self, bounds: BoundsConfig, near: float | None, far: float | None) -> None:
        """InputError if near, far or bounds that are set by hand are not those of the region."""
        asked: dict[str, tuple[Any, Tensor]] = {"near": (near, self.near), "far": (far, self.far)}
        if bounds.space != "contraction":  # else they say nothing
            asked["bounds.altitudes"] = (bounds.altitudes, self.aabb[2::3])
        other: dict[str, tuple[Any, Any]] = {
            option: (now, there.tolist())
            for option, (now, there) in asked.items()
            if now is not None and not torch.allclose(torch.tensor(now).to(there), there, rtol=1e-5)
        }
        if bounds.space not in ("auto", self.space.kind):
            other["bounds.space"] = bounds.space, self.space.kind
        for option, (now, before) in other.items():
            raise InputError(
                f"--pipeline.model.{option} is {now}, and the run that is gone on with has "
                f"{before}: leave it out, or begin a new run"
            )

    @torch.no_grad()
    def note_backdrops(self, origins: Tensor, directions: Tensor) -> None:
        """Notes in which directions training sees backdrops, from rays [N, 3] that cover its
        images: origins in scene units, unit directions."""
        cut = self.cut(origins.to(self.aabb), directions.to(self.aabb))
        self.backdrops.note(cut, ~self.leaves_by_floor(cut))

    @torch.no_grad()
    def note_crossed_space(self, origins: Tensor, directions: Tensor) -> None:
        """Notes the space that training sees, from rays as of `note_backdrops`, of all images."""
        cut = self.cut(origins.to(self.aabb), directions.to(self.aabb))
        self.seen.note(self.space, marching.Rays(*cut[:4]))

    def rays(
        self,
        origins: Tensor,
        directions: Tensor,
        images: Tensor | None,
        length: Tensor,
        crop: tuple[Tensor | None, Tensor | None] = (None, None),
    ) -> Rays:
        """Rays cut to the region and to a crop.

        A ray that misses the box keeps a backdrop at the far end: its sky. Rays of no training
        image have a backdrop only where training has seen one.

        Args:
            origins, directions: [R, 3], scene units and unit vectors.
            images: [R] int64 of training images, or None.
            length: scalar, scene units, of what is left of a ray that misses the box; at most a
                step, so that nothing but its backdrop is shaded.
            crop: nears and fars of the rays, [R] or [R, 1], scene units; None is no crop.
        """
        rays = self.cut(origins, directions, images)
        if images is None:
            rays = rays._replace(cut_off=~self.shows_backdrop(rays))
        return within_crop(with_ends_for_all(rays, self.far, length), *crop)

    def of_bundle(self, bundle: Any, training: bool, length: Tensor) -> Rays:
        """`rays` of a ray bundle of nerfstudio, whose limits are a crop; in training its images are
        training images."""
        images, crop = bundle.camera_indices if training else None, (bundle.nears, bundle.fars)
        images = None if images is None else images[:, 0]
        return self.rays(bundle.origins, bundle.directions, images, length, crop)

    def cut(self, origins: Tensor, directions: Tensor, images: Tensor | None = None) -> Rays:
        """Rays cut to box and range; one that misses them ends before it begins."""
        return cut_rays(origins, directions, self.aabb, self.near, self.far, images)

    def leaves_by_floor(self, cut: Rays) -> Tensor:
        """Whether rays leave a bounded scene through its floor, inside its cube: bool [R]."""
        ends = torch.addcmul(cut.origins, cut.directions, cut.t_maxs[:, None])
        at_floor = ends[:, 2] - self.aabb[2] <= 1e-3 * (self.aabb[5] - self.aabb[2])
        inside = self.space.map(ends).abs().amax(dim=-1) <= 1.0
        return at_floor & inside & (cut.t_maxs > cut.t_mins)

    def meet_ground(self, cut: Rays) -> Tensor:
        """Whether rays end below `lowest`, on the floor or at `far`: bool [R]."""
        ends = cut.origins[:, 2] + cut.directions[:, 2] * cut.t_maxs
        return (ends < self.lowest) & (cut.t_maxs > cut.t_mins)

    def shows_backdrop(self, cut: Rays) -> Tensor:
        """Whether training has seen the backdrop of rays that are cut to the region: bool [R]."""
        seen: Tensor = self.backdrops(cut)
        return self.leaves_by_floor(cut) | seen

    def down_to_the_floor(self, rays: Rays) -> Rays:
        """Cut rays, of which those that reach the floor beyond `far` end there: whoever looks from
        above all cameras sees the ground, where a photograph shows it."""
        end = self.far.new_tensor(FARTHEST) * self.space.half_extent
        whole = cut_rays(rays.origins, rays.directions, self.aabb, self.near, end)
        beyond = self.leaves_by_floor(whole) & (whole.t_maxs > self.far)
        ends = torch.addcmul(whole.origins, whole.directions, whole.t_maxs[:, None])
        seen = self.seen(self.space.map(ends).clamp(-1.0, 1.0).nan_to_num())
        cut_off = torch.zeros_like(beyond) if rays.cut_off is None else rays.cut_off
        return rays._replace(
            t_mins=torch.where(beyond, whole.t_mins, rays.t_mins),
            t_maxs=torch.where(beyond, whole.t_maxs, rays.t_maxs),
            cut_off=torch.where(beyond, ~seen, cut_off),
        )


class SeenBackdrops(nn.Module):
    """Directions in which training rays miss the scene, or leave it but not through its floor.

    Only there has a backdrop learned its colour: a sky, or the distance. Before any ray is noted,
    every direction counts as seen.
    """

    limits: Tensor
    """[4, cells] of directions: rows 0 and 1 of rays that meet the scene, 2 and 3 of the
    others; 0 and 2 the largest z in each cell, 1 and 3 the largest -z; 2 is nothing noted yet."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("limits", torch.full((4, DIRECTIONS**3), 2.0))

    @torch.no_grad()
    def note(self, cut: Rays, beyond: Tensor) -> None:
        """Notes rays of training images, cut to the region; those of `beyond`, bool [R], show what
        lies beyond the scene."""
        missed, heights = cut.t_maxs <= cut.t_mins, cut.directions[:, 2]
        cells, limits = cells_of(cut.directions), torch.full_like(self.limits, -2.0)
        for number, (which, z) in enumerate(product((~missed, missed), (heights, -heights))):
            noted = beyond & which
            limits[number].scatter_reduce_(0, cells[noted], z[noted], "amax")
        # neighbours count too, so that the cells of neighbouring rays leave no gap
        grids = limits.view(1, 4, DIRECTIONS, DIRECTIONS, DIRECTIONS)
        self.limits.copy_(nn.functional.max_pool3d(grids, 3, 1, 1).view_as(limits))

    def forward(self, cut: Rays) -> Tensor:
        """Whether training has seen what lies behind rays that are cut to the region: bool [R]."""
        of_each = self.limits[:, cells_of(cut.directions)] + TOLERANCE
        high, low = torch.where(cut.t_maxs > cut.t_mins, of_each[:2], of_each[2:])
        heights = cut.directions[:, 2]
        return (heights <= high) & (-heights <= low)

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *rest: Any) -> None:
        """A part of a state, without limits, changes nothing: nerfstudio loads in two parts."""
        if f"{prefix}limits" in state_dict:
            super()._load_from_state_dict(state_dict, prefix, *rest)


def cells_of(directions: Tensor) -> Tensor:
    """Cells of unit directions [R, 3] in the grid over directions: [R] int64."""
    x, y, z = ((0.5 * directions + 0.5) * DIRECTIONS).long().clamp(0, DIRECTIONS - 1).unbind(-1)
    return (x * DIRECTIONS + y) * DIRECTIONS + z


def cut_rays(
    origins: Tensor,
    directions: Tensor,
    aabb: Tensor,
    near: Tensor,
    far: Tensor,
    images: Tensor | None = None,
) -> Rays:
    """Rays [R, 3] cut to a box [6] and a range; one that misses them ends before it begins."""
    enters, leaves = intersect_box(origins, directions, aabb)
    return Rays(
        origins,
        directions,
        # finite also for a ray that runs along a wall outside, so that its backdrop has a place
        enters.clamp(min=near).clamp(max=far),
        leaves.clamp(min=0.0).clamp(max=far),
        images,
    )


def with_ends_for_all(rays: Rays, far: Tensor, length: Tensor) -> Rays:
    """Rays, of which those that miss the bounds keep the last `length` before `far`, scene units: a
    backdrop that shows their sky. Where `cut_off` says that they have none, it has no length."""
    missed = ~(rays.t_maxs > rays.t_mins)
    starts = far - length
    starts = starts if rays.cut_off is None else torch.where(rays.cut_off, far, starts)
    return rays._replace(
        t_mins=torch.where(missed, starts, rays.t_mins), t_maxs=rays.t_maxs.where(~missed, far)
    )


def within_crop(rays: Rays, nears: Tensor | None, fars: Tensor | None) -> Rays:
    """Rays between the nears and fars of a crop, see `Region.rays`. A ray that the crop ends before
    its own end has no backdrop."""
    if nears is None or fars is None:
        return rays
    t_maxs = rays.t_maxs.minimum(fars.reshape(-1))
    t_mins = rays.t_mins.maximum(nears.reshape(-1)).minimum(t_maxs)
    ended = (t_maxs < rays.t_maxs) | (t_mins >= t_maxs)
    cut_off = ended if rays.cut_off is None else rays.cut_off | ended
    return rays._replace(t_mins=t_mins, t_maxs=t_maxs, cut_off=cut_off)


def marching_rule(
    kind: SpaceKind, near: float, far: float, candidates: int, median_length: float
) -> tuple[float, float]:
    """Step size and cone angle with which a ray has about so many candidates, from where rays begin
    and end and their median length inside the bounds, all in scene units.

    A box is marched evenly; an unbounded scene in steps that grow with distance.
    """
    if kind == "box":
        return median_length / candidates, 0.0
    cone_angle: float = (far / near) ** (1.0 / candidates) - 1.0
    return near * cone_angle, cone_angle
