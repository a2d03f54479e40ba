"""Rays inside a scene's region, and the steps in which they are marched."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from leco_plugin.models.region import Region, SeenBackdrops, marching_rule, within_crop
from leco_plugin.models.rendering import Rays
from leco_plugin.samplers import marching
from leco_plugin.samplers.marching import March, march
from leco_plugin.scenes.bounds import BoundsConfig, SceneBounds
from leco_plugin.scenes.input_error import InputError
from leco_plugin.space import NO_WALL

SLAB = torch.tensor([-NO_WALL, -NO_WALL, -1.0, NO_WALL, NO_WALL, 1.0])


def region_of(aabb: torch.Tensor, far: float = 5.0, half: float = 1.0) -> Region:
    region = Region()
    region.set(SceneBounds("box", torch.zeros(3), half, 0.1, far, aabb, ""))
    return region


def rays_of(region: Region, images: torch.Tensor | None = None, cut: bool = False) -> Rays:
    """From two above a slab: straight down, level above it, and up."""
    origins = torch.tensor([[0.0, 0.0, 2.0]]).repeat(3, 1)
    directions = torch.tensor([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    if cut:
        return region.cut(origins, directions, images)
    return region.rays(origins, directions, images, torch.tensor(0.5))


def test_rays_are_cut_to_the_box_and_to_near_and_far() -> None:
    region = region_of(SLAB)
    assert bool(region.known) and not bool(Region().known)
    for lowest in (None, 0.0, 0.4, None):  # of None nothing is known of the ground
        region.set(SceneBounds("box", torch.zeros(3), 1.0, 0.1, 5.0, SLAB, "", lowest))
        expected = -torch.inf if lowest is None else lowest
        assert float(region.lowest) == pytest.approx(expected)
    rays = rays_of(region, torch.arange(3), cut=True)
    torch.testing.assert_close(rays.t_mins[0], torch.tensor(1.0))
    torch.testing.assert_close(rays.t_maxs[0], torch.tensor(3.0))
    assert not bool((rays.t_maxs[1:] > rays.t_mins[1:]).any())
    assert rays.images is not None and rays.images.tolist() == [0, 1, 2]
    assert rays_of(region, cut=True).images is None


def test_rays_that_miss_get_a_piece_at_the_far_end() -> None:
    rays = rays_of(region_of(SLAB), torch.arange(3))
    torch.testing.assert_close(rays.t_mins, torch.tensor([1.0, 4.5, 4.5]))
    torch.testing.assert_close(rays.t_maxs, torch.tensor([3.0, 5.0, 5.0]))


def test_a_crop_that_ends_no_ray_leaves_each_its_backdrop_or_none() -> None:
    rays = rays_of(region_of(SLAB), torch.arange(3))
    rays = rays._replace(cut_off=torch.tensor([True, False, True]))
    cropped = within_crop(rays, torch.zeros(3), torch.full((3,), 9.0))
    assert cropped.cut_off is not None and cropped.cut_off.tolist() == [True, False, True]


def test_ground_beyond_far_is_reached_where_a_photograph_shows_it() -> None:
    """As far as a thousand half extents away."""
    region = region_of(SLAB, far=2.5, half=2.0)
    region.seen.cells[:32] = False  # where x is negative
    down, level = [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]
    origins = torch.tensor([[0.5, 0.0, 1900.0], [-0.5, 0.0, 9.0], [0.5, 0.0, 9.0], [0.5, 0, 2100]])
    directions = torch.tensor([down, down, level, down])
    cut = region.rays(origins, directions, None, torch.tensor(0.5))
    whole = region.down_to_the_floor(cut)
    torch.testing.assert_close(whole.t_mins, torch.tensor([1899.0, 8.0, 2.0, 2.0]))
    torch.testing.assert_close(whole.t_maxs, torch.tensor([1901.0, 10.0, 2.5, 2.5]))
    assert whole.cut_off is not None and whole.cut_off.tolist() == [False, True, False, False]


@pytest.mark.parametrize(
    ("far", "by_floor", "meets_ground"),
    [
        (2.9, [False] * 5, [False] * 5),
        (2.99, [False] * 5, [True, False, True, False, False]),
        (3.5, [True, False, False, False, False], [True, False, True, False, False]),
    ],
)
def test_a_ray_leaves_by_the_floor_that_ends_on_it_within_the_cube(
    far: float, by_floor: list[bool], meets_ground: list[bool]
) -> None:
    """Down, up, down beside the cube, level, and down from the floor itself."""
    region = region_of(SLAB, far)
    region.lowest.fill_(-0.95)
    origins = [[0.5, 0, 2], [0.5, 0, -2], [1.5, 0, 2], [-4.0, 0, -0.5], [0.5, 0, -1]]
    directions = [[0.0, 0, -1], [0, 0, 1], [0, 0, -1], [1, 0, 0], [0, 0, -1]]
    cut = region.cut(torch.tensor(origins), torch.tensor(directions))
    assert region.leaves_by_floor(cut).tolist() == by_floor
    assert region.meet_ground(cut).tolist() == meets_ground


@pytest.mark.parametrize("kind", ["box", "contraction"])
def test_a_median_ray_has_the_wanted_number_of_candidates(kind) -> None:
    length = 3.0 if kind == "box" else 4.9
    rule = March(*marching_rule(kind, 0.1, 5.0, 64, length))
    one = torch.zeros(1, 3), torch.tensor([[1.0, 0.0, 0.0]])
    ends = torch.tensor([0.1]), torch.tensor([0.1 + length])
    ray_indices, _, _ = march(marching.Rays(*one, *ends), rule)
    assert abs(len(ray_indices) - 64) <= 1
    assert (rule.cone_angle > 0.0) == (kind == "contraction")


@pytest.mark.parametrize("height", [-2.0, 2.0])
def test_a_ray_along_a_wall_that_misses_the_box_stays_finite(height: float) -> None:
    region = region_of(torch.tensor([-1.0, -1.0, -0.5, 1.0, 1.0, 0.5]), far=3.0)
    rays = region.cut(torch.tensor([[0.0, 0.0, height]]), torch.tensor([[1.0, 0.0, 0.0]]))
    assert 0.1 <= float(rays.t_mins) <= 3.0
    assert 0.0 <= float(rays.t_maxs) <= float(rays.t_mins)


def test_a_backdrop_is_known_within_a_degree_of_where_it_was_seen() -> None:
    def at(heights: list[float], length: float, aside: float = 0.0) -> Rays:
        z = torch.tensor(heights)
        y = torch.full_like(z, aside)
        directions = torch.stack([(1.0 - z * z - y * y).sqrt(), y, z], dim=1)
        ends = torch.ones_like(z), torch.full_like(z, 1.0 + length)
        return Rays(torch.zeros_like(directions), directions, *ends, None)

    heights = [0.27, 0.29, 0.31, 0.33]
    for noted, other in ((1.0, -1.0), (-1.0, 1.0)):  # of rays that meet the scene, and that miss it
        backdrops = SeenBackdrops()
        backdrops.note(at([0.3, 0.1], noted), torch.tensor([True, False]))
        assert backdrops(at(heights, noted)).tolist() == [False, True, True, False]
        assert not bool(backdrops(at([*heights, 0.1], other)).any())
        assert not bool(backdrops(at([0.1], noted)).any())
        beside = [bool(backdrops(at([0.3], noted, aside))) for aside in (-0.2, -0.1, 0.2, 0.3)]
        assert beside == [False, True, True, False]  # in cells that touch, an eighth wide


@pytest.mark.parametrize(
    ("asked", "option"),
    [
        ((BoundsConfig(), 0.1005, None), "near"),
        ((BoundsConfig(), None, 3.99), "far"),
        ((BoundsConfig(altitudes=(-0.7, 0.5)), None, None), "bounds.altitudes"),
        ((BoundsConfig(altitudes=(-2.0, 2.0)), None, None), "bounds.altitudes"),
        ((BoundsConfig(space="contraction"), None, None), "bounds.space"),
        ((BoundsConfig(), None, None), None),
        ((BoundsConfig("box", (-0.7, 0.6)), 0.1, 4.0), None),
    ],
)
def test_a_run_that_is_gone_on_with_lies_where_it_was_begun(asked: Any, option: Any) -> None:
    region = region_of(torch.tensor([-1.0, -2.0, -0.7, 1.0, 2.0, 0.6]), far=4.0)
    if option is None:
        region.refuse_others(*asked)
        return
    with pytest.raises(
        InputError,
        match=rf"--pipeline\.model\.{option} is .*, and the run that is gone on with has",
    ):
        region.refuse_others(*asked)
