"""The rays of a batch inside a scene's bounds, and the steps in which they are marched."""

from __future__ import annotations

from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from leco_plugin.models.rendering import Rays
from leco_plugin.samplers.marching.rays import intersect_box
from leco_plugin.space import SpaceKind


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

    Args:
        far, length: scalars, scene units.
    """
    missed = ~(rays.t_maxs > rays.t_mins)
    return rays._replace(
        t_mins=rays.t_mins.where(~missed, far - length), t_maxs=rays.t_maxs.where(~missed, far)
    )


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
