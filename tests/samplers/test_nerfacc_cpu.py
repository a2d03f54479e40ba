"""nerfacc on a machine without CUDA: answers by its definitions, and a stock host that runs."""

from __future__ import annotations

import importlib.util
import sys
from types import ModuleType

import pytest
import torch
from samplers.analytic_occupancy import camera_rays, slow_march, slow_weights

from leco_plugin.hosts.guide import Guide
from leco_plugin.hosts.seams import swap_sampler
from leco_plugin.samplers import nerfacc_cpu
from leco_plugin.samplers.grid import OccupancyGridEstimator
from leco_plugin.scenes.input_error import InputError

nerfacc = pytest.importorskip("nerfacc")


@pytest.fixture
def installed():
    nerfacc_cpu.install()
    yield
    nerfacc_cpu.uninstall()


def stock_grid(levels: int = 2, resolution: int = 8):
    torch.manual_seed(0)
    grid = nerfacc.OccGridEstimator([-0.5] * 3 + [0.5] * 3, resolution=resolution, levels=levels)
    grid.binaries = torch.rand(grid.binaries.shape) < 0.3
    return grid


def test_nothing_is_patched_by_an_import_and_everything_is_given_back():
    nerfacc_cpu.uninstall()  # an earlier test of this process may have built a host
    before = (nerfacc.pack_info, nerfacc.volrend.exclusive_sum, nerfacc.grid.traverse_grids)
    with pytest.raises(NotImplementedError):
        nerfacc.pack_info(torch.tensor([0, 1]))
    nerfacc_cpu.install()
    nerfacc_cpu.install()
    assert nerfacc.pack_info(torch.tensor([0, 1])).tolist() == [[0, 1], [1, 1]]
    assert nerfacc.estimators.occ_grid.traverse_grids is nerfacc.traverse_grids
    nerfacc_cpu.uninstall()
    assert before == (nerfacc.pack_info, nerfacc.volrend.exclusive_sum, nerfacc.grid.traverse_grids)


def test_what_was_imported_by_name_before_is_reached_too(monkeypatch):
    nerfacc_cpu.uninstall()
    earlier = ModuleType("a_host_of_somebody")
    earlier.pack, earlier.other = nerfacc.pack_info, len
    monkeypatch.setitem(sys.modules, earlier.__name__, earlier)
    before = dict(vars(earlier))
    nerfacc_cpu.install()
    assert earlier.pack(torch.tensor([0, 1])).tolist() == [[0, 1], [1, 1]]
    assert earlier.pack is nerfacc.pack_info and earlier.other is len
    nerfacc_cpu.uninstall()
    assert vars(earlier) == before


def test_a_module_that_waits_for_its_first_use_goes_on_waiting(monkeypatch, tmp_path):
    nerfacc_cpu.uninstall()
    (tmp_path / "a_lazy_module.py").write_text("raise ImportError('of no concern')")
    monkeypatch.syspath_prepend(tmp_path)
    spec = importlib.util.find_spec("a_lazy_module")
    spec.loader = importlib.util.LazyLoader(spec.loader)
    lazy = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "a_lazy_module", lazy)
    spec.loader.exec_module(lazy)
    nerfacc_cpu.install()
    with pytest.raises(ImportError, match="of no concern"):
        _ = lazy.anything


def longer(rays_o, rays_d, binaries, aabbs, near, far, step_size, cone_angle, over_allocate): ...


@pytest.mark.parametrize("theirs", [longer, None])
def test_another_nerfacc_is_refused_in_a_line_and_left_as_it_is(monkeypatch, theirs):
    nerfacc_cpu.uninstall()
    monkeypatch.setattr(nerfacc, "traverse_grids", theirs)
    before = nerfacc.pack_info
    with pytest.raises(ImportError, match=r"^traverse_grids of nerfacc .* nerfacc==0\.5\.2[^\n]*$"):
        nerfacc_cpu.install()
    assert nerfacc.pack_info is before


def test_with_cuda_nerfacc_is_touched_for_a_model_on_another_device_only(monkeypatch):
    nerfacc_cpu.uninstall()
    before = nerfacc.pack_info
    with monkeypatch.context() as machine:
        machine.setattr(torch.cuda, "is_available", lambda: True)
        machine.setattr(nerfacc, "traverse_grids", longer)  # a nerfacc that nobody here knows
        for device in (None, "cuda", torch.device("cuda:1")):
            nerfacc_cpu.install_for(device)
        with pytest.raises(InputError, match="no sampler that could be swapped"):
            swap_sampler(torch.nn.Identity(), Guide())
        with pytest.raises(ImportError):
            nerfacc_cpu.install_for("cpu")
        machine.undo()
        machine.setattr(torch.cuda, "is_available", lambda: True)
        assert nerfacc.pack_info is before
        nerfacc_cpu.install_for("cpu")
        assert nerfacc.pack_info is not before
        nerfacc_cpu.uninstall()
        machine.setattr(torch.cuda, "is_available", lambda: False)
        nerfacc_cpu.install_for(None)
        assert nerfacc.pack_info is not before
    nerfacc_cpu.uninstall()


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize("cone_angle", [0.0, 0.01])
def test_the_stock_grid_samples_what_its_cells_say(cone_angle):
    grid = stock_grid()
    origins, directions = camera_rays(60)
    ray_indices, t_starts, _ = grid.sampling(
        origins, directions, render_step_size=0.03, cone_angle=cone_angle, far_plane=4.0
    )
    ours = OccupancyGridEstimator([-0.5] * 3 + [0.5] * 3, resolution=8, levels=2)
    ours.binaries.copy_(grid.binaries)
    expected = slow_march(
        origins,
        directions,
        torch.zeros(60),
        torch.full((60,), 4.0),
        0.03,
        cone_angle,
        ours.occupied,
    )
    kept = set(zip(ray_indices.tolist(), t_starts.mul(1e3).round().tolist(), strict=True))
    wanted = {(ray, round(start * 1e3)) for ray, start, _ in expected}
    assert len(wanted ^ kept) <= 0.002 * len(wanted)  # midpoints a rounding from a face


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize(("asked", "largest"), [("sigma_fn", 30.0), ("alpha_fn", 0.9)])
@pytest.mark.parametrize("stratified", [False, True])
def test_our_grid_clips_shifts_and_prunes_as_nerfaccs_own_code(asked, largest, stratified):
    stock = stock_grid()
    stock.occs = torch.rand_like(stock.occs) * 0.4
    ours = OccupancyGridEstimator([-0.5] * 3 + [0.5] * 3, resolution=8, levels=2)
    ours.binaries.copy_(stock.binaries)
    ours.occs.copy_(stock.occs)

    def field(t_starts, t_ends, ray_indices):
        return ((t_starts + t_ends) * 40.0 + ray_indices).sin().abs() * largest

    options = {
        "near_plane": 1.2,
        "far_plane": 3.0,
        "t_min": torch.rand(60) + 0.7,
        "t_max": torch.rand(60) + 2.3,
        "render_step_size": 0.03,
        "stratified": stratified,
    }
    limits = {"early_stop_eps": 0.05, "alpha_thre": 0.15}
    found = []
    for pruned in ({}, {asked: field, **limits}):
        for grid in (stock, ours):
            torch.manual_seed(3)
            found.append(grid.sampling(*camera_rays(60), **options, **pruned))
    for theirs, own in (found[:2], found[2:]):
        for one, other in zip(theirs, own, strict=True):
            assert one.equal(other)
    assert 0 < len(found[2][0]) < len(found[0][0])


@pytest.mark.usefixtures("installed")
def test_intervals_share_edges_as_nerfacc_has_them():
    grid = stock_grid(levels=1)
    origins, directions = camera_rays(60)
    intervals, samples, *_ = nerfacc.traverse_grids(
        origins, directions, grid.binaries, grid.aabbs, step_size=0.03
    )
    t_starts, t_ends = intervals.vals[intervals.is_left], intervals.vals[intervals.is_right]
    torch.testing.assert_close((t_starts + t_ends) / 2.0, samples.vals)
    assert intervals.ray_indices[intervals.is_left].equal(samples.ray_indices)
    assert int(samples.packed_info[:, 1].sum()) == len(samples.vals)
    assert int(intervals.packed_info[:, 1].sum()) == len(intervals.vals)
    shared = intervals.is_left & intervals.is_right
    assert 0 < int(shared.sum()) < len(samples.vals)
    assert len(intervals.vals) == 2 * len(samples.vals) - int(shared.sum())


@pytest.mark.usefixtures("installed")
def test_boxes_are_hit_where_the_slabs_meet():
    origins, directions = camera_rays(200)
    directions[:100] = -directions[:100]  # away from the boxes
    origins[::3] *= 0.15  # within the first
    boxes = torch.tensor([[-0.5] * 3 + [0.5] * 3, [0.2, -1.0, -1.0, 0.3, 1.0, 1.0]])
    t_mins, t_maxs, hits = nerfacc.ray_aabb_intersect(origins, directions, boxes, 0.0, 1e10, -7.0)
    expected = nerfacc.grid._ray_aabb_intersect(origins, directions, boxes, 0.0, 1e10, -7.0)
    torch.testing.assert_close(t_mins, expected[0])
    torch.testing.assert_close(t_maxs, expected[1])
    assert hits.equal(expected[2])
    assert 0 < hits.sum() < 300


@pytest.mark.usefixtures("installed")
def test_rendering_is_the_sum_of_the_definition():
    ray_indices = torch.tensor([0, 0, 0, 2, 2])
    t_starts, sigmas = torch.arange(5.0), torch.rand(5)
    colors, opacities, _, extras = nerfacc.rendering(
        t_starts,
        t_starts + 0.5,
        ray_indices,
        n_rays=3,
        rgb_sigma_fn=lambda *_: (torch.ones(5, 3), sigmas),
    )
    weights, _, _ = slow_weights(sigmas * 0.5, ray_indices)
    assert extras["weights"].tolist() == pytest.approx(weights, abs=1e-6)
    assert opacities[:, 0].tolist() == pytest.approx([sum(weights[:3]), 0.0, sum(weights[3:])])
    torch.testing.assert_close(colors, opacities.expand(3, 3))


@pytest.mark.gpu
def test_samples_are_those_of_nerfaccs_kernels():
    grid = stock_grid(levels=3).cuda()
    origins, directions = (rays.cuda() for rays in camera_rays(2000))
    theirs = grid.sampling(origins, directions, render_step_size=0.01)
    grid, origins, directions = grid.cpu(), origins.cpu(), directions.cpu()
    nerfacc_cpu.install()
    ours = grid.sampling(origins, directions, render_step_size=0.01)
    nerfacc_cpu.uninstall()
    kept = [
        set(zip(s[0].tolist(), (s[1] * 1e3).round().tolist(), strict=True)) for s in (theirs, ours)
    ]
    assert len(kept[0] ^ kept[1]) <= 1e-3 * len(kept[0])


@pytest.mark.usefixtures("installed")
def test_stock_instant_ngp_trains_and_renders():
    pytest.importorskip("nerfstudio")
    from nerfstudio.cameras.cameras import Cameras
    from nerfstudio.cameras.rays import RayBundle
    from nerfstudio.data.scene_box import SceneBox
    from nerfstudio.models.instant_ngp import InstantNGPModelConfig

    from leco_plugin.hosts.guided import Host, set_up_host

    torch.manual_seed(0)
    config = InstantNGPModelConfig(
        grid_resolution=16,
        grid_levels=1,
        max_res=64,
        log2_hashmap_size=10,
        render_step_size=0.05,
        background_color="white",
        disable_scene_contraction=True,
        cone_angle=0.0,
        eval_num_rays_per_chunk=1024,
    )
    box = SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3]))
    model = set_up_host(config, Host, scene_box=box, num_train_data=1)
    optimizer = torch.optim.Adam(model.get_param_groups()["fields"], lr=1e-2)
    losses = []
    for step in range(40):
        origins, directions = camera_rays(128, seed=step)
        bundle = RayBundle(
            origins=origins,
            directions=directions,
            pixel_area=torch.ones(128, 1),
            camera_indices=torch.zeros(128, 1, dtype=torch.int64),
        )
        model.occupancy_grid.update_every_n_steps(
            step, lambda x: model.field.density_fn(x) * config.render_step_size
        )
        # A dark ball before a white sky.
        nearest = origins - directions * (origins * directions).sum(dim=-1, keepdim=True)
        image = 1.0 - 0.9 * (nearest.norm(dim=-1, keepdim=True) < 0.5).float().expand(-1, 3)
        loss = sum(model.get_loss_dict(model(bundle), {"image": image}).values())
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert sum(losses[-5:]) < 0.5 * sum(losses[:5])
    pose = torch.eye(4)[None, :3]
    pose[0, 2, 3] = 2.0
    camera = Cameras(pose, fx=30.0, fy=30.0, cx=8.0, cy=8.0, width=16, height=16)
    outputs = model.eval().get_outputs_for_camera(camera)
    assert outputs["rgb"].shape == (16, 16, 3)
    assert outputs["rgb"][8, 8].mean() < outputs["rgb"][0, 0].mean()
