"""Bounds hold what the cameras see, however the scene was photographed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scene_files import refused
from tiny_scene import camera_to_world
from torch import Tensor

from leco_plugin.samplers.boxes import intersect_box
from leco_plugin.scenes import bounds as module
from leco_plugin.scenes.bounds import (
    BoundsConfig,
    SceneBounds,
    distances_from_middle,
    find_bounds,
    raise_to_cameras,
    with_range,
)


def image_rays(poses: Tensor) -> Tensor:
    """[C, 25, 3] unit directions that cover images of 53 degrees."""
    side = torch.linspace(-0.5, 0.5, 5)
    local = torch.cartesian_prod(side, side)
    local = torch.nn.functional.normalize(torch.cat([local, -torch.ones(25, 1)], dim=-1), dim=-1)
    return local @ poses[:, :, :3].mT


def from_above(scale: float = 1.0) -> tuple[Tensor, Tensor, Tensor]:
    """16 cameras 10 above a ground with hills of 1, looking down: poses, directions, points."""
    poses = torch.eye(4)[:3].repeat(16, 1, 1)
    poses[:, :2, 3] = torch.cartesian_prod(
        torch.linspace(-6.0, 6.0, 4), torch.linspace(-3.0, 5.0, 4)
    )
    poses[:, 2, 3] = 10.0
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(2000, 3, generator=generator) * torch.tensor([16.0, 14.0, 1.0])
    points[:, :2] -= torch.tensor([8.0, 6.0])
    poses[:, :, 3] *= scale
    return poses, image_rays(poses), points * scale


def around() -> tuple[Tensor, Tensor, Tensor]:
    """12 cameras in a ring around a ball of points."""
    poses = torch.stack([torch.tensor(camera_to_world(i)).float()[:3] for i in range(12)])
    points = torch.randn(2000, 3, generator=torch.Generator().manual_seed(0))
    ball = torch.nn.functional.normalize(points, dim=-1) * 0.3 + torch.tensor([0.0, 0.0, 0.3])
    return poses, image_rays(poses), ball


def ranges(bounds: SceneBounds, poses: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Where each ray begins and ends."""
    origins = poses[:, None, :, 3].expand_as(directions).reshape(-1, 3)
    enters, leaves = intersect_box(origins, directions.reshape(-1, 3), bounds.aabb)
    return enters.clamp(min=bounds.near), leaves.clamp(max=bounds.far)


def test_a_scene_seen_from_above_is_a_box_that_holds_its_points() -> None:
    poses, directions, points = from_above()
    bounds = find_bounds(poses, directions, points)
    assert bounds.kind == "box"
    assert bool((points >= bounds.aabb[:3]).all()) and bool((points <= bounds.aabb[3:]).all())
    begins, ends = ranges(bounds, poses, directions)
    assert bool((ends > begins).all())


def test_where_the_lowest_point_lies_is_known_of_a_scene_whose_planes_were_found() -> None:
    poses, directions, points = from_above()
    found = find_bounds(poses, directions, points)
    assert found.lowest == points[:, 2].sort().values[round(0.001 * (len(points) - 1))]
    assert float(found.aabb[2]) <= found.lowest - 0.199 * found.far
    for config in (BoundsConfig(altitudes=(-0.5, 2.0)), BoundsConfig(space="contraction")):
        assert find_bounds(poses, directions, points, config).lowest is None
    assert find_bounds(*around(), BoundsConfig(space="box")).lowest is None


def test_bounds_are_of_all_points_but_one_in_a_thousand_at_either_end() -> None:
    poses, directions, points = from_above()
    ends = points.sort(dim=0).values[[round(share * (len(points) - 1)) for share in (0.001, 0.999)]]
    found = find_bounds(poses, directions, points)
    relief = float(ends[1, 2] - ends[0, 2])
    assert float(found.aabb[5]) == pytest.approx(float(ends[1, 2]) + 0.3 * relief, rel=1e-5)
    inner = find_bounds(poses, directions, points, BoundsConfig(space="contraction"))
    assert inner.half_extent == pytest.approx(float((ends[1] - ends[0]).max()) / 2, rel=1e-5)
    torch.testing.assert_close(inner.center, ends.mean(dim=0))


@pytest.mark.parametrize("height", [0.0, 1.0, 20.0])
def test_a_box_has_room_below_and_above_its_points_and_all_that_rays_reach(height: float) -> None:
    poses, directions, points = from_above()
    poses[:, 2, 3] += height
    points[:, 2] *= height
    found = find_bounds(poses, directions, points)
    levels = points[:, 2].sort().values
    low, high = (float(levels[round(share * 1999)]) for share in (0.001, 0.999))
    relief = max(high - low, 0.02 * found.far)
    ground, top = low - max(0.5 * relief, 0.2 * found.far), high + 0.3 * relief
    assert found.aabb[[2, 5]].tolist() == pytest.approx([ground, top], rel=1e-5)
    assert (0.5 * relief > 0.2 * found.far) == (height == 20.0)
    reach = ((ground - poses[:, None, 2, 3]) / directions[..., 2]).clamp(max=found.far)
    hits = poses[:, None, :, 3] + directions * reach[..., None]
    ends = torch.stack([hits.amin(dim=(0, 1)), hits.amax(dim=(0, 1))])[:, :2]
    middle = [*ends.mean(dim=0).tolist(), (ground + top) / 2]
    assert found.center.tolist() == pytest.approx(middle, abs=1e-4)
    longest = max(*(ends[1] - ends[0]).tolist(), top - ground)
    assert found.half_extent == pytest.approx(1.02 * longest / 2, rel=1e-4)


@pytest.mark.parametrize(("below", "up", "kind"), [(4, 39, "box"), (5, 0, ""), (0, 41, "")])
def test_a_scene_is_from_above_where_nearly_all_cameras_and_rays_say_so(
    below: int, up: int, kind: str
) -> None:
    """Three quarters of 16 cameras, and nine tenths of 400 rays."""
    poses, directions, points = from_above()
    poses[:below, 2, 3] = 0.9 * points[:, 2].max()
    directions.view(-1, 3)[:up] = torch.tensor([0.0, 0.0, 1.0])
    assert find_bounds(poses, directions, points).kind == (kind or "contraction")


def test_bounds_are_raised_over_the_highest_camera() -> None:
    box = torch.tensor([-3.0, -1.0, -1.0, 1.0, 3.0, 2.0])
    low = SceneBounds("box", torch.tensor([-1.0, 1.0, 0.5]), 2.0, 1.5, 20.0, box, "seen", -0.5)
    heights = torch.tensor([4.0, 9.0, 6.0])
    found, as_high = raise_to_cameras(low, heights, 0.125), raise_to_cameras(low, heights / 9, 0.1)
    assert found.aabb.tolist() == pytest.approx([-6.406, -4.406, -1.0, 4.406, 6.406, 9.6])
    assert found.center.tolist() == pytest.approx([-1.0, 1.0, 4.3])
    assert found.half_extent == pytest.approx(1.02 * 10.6 / 2)
    assert (found.near, found.far, found.lowest) == (0.8, 20.0, -0.5)
    assert "12.5% of the rays" in found.reason
    assert float(as_high.aabb[5]) == 2.0 and as_high.half_extent == 2.0
    assert raise_to_cameras(replace(low, near=0.3), heights, 0.1).near == 0.3


def test_distances_from_the_middle_are_over_that_of_three_quarters() -> None:
    places = torch.randn(21, 3, generator=torch.Generator().manual_seed(0)).double()
    places = places * torch.tensor([1.0, 3.0, 9.0]) + 5.0
    away = np.linalg.norm(places.numpy() - np.median(places.numpy(), axis=0), axis=1)
    np.testing.assert_allclose(distances_from_middle(places), away / np.quantile(away, 0.75))


def test_a_ray_that_hardly_goes_down_widens_the_box_as_far_as_it_is_marched() -> None:
    """It would meet the ground some 200 away."""
    poses, directions, points = from_above()
    directions[0, 0] = torch.nn.functional.normalize(torch.tensor([-1.0, 0.0, -0.06]), dim=0)
    bounds = find_bounds(poses, directions, points)
    left = float(bounds.center[0]) - bounds.half_extent
    assert bounds.far < 40.0 and -6.0 - 1.1 * bounds.far < left < -6.0 - 0.9 * bounds.far


@pytest.mark.parametrize("make", [from_above, around])
def test_a_few_points_far_from_all_others_do_not_widen_the_bounds(make) -> None:
    poses, directions, points = make()
    usual = find_bounds(poses, directions, points)
    strays = 200.0 * torch.randn(20, 3, generator=torch.Generator().manual_seed(1))
    bounds = find_bounds(poses, directions, torch.cat([points, strays]))
    assert bounds.far == pytest.approx(usual.far, rel=0.05)
    assert bounds.half_extent == pytest.approx(usual.half_extent, rel=0.05)
    assert "20 sparse points far from all others are left out" in bounds.reason
    assert "left out" not in usual.reason


@pytest.mark.parametrize("space", ["box", "contraction"])
def test_points_that_are_left_out_are_told_whatever_is_configured(space) -> None:
    poses, directions, points = around()
    stray = torch.full((1, 3), 200.0)
    bounds = find_bounds(poses, directions, torch.cat([points, stray]), BoundsConfig(space=space))
    assert bounds.reason.endswith("; 1 sparse point far from all others is left out")


def test_points_left_out_of_a_large_cloud_are_counted_as_if_all_were_looked_at(monkeypatch) -> None:
    monkeypatch.setattr(module, "CLOUD", 1010)  # every second one of 2020
    poses, directions, points = from_above()
    strays = 200.0 * torch.randn(20, 3, generator=torch.Generator().manual_seed(1))
    reason = find_bounds(poses, directions, torch.cat([points, strays])).reason
    assert reason.endswith("; 20 sparse points far from all others are left out")


def test_a_survey_around_one_dense_building_is_no_stray() -> None:
    poses, directions, points = from_above()
    building = torch.cat([points * 0.01 + shift for shift in torch.linspace(0.0, 0.4, 10)])
    bounds = find_bounds(poses, directions, torch.cat([points, building]))
    usual = find_bounds(poses, directions, points)
    torch.testing.assert_close(bounds.aabb, usual.aabb, rtol=0.05, atol=0.05)


def test_points_at_one_place_are_one_and_strays_are_found_in_a_large_cloud() -> None:
    """Half a million points that are alike took minutes."""
    poses, directions, points = from_above()
    nothing = torch.full((500_000, 3), -300.0)
    bounds = find_bounds(poses, directions, torch.cat([points.repeat(500, 1), nothing]))
    assert bounds.far < 40.0 and float(bounds.aabb[2]) > -10.0
    assert "sparse points far from all others are left out" in bounds.reason


@pytest.mark.parametrize("at_one", [12, 19])
def test_two_standpoints_are_not_far_from_each_other(at_one: int) -> None:
    places = torch.zeros(20, 3).double()
    places[at_one:, 0] = 5.0
    assert float(distances_from_middle(places).max()) <= 1.0


def test_a_sparse_background_is_no_stray() -> None:
    poses, directions, points = around()
    walls = torch.nn.functional.normalize(
        torch.randn(1500, 3, generator=torch.Generator().manual_seed(1)), dim=-1
    )
    bounds = find_bounds(poses, directions, torch.cat([points, 30.0 * walls]))
    assert bounds.far > 30.0 and "left out" not in bounds.reason


def test_marched_samples_of_a_box_lie_in_its_space() -> None:
    poses, directions, points = from_above()
    bounds = find_bounds(poses, directions, points)
    begins, ends = ranges(bounds, poses, directions)
    origins = poses[:, None, :, 3].expand_as(directions).reshape(-1, 3)
    for t in (begins, ends):
        mapped = (origins + directions.reshape(-1, 3) * t[:, None] - bounds.center).abs()
        assert float(mapped.max()) <= bounds.half_extent * 1.0001


def test_a_scene_seen_from_around_is_contracted_with_its_points_in_the_inner_cube() -> None:
    poses, directions, points = around()
    bounds = find_bounds(poses, directions, points)
    assert bounds.kind == "contraction"
    inside = ((points - bounds.center).abs() <= bounds.half_extent * 1.05).all(dim=-1)
    assert float(inside.float().mean()) > 0.99


@pytest.mark.parametrize("scene", [from_above, around])
def test_points_lie_between_near_and_far_of_the_cameras(scene) -> None:
    poses, directions, points = scene()
    bounds = find_bounds(poses, directions, points)
    ahead = (points[None] - poses[:, None, :, 3]).norm(dim=-1)
    visible = ((points[None] - poses[:, None, :, 3]) @ -poses[:, :, 2, None])[..., 0] > 0.9 * ahead
    within = (ahead >= bounds.near) & (ahead <= bounds.far)
    assert float(within[visible].float().mean()) > 0.98


def test_near_and_far_are_quantiles_of_the_distances_to_what_is_seen() -> None:
    """Against a loop over cameras and points."""
    poses, directions, points = from_above()
    cameras, rays, places = (one.double().numpy() for one in (poses, directions, points))
    seen = []
    for pose, of_camera in zip(cameras, rays):
        widest = (of_camera @ -pose[:, 2]).min()
        offsets = places - pose[:, 3]
        lengths = (offsets**2).sum(axis=1) ** 0.5
        seen += [t for t, along in zip(lengths, offsets @ -pose[:, 2]) if along > widest * t]
    seen.sort()
    bounds = find_bounds(poses, directions, points)
    assert bounds.near == pytest.approx(0.75 * seen[round(0.01 * (len(seen) - 1))], rel=1e-5)
    assert bounds.far == pytest.approx(1.25 * seen[round(0.999 * (len(seen) - 1))], rel=1e-5)


def test_without_points_near_and_far_are_quantiles_of_where_rays_meet_the_altitudes() -> None:
    poses, directions, _ = from_above()
    poses[0, 2, 3] = 30.0  # one camera in 16 is far above the others
    bounds = find_bounds(poses, directions, None, BoundsConfig(altitudes=(-0.5, 2.0)))
    heights = poses[:, 2, 3, None].expand(directions.shape[:2])
    begins, ends = (
        sorted(((z - heights) / directions[..., 2]).flatten().tolist()) for z in (2.0, -0.5)
    )
    assert bounds.near == pytest.approx(0.75 * begins[round(0.01 * (len(begins) - 1))], rel=1e-5)
    assert bounds.far == pytest.approx(1.05 * ends[round(0.999 * (len(ends) - 1))], rel=1e-5)


def test_rays_of_cameras_below_the_top_begin_a_thousandth_of_the_farthest_away() -> None:
    """They are 10 above the ground, and the altitudes end at 12."""
    poses, directions, _ = from_above()
    bounds = find_bounds(poses, directions, None, BoundsConfig(altitudes=(-0.5, 12.0)))
    assert bounds.far > 10.5 and bounds.near == pytest.approx(1e-3 * bounds.far)


def test_bounds_grow_with_the_scene() -> None:
    one, ten = find_bounds(*from_above()), find_bounds(*from_above(10.0))
    assert ten.half_extent == pytest.approx(10.0 * one.half_extent, rel=1e-3)
    assert ten.near == pytest.approx(10.0 * one.near, rel=1e-3)
    assert ten.far == pytest.approx(10.0 * one.far, rel=1e-3)


@pytest.mark.parametrize(
    "points",
    [None, torch.zeros(3, 3), torch.full((99, 3), float("nan")), torch.full((70, 3), 0.3)],
)
def test_without_points_the_cameras_bound_the_scene(points) -> None:
    poses, directions, _ = around()
    poses[:, :, 3] = poses[:, :, 3] * torch.tensor([1.0, 2.0, 0.5]) + torch.tensor([3.0, 1.0, 2.0])
    bounds = find_bounds(poses, directions, points)
    low, high = poses[:, :, 3].amin(dim=0), poses[:, :, 3].amax(dim=0)
    half = float((high - low).max()) / 2
    assert (bounds.half_extent, bounds.near, bounds.far) == pytest.approx(
        (half, 0.05 * half, 100 * half)
    )
    torch.testing.assert_close(bounds.center, (low + high) / 2)
    assert bool(((poses[:, :, 3] - bounds.center).abs() <= bounds.half_extent * 1.001).all())


def test_one_camera_without_points_still_has_bounds() -> None:
    poses, directions, _ = around()
    bounds = find_bounds(poses[:1], directions[:1], None)
    assert bounds.half_extent > 0.0 and 0.0 < bounds.near < bounds.far


def test_broken_poses_are_refused() -> None:
    poses, directions, points = around()
    with refused("not finite"):
        find_bounds(poses * float("nan"), directions, points)


def test_points_that_no_camera_sees_are_refused() -> None:
    poses, directions, points = around()
    with refused("no camera sees"):
        find_bounds(poses, directions, points + torch.tensor([0.0, 0.0, 500.0]))


def test_the_reason_is_one_line() -> None:
    for scene in (from_above, around):
        assert "\n" not in find_bounds(*scene()).reason


def test_what_is_chosen_can_be_chosen_by_hand() -> None:
    street = find_bounds(*around(), BoundsConfig(space="box"))
    assert street.kind == "box" and "as configured" in street.reason
    poses, directions, points = from_above()
    sky = find_bounds(poses, directions, points, BoundsConfig(space="contraction"))
    assert sky.kind == "contraction" and "as configured" in sky.reason


def test_walls_by_hand_hold_cameras_and_points() -> None:
    poses, directions, points = around()
    poses[:, :, 3] += torch.tensor([0.0, 0.5, 0.0])
    poses[0, 2, 3] += 2.0
    found = find_bounds(poses, directions, points, BoundsConfig(space="box"))
    low, high = found.aabb.view(2, 3)
    both = torch.cat([poses[:, :, 3], points])
    sides = both.amax(dim=0) - both.amin(dim=0)
    margin = 0.125 * float(sides.max())
    torch.testing.assert_close(low, both.amin(dim=0) - margin, rtol=0.0, atol=0.01)
    torch.testing.assert_close(high, both.amax(dim=0) + margin, rtol=0.0, atol=0.01)
    assert found.half_extent == pytest.approx(float(sides.max()) / 2 + margin, abs=0.01)
    torch.testing.assert_close(found.center, (low + high) / 2)
    for places in (poses[:, :, 3], points):
        assert bool((places >= low).all()) and bool((places <= high).all())


@pytest.mark.parametrize("with_points", [True, False])
def test_altitudes_by_hand_cut_the_rays_with_points_and_without(with_points: bool) -> None:
    poses, directions, points = from_above()
    config = BoundsConfig(altitudes=(-0.5, 2.0))
    bounds = find_bounds(poses, directions, points if with_points else None, config)
    assert bounds.kind == "box"
    assert bounds.aabb[[2, 5]].tolist() == [-0.5, 2.0]
    begins, ends = ranges(bounds, poses, directions)
    assert bool((ends > begins).all())
    # cameras are 10 above the ground: 8 above the top, seen through 53 degrees
    assert 0.5 * 8.0 < bounds.near <= 8.0
    assert 10.5 * 1.2 < bounds.far < 10.5 * 2.0


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (BoundsConfig(altitudes=(1.0, 1.0)), "ground < top"),
        (BoundsConfig(altitudes=(float("nan"), 1.0)), "ground < top"),
        (BoundsConfig(altitudes=(20.0, 30.0)), "no ray of any camera goes down"),
    ],
)
def test_altitudes_that_are_no_range_of_these_cameras_are_refused(
    config: BoundsConfig, message: str
) -> None:
    with refused(message):
        find_bounds(*from_above(), config)


def test_a_box_without_points_asks_for_its_altitudes() -> None:
    poses, directions, _ = from_above()
    with refused(r"give bounds\.altitudes"):
        find_bounds(poses, directions, None, BoundsConfig(space="box"))
    assert "give bounds.altitudes" in find_bounds(poses, directions, None).reason


def test_a_range_by_hand_replaces_what_was_found() -> None:
    bounds = find_bounds(*from_above())
    assert with_range(bounds, None, None) == bounds
    assert with_range(bounds, 1.5, None).near == 1.5
    assert with_range(bounds, None, 99.0).far == 99.0


@pytest.mark.parametrize(("near", "far"), [(0.0, 1.0), (2.0, 2.0), (1.0, float("inf"))])
def test_a_range_by_hand_that_is_none_is_refused(near: float, far: float) -> None:
    with refused("0 < near < far"):
        with_range(find_bounds(*from_above()), near, far)
