"""What nerfacc's public tests claim of packing, scans, volume rendering and grids, on a CPU.

`test_nerfacc_versions.py` runs this file with the other version of nerfacc too.
"""

from __future__ import annotations

import pytest
import torch
from samplers.analytic_occupancy import camera_rays
from torch import Tensor

from leco_plugin.samplers import nerfacc_cpu
from leco_plugin.samplers.boxes import intersect_box

nerfacc = pytest.importorskip("nerfacc")
pytestmark = pytest.mark.usefixtures("installed")
since_0_5_3 = pytest.mark.skipif(
    not hasattr(nerfacc.RaySamples, "is_valid"), reason="nerfacc is older than 0.5.3"
)

INNER = [-0.5] * 3 + [0.5] * 3
RAYS = torch.tensor([1, 1, 1, 3, 3])
"""Of five samples; rays 0, 2 and 4 have none."""
PACKED = torch.tensor([[0, 0], [0, 3], [3, 0], [3, 2], [5, 0]])


@pytest.fixture(scope="module")
def installed():
    nerfacc_cpu.install()
    yield
    nerfacc_cpu.uninstall()


def grids(levels: int = 3, resolution: int = 16) -> tuple[Tensor, Tensor]:
    """Half of the cells at random, and boxes that double."""
    generator = torch.Generator().manual_seed(levels)
    binaries = torch.rand([levels, *[resolution] * 3], generator=generator) < 0.5
    return binaries, torch.stack([torch.tensor(INNER) * 2**level for level in range(levels)])


def ends_of(intervals) -> tuple[Tensor, Tensor]:
    return intervals.vals[intervals.is_left], intervals.vals[intervals.is_right]


def test_rays_without_samples_are_packed_too():
    assert nerfacc.pack_info(RAYS, n_rays=5).equal(PACKED)


@pytest.mark.parametrize(
    "scan", ["inclusive_sum", "exclusive_sum", "inclusive_prod", "exclusive_prod"]
)
def test_a_packed_scan_is_the_batched_one_and_so_is_its_gradient(scan):
    torch.manual_seed(1)
    values = (torch.rand(7, 300) + 0.5).requires_grad_()
    starts = torch.arange(7) * 300
    rays = torch.arange(7).repeat_interleave(300)
    results = []
    for how in (
        {},
        {"packed_info": torch.stack([starts, torch.full_like(starts, 300)], dim=-1)},
        {"indices": rays},
    ):
        scanned = getattr(nerfacc, scan)(values.flatten() if how else values, **how).flatten()
        results.append((scanned, *torch.autograd.grad(scanned.log1p().sum(), values)))
    for packed in results[1:]:
        torch.testing.assert_close(packed, results[0], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("stop", "faintest", "visible"),
    [(0.0, 0.0, [1, 1, 1, 1, 1]), (0.45, 0.0, [1, 1, 0, 1, 0]), (0.38, 0.25, [1, 1, 0, 1, 0])],
)
def test_what_is_hidden_or_faint_is_not_visible(stop, faintest, visible):
    alphas = torch.tensor([0.5, 0.3, 0.9, 0.6, 0.2])  # transmittance 1, 0.5, 0.35, 1, 0.4
    seen = nerfacc.render_visibility_from_alpha(
        alphas, ray_indices=RAYS, n_rays=5, early_stop_eps=stop, alpha_thre=faintest
    )
    assert seen.int().tolist() == visible


def test_weights_are_opacity_times_what_is_left_of_the_light():
    alphas = torch.tensor([0.5, 0.3, 0.9, 0.6, 0.2])
    weights, left = nerfacc.render_weight_from_alpha(alphas, ray_indices=RAYS, n_rays=5)
    torch.testing.assert_close(left, torch.tensor([1.0, 0.5, 0.35, 1.0, 0.4]))
    torch.testing.assert_close(weights, alphas * left)


@pytest.mark.parametrize("how", ["ray_indices", "packed_info"])
def test_densities_and_opacities_have_the_same_weights_and_gradients(how):
    rays = {"n_rays": 5, how: RAYS if how == "ray_indices" else PACKED}
    torch.manual_seed(2)
    sigmas, t_starts = torch.rand(5).requires_grad_(), torch.rand(5)
    t_ends = t_starts + torch.rand(5)
    alphas = 1.0 - torch.exp(-sigmas * (t_ends - t_starts))
    left, _ = nerfacc.render_transmittance_from_density(t_starts, t_ends, sigmas, **rays)
    found = (
        left * alphas,
        nerfacc.render_weight_from_density(t_starts, t_ends, sigmas, **rays)[0],
        nerfacc.render_weight_from_alpha(alphas, **rays)[0],
    )
    # of a whole ray 1 - exp(-sum of tau) is absorbed
    depths = (sigmas * (t_ends - t_starts)).detach()
    passed = torch.exp(-torch.stack([depths[:3].sum(), depths[3:].sum()]))
    expected = (t_ends - t_starts) * passed.repeat_interleave(torch.tensor([3, 2]))
    for weights in found:
        torch.testing.assert_close(weights, found[0])
        torch.testing.assert_close(weights[:3].sum(), 1.0 - passed[0])
        (gradient,) = torch.autograd.grad(weights.sum(), sigmas, retain_graph=True)
        torch.testing.assert_close(gradient, expected)


def test_values_are_summed_along_their_ray():
    torch.manual_seed(3)
    weights, values = torch.rand(5), torch.rand(5, 2)
    sums = nerfacc.accumulate_along_rays(weights, values, RAYS, n_rays=5)
    assert sums[[0, 2, 4]].eq(0.0).all() and sums.shape == (5, 2)
    torch.testing.assert_close(sums[1], (weights[:3, None] * values[:3]).sum(dim=0))
    torch.testing.assert_close(sums[3], (weights[3:, None] * values[3:]).sum(dim=0))


@since_0_5_3
def test_sums_are_added_to_what_is_there():
    weights, values = torch.rand(5), torch.rand(5, 2)
    there = torch.ones(5, 2)
    nerfacc.volrend.accumulate_along_rays_(weights, values, RAYS, there)
    sums = nerfacc.accumulate_along_rays(weights, values, RAYS, n_rays=5)
    torch.testing.assert_close(there, sums + 1.0)


@pytest.mark.parametrize("n_samples", [5, 0])
def test_rendering_has_colours_opacities_and_depths_of_all_rays(n_samples):
    t_starts = torch.rand(n_samples)
    colours, opacities, depths, _ = nerfacc.rendering(
        t_starts,
        t_starts + 0.1,
        ray_indices=RAYS[:n_samples],
        n_rays=5,
        rgb_sigma_fn=lambda starts, *_: (starts[:, None].expand(-1, 3), starts),
    )
    assert colours.shape == (5, 3) and opacities.shape == depths.shape == (5, 1)
    assert opacities[[0, 2, 4]].eq(0.0).all()
    assert bool((opacities[[1, 3]] > 0.0).all()) == bool(n_samples)


def test_a_box_is_hit_if_the_middle_of_the_passage_lies_inside():
    torch.manual_seed(4)
    origins = torch.rand(500, 3)
    directions = torch.nn.functional.normalize(torch.randn(500, 3), dim=-1)
    low = torch.rand(40, 3)
    boxes = torch.cat([low, low + torch.rand(40, 3)], dim=-1)
    t_mins, t_maxs, hits = nerfacc.ray_aabb_intersect(origins, directions, boxes)
    middles = ((t_mins + t_maxs) / 2).clamp(min=0.0)[..., None]
    points = origins[:, None] + middles * directions[:, None]
    inside = ((points >= boxes[:, :3]) & (points <= boxes[:, 3:])).all(dim=-1)
    assert inside.equal(hits) and 0 < int(hits.sum()) < hits.numel()


def test_every_sample_lies_in_an_occupied_cell():
    binaries, boxes = grids()
    origins, directions = camera_rays(40)
    intervals, samples, *_ = nerfacc.traverse_grids(
        origins, directions, binaries, boxes, step_size=0.01
    )
    t_starts, t_ends = ends_of(intervals)
    at = samples.ray_indices
    points = origins[at] + directions[at] * (t_starts + t_ends)[:, None] / 2.0
    occupied, inside = nerfacc.grid._query(points, binaries, boxes[0])
    assert inside.all() and len(points) > 1000
    assert float(occupied.float().mean()) > 0.999  # but for midpoints a rounding from a face


def test_samples_lie_between_the_planes():
    binaries, boxes = (
        torch.ones(1, 1, 1, 1, dtype=torch.bool),
        torch.tensor([[0.0] * 3 + [1.0] * 3]),
    )
    origin = torch.tensor([[-1.0, 0.1, 0.1]])
    direction = torch.nn.functional.normalize(torch.tensor([[1.0, 0.02, 0.01]]), dim=-1)
    near, far = torch.tensor([1.3]), torch.tensor([1.7])
    intervals, samples, *_ = nerfacc.traverse_grids(
        origin, direction, binaries, boxes, step_size=0.05, near_planes=near, far_planes=far
    )
    assert len(samples.vals) == 8
    assert intervals.vals.min() >= near - 0.025 and intervals.vals.max() <= far + 0.025


def test_the_grid_keeps_to_the_distances_of_each_ray():
    torch.manual_seed(5)
    grid = nerfacc.OccGridEstimator(INNER, resolution=16, levels=3)
    grid.binaries = grids()[0]
    origins = torch.rand(64, 3) - 0.5
    directions = torch.nn.functional.normalize(torch.rand(64, 3), dim=-1)
    t_min = torch.rand(64)
    t_max = t_min + torch.rand(64)
    rays, t_starts, t_ends = grid.sampling(
        *(origins, directions),
        near_plane=0.2,
        far_plane=0.9,
        t_min=t_min,
        t_max=t_max,
        render_step_size=0.01,
    )
    assert (t_starts >= t_min.clamp(min=0.2)[rays] - 0.005).all()
    assert (t_ends <= t_max.clamp(max=0.9)[rays] + 0.005).all() and len(rays) > 100


@since_0_5_3
def test_cells_that_no_camera_sees_are_marked():
    grid = nerfacc.OccGridEstimator(INNER, resolution=16, levels=2)
    intrinsics = torch.tensor([[[50.0, 0.0, 20.0], [0.0, 50.0, 20.0], [0.0, 0.0, 1.0]]])
    pose = torch.eye(4)[None, :3]
    pose[0, 2, 3] = -2.0  # looks along +z
    grid.mark_invisible_cells(intrinsics, pose, width=40, height=40)
    centres = torch.stack(
        [box[:3] + grid.grid_coords / 15 * (box[3:] - box[:3]) for box in grid.aabbs]
    )
    depth = centres[..., 2] + 2.0
    pixels = centres[..., :2] / depth[..., None] * 50.0 + 20.0
    seen = (depth > 0.0) & ((pixels >= 0.0) & (pixels < 40.0)).all(dim=-1)
    assert grid.occs.view(2, -1).ge(0.0).equal(seen) and 0 < int(seen.sum()) < seen.numel()
    before = grid.occs.clone()
    grid.update_every_n_steps(0, lambda points: torch.ones(len(points), 1))
    assert grid.occs[before < 0.0].eq(-1.0).all() and grid.binaries.flatten().equal(before >= 0.0)


def slow_traverse(
    origins: Tensor, directions: Tensor, near: Tensor, far: Tensor, step: float, limit: int
) -> tuple[list[tuple[int, float]], list[float]]:
    """Kept (ray, start), and where each ray is left, a step at a time in float64."""
    binaries, boxes = grids()
    enters, leaves = intersect_box(origins, directions, boxes[-1])
    kept, left = [], []
    for ray in range(len(origins)):
        t, t_max, count = near[ray].item(), leaves.minimum(far)[ray].item(), 0
        while enters[ray] < t_max and t + step / 2 < t_max and count != limit:
            point = (origins[ray] + directions[ray] * (t + step / 2))[None].float()
            if t + step / 2 >= enters[ray] and bool(
                nerfacc.grid._query(point, binaries, boxes[0])[0]
            ):
                kept.append((ray, t))
                count += 1
            t += step
        left.append(t)
    return kept, left


@since_0_5_3
@pytest.mark.parametrize("limit", [None, 0, 1, 7])
def test_a_limit_keeps_the_first_samples_and_each_ray_says_where_it_was_left(limit):
    binaries, boxes = grids()
    origins, directions = camera_rays(30)
    directions[:5] = -directions[:5]  # miss
    near, far = torch.rand(30), torch.rand(30) + 2.0
    near[5] = 9.0  # behind
    planes = {"near_planes": near, "far_planes": far, "step_size": 0.03}
    origins = origins * 1.5
    intervals, samples, left = nerfacc.traverse_grids(
        origins, directions, binaries, boxes, traverse_steps_limit=limit, **planes
    )
    kept, slowly_left = slow_traverse(
        *(rays.double() for rays in (origins, directions, near, far)), 0.03, limit or -1
    )
    ours = set(zip(samples.ray_indices.tolist(), ends_of(intervals)[0].mul(1e3).round().tolist()))
    assert len(ours ^ {(ray, round(start * 1e3)) for ray, start in kept}) <= 0.01 * len(ours)
    assert (left - torch.tensor(slowly_left)).abs().lt(1e-4).float().mean() > 0.95
    assert left[:6].equal(near[:6])
    assert samples.is_valid.all() and samples.packed_info[:, 1].max() <= (limit or 10_000)


@since_0_5_3
def test_rays_in_portions_have_the_samples_of_rays_at_once():
    binaries, boxes = grids()
    rays = (*camera_rays(20), binaries, boxes)
    whole, _, left = nerfacc.traverse_grids(*rays, step_size=0.02)
    sums = nerfacc.accumulate_along_rays(
        ends_of(whole)[0], None, whole.ray_indices[whole.is_left], 20
    )
    in_portions, near, mask, portions = torch.zeros(20, 1), None, None, 0
    while mask is None or mask.any():
        intervals, samples, near = nerfacc.traverse_grids(
            *rays,
            step_size=0.02,
            near_planes=near,
            traverse_steps_limit=25,
            over_allocate=True,
            rays_mask=mask,
        )
        mask, portions = samples.packed_info[:, 1] == 25, portions + 1
        starts, valid = ends_of(intervals)[0], samples.ray_indices[samples.is_valid]
        in_portions += nerfacc.accumulate_along_rays(starts, None, valid, 20)
    assert portions > 2
    torch.testing.assert_close(in_portions, sums, rtol=5e-3, atol=0.1)  # a face, a rounding away
    torch.testing.assert_close(near, left)


@since_0_5_3
def test_known_crossings_and_masked_rays_are_obeyed():
    rays = (*camera_rays(20), *grids())
    t_mins, t_maxs, hits = nerfacc.ray_aabb_intersect(rays[0], rays[1], rays[3])
    t_sorted, t_indices = torch.cat([t_mins, t_maxs], dim=-1).sort(dim=-1)
    known = {"t_sorted": t_sorted, "t_indices": t_indices}
    _, whole, left = nerfacc.traverse_grids(*rays, step_size=0.02)
    _, same, same_left = nerfacc.traverse_grids(*rays, step_size=0.02, hits=hits, **known)
    assert same.vals.equal(whole.vals) and same_left.equal(left)
    missed = hits.clone()
    missed[::2] = False
    masked = torch.arange(20) % 2 == 1
    for some in ({"hits": missed, **known}, {"rays_mask": masked}):
        _, samples, some_left = nerfacc.traverse_grids(*rays, step_size=0.02, **some)
        assert samples.vals.equal(whole.vals[masked[whole.ray_indices]])
        assert some_left.equal(left.where(masked, 0.0))
    with pytest.raises(ValueError, match="traverse_steps_limit"):
        nerfacc.traverse_grids(*rays, over_allocate=True)
