"""Rays inside a scene's bounds, and the steps in which they are marched."""

from __future__ import annotations

import pytest
import torch
from leco_plugin.models.scene_rays import cut_to_bounds, marching_rule, with_ends_for_all
from nerfstudio.cameras.rays import RayBundle

from leco_plugin.samplers.marching import march

NEAR, FAR = torch.tensor(0.1), torch.tensor(5.0)
SLAB = torch.tensor([-1e6, -1e6, -1.0, 1e6, 1e6, 1.0])


def bundle() -> RayBundle:
    """From two above a slab: straight down, level above it, and up."""
    origins = torch.tensor([[0.0, 0.0, 2.0]]).repeat(3, 1)
    directions = torch.tensor([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    images = torch.arange(3)[:, None]
    return RayBundle(origins, directions, torch.ones(3, 1), camera_indices=images)


def test_rays_are_cut_to_the_box_and_to_near_and_far() -> None:
    rays = cut_to_bounds(bundle(), SLAB, NEAR, FAR, with_images=True)
    torch.testing.assert_close(rays.t_mins[0], torch.tensor(1.0))
    torch.testing.assert_close(rays.t_maxs[0], torch.tensor(3.0))
    assert not bool((rays.t_maxs[1:] > rays.t_mins[1:]).any())
    assert rays.images is not None and rays.images.tolist() == [0, 1, 2]
    assert cut_to_bounds(bundle(), SLAB, NEAR, FAR, with_images=False).images is None


def test_rays_that_miss_get_a_piece_at_the_far_end() -> None:
    cut = cut_to_bounds(bundle(), SLAB, NEAR, FAR, with_images=False)
    rays = with_ends_for_all(cut, FAR, torch.tensor(0.5))
    torch.testing.assert_close(rays.t_mins, torch.tensor([1.0, 4.5, 4.5]))
    torch.testing.assert_close(rays.t_maxs, torch.tensor([3.0, 5.0, 5.0]))


@pytest.mark.parametrize("kind", ["box", "contraction"])
def test_a_median_ray_has_the_wanted_number_of_candidates(kind) -> None:
    length = 3.0 if kind == "box" else 4.9
    step_size, cone_angle = marching_rule(kind, 0.1, 5.0, 64, length)
    one = torch.zeros(1, 3), torch.tensor([[1.0, 0.0, 0.0]])
    ends = torch.tensor([0.1]), torch.tensor([0.1 + length])
    ray_indices, _, _ = march(*one, *ends, step_size=step_size, cone_angle=cone_angle)
    assert abs(len(ray_indices) - 64) <= 1
    assert (cone_angle > 0.0) == (kind == "contraction")


def test_a_ray_along_a_wall_that_misses_the_box_stays_finite():
    aabb = torch.tensor([-1.0, -1.0, -0.5, 1.0, 1.0, 0.5])
    bundle = RayBundle(
        origins=torch.tensor([[0.0, 0.0, 2.0]]),
        directions=torch.tensor([[1.0, 0.0, 0.0]]),
        pixel_area=torch.ones(1, 1),
    )
    rays = cut_to_bounds(bundle, aabb, torch.tensor(0.1), torch.tensor(3.0), with_images=False)
    assert bool(rays.t_mins.isfinite())
    assert bool(rays.t_maxs.isfinite())
    assert bool(rays.t_maxs <= rays.t_mins)
