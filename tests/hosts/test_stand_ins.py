"""A host's stand-ins ask samplers in the occupancy's coordinates, and answer in the host's."""

from __future__ import annotations

import copy
import inspect
import math
from typing import Any

import pytest
import torch
from ball_occupancy import BOX, CENTRE, MARCH, ball, rays
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.viewer.utils import parse_object
from nerfstudio.viewer.viewer_elements import ViewerElement

from leco_plugin.hosts import stand_ins
from leco_plugin.hosts.guide import Guide
from leco_plugin.hosts.host_watch import begin_carefully, end_probation
from leco_plugin.occupancy import BACKDROP_PRICE, Occupancy
from leco_plugin.samplers import registry
from leco_plugin.samplers.base import Estimator
from leco_plugin.samplers.estimator import LearnedOccupancyEstimator
from leco_plugin.samplers.registry import SamplerSpec
from leco_plugin.space import Space

pytestmark = pytest.mark.usefixtures("without_cache")


def test_a_host_samples_as_with_the_estimator_itself(guide: Guide):
    own = LearnedOccupancyEstimator(ball()).eval()
    origins, directions = rays()
    expected = own.sampling(origins, directions, **MARCH)
    found = guide.estimator(BOX).eval().sampling(origins, directions, **MARCH)
    assert len(expected[0]) > 0
    for a, b in zip(found, expected):
        assert torch.equal(a, b)


def test_a_host_that_begins_carefully_keeps_more_until_it_ends(guide: Guide):
    estimator = guide.estimator(BOX).eval()
    before = len(estimator.sampling(*rays(), **MARCH)[0])
    assert begin_carefully(torch.nn.ModuleList([estimator]), guide, lambda _: 0.5)
    lower = LearnedOccupancyEstimator(guide.the_occupancy().with_threshold(0.5 / 16)).eval()
    expected = len(lower.sampling(*rays(), **MARCH)[0])
    assert len(estimator.sampling(*rays(), **MARCH)[0]) == expected > before
    assert end_probation(guide) == pytest.approx(0.5 / 16)
    assert len(estimator.sampling(*rays(), **MARCH)[0]) == before


def test_the_signature_is_that_of_estimators(guide: Guide):
    stand_in = inspect.signature(type(guide.estimator(BOX)).sampling)
    assert stand_in == inspect.signature(Estimator.sampling)


def test_a_host_in_other_coordinates_gets_the_same_samples(guide: Guide):
    turn, scale = torch.linalg.qr(torch.randn(3, 3))[0], 2.5
    turn = turn * torch.det(turn)
    shift = torch.tensor([0.3, -1.0, 0.2])
    origins, directions = rays()
    expected = guide.estimator(BOX).eval().sampling(origins, directions, **MARCH)
    # where the host sees what the occupancy sees at p: (p - shift) turned back and shrunk
    host_origins, host_directions = (origins - shift) @ turn / scale, directions @ turn
    guide.set_occupancy(ball(), torch.cat([scale * turn, shift[:, None]], dim=1))
    shorter = {name: value / scale for name, value in MARCH.items()}
    found = guide.estimator(BOX).eval().sampling(host_origins, host_directions, **shorter)
    assert abs(len(found[0]) - len(expected[0])) <= 2  # rounding at the ball's edge
    both = min(len(found[0]), len(expected[0]))
    torch.testing.assert_close(
        found[1][:both].sort()[0] * scale, expected[1][:both].sort()[0], atol=0.06, rtol=0.0
    )


def test_boxes_and_cells_are_answered_in_the_hosts_coordinates(guide: Guide):
    shift = torch.tensor([0.3, -1.0, 0.2])
    here = guide.estimator(BOX)
    boxes, opacities, decisions = here.aabbs, here.occs, here.binaries
    guide.set_occupancy(ball(), torch.cat([2.0 * torch.eye(3), shift[:, None]], dim=1))
    there = guide.estimator(BOX)
    torch.testing.assert_close(there.aabbs, (boxes - shift.repeat(2)) / 2.0)
    torch.testing.assert_close(there.occs, opacities, atol=0.02, rtol=0.0)
    assert (there.binaries != decisions).float().mean() < 1e-3
    assert 0.01 < decisions.float().mean() < 0.5


def an_unbounded_guide(threshold: float) -> Guide:
    guide = Guide()
    space = Space("contraction", (0.0, 0.0, 0.0), 1.0)
    guide.set_occupancy(Occupancy(ball().gate, space, threshold))
    return guide


def test_steps_that_do_not_grow_end_at_the_hosts_box():
    """An unbounded occupancy has no end of its own, and nerfstudio's sampler gives none."""
    guide = an_unbounded_guide(1e-9)
    inner, outer = torch.tensor([-1.0] * 3 + [1.0] * 3), torch.tensor([-2.0] * 3 + [2.0] * 3)
    origins = torch.tensor([[-3.0, 0.0, 0.0], [0.0, 1.5, 0.0], [0.0, 3.0, 0.0]])
    directions = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    guided: Any = guide.estimator(inner, outer).eval()
    march: dict[str, Any] = {"render_step_size": 0.125, "far_plane": 1e10}
    indices, _, t_ends = guided.sampling(origins, directions, **march)
    assert [float(t_ends[indices == ray].max()) for ray in (0, 1)] == pytest.approx([5.0, 0.5])
    assert not bool((indices == 2).any())
    sooner = torch.tensor([1.0, 9.0, 9.0])
    indices, _, t_ends = guided.sampling(origins, directions, t_max=sooner, **march)
    assert [float(t_ends[indices == ray].max()) for ray in (0, 1)] == pytest.approx([1.0, 0.5])
    _, _, t_ends = guided.sampling(origins, directions, cone_angle=0.5, far_plane=50.0)
    assert float(t_ends.max()) > 40.0


def test_without_an_outermost_box_they_end_at_the_one_box_that_is_given():
    inside = torch.tensor([[0.0, 0.0, 0.0]]), torch.tensor([[1.0, 0.0, 0.0]])
    box = torch.tensor([-1.0] * 3 + [1.0] * 3)
    guided: Any = an_unbounded_guide(1e-9).estimator(box).eval()
    _, _, t_ends = guided.sampling(*inside, render_step_size=0.125)
    assert float(t_ends.max()) == pytest.approx(1.0)


def test_samples_carry_no_gradient_of_the_rays_as_nerfaccs_do():
    """A ray along an axis is parallel to faces of a box: its gradient would be NaN."""
    guided: Any = an_unbounded_guide(0.5).estimator(BOX)
    origins = torch.tensor([[0.5, 0.5, -3.0]], requires_grad=True)
    directions = torch.tensor([[0.0, 0.0, 1.0]], requires_grad=True)
    indices, t_starts, t_ends = guided.sampling(origins, directions, **TO_THE_SKY)
    assert len(indices) > 0 and not t_starts.requires_grad and not t_ends.requires_grad
    middles = (t_starts + t_ends)[:, None] / 2.0
    (origins[indices] + middles * directions[indices]).sum().backward()
    for grad in (origins.grad, directions.grad):
        assert grad is not None and bool(grad.isfinite().all())


def test_a_host_may_ask_for_what_grids_of_nerfacc_have(guide: Guide):
    Guide().estimator(BOX).mark_invisible_cells(None, None, 8, 8)  # before there is an occupancy
    stand_in = guide.estimator(BOX)
    assert stand_in.levels == len(stand_in.aabbs)
    assert stand_in.levels * stand_in.cells_per_lvl == len(stand_in.occs)
    own = LearnedOccupancyEstimator(ball())
    own.mark_invisible_cells(torch.eye(3), torch.eye(4)[None], width=8, height=8, near_plane=0.1)
    assert own.levels * own.cells_per_lvl == own.binaries.numel()


TO_THE_SKY: dict[str, Any] = {"cone_angle": 0.125, "far_plane": 40.0, "render_step_size": 0.1}


def test_rays_of_an_unbounded_occupancy_end_in_a_place_for_the_sky():
    guide = an_unbounded_guide(2.0)  # which keeps nothing
    origins = torch.tensor([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0], [0.0, torch.nan, 0.0]])
    directions = torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    guided: Any = guide.estimator(BOX).eval()
    indices, t_starts, t_ends = guided.sampling(origins, directions, **TO_THE_SKY)
    assert indices.tolist() == [0, 1]
    assert t_starts.tolist() == [35.0, 35.0] and t_ends.tolist() == [40.0, 40.0]
    sooner = torch.tensor([8.0, 40.0, 40.0])
    _, t_starts, t_ends = guided.sampling(origins, directions, t_max=sooner, **TO_THE_SKY)
    assert t_starts.tolist() == [7.0, 35.0] and t_ends.tolist() == [8.0, 40.0]


def test_a_ray_that_a_crop_ends_has_no_place_for_the_sky():
    guide = an_unbounded_guide(2.0)  # which keeps nothing
    origins, directions = torch.zeros(4, 3), torch.tensor([[0.0, 0.0, 1.0]]).expand(4, 3)
    guided: Any = guide.estimator(BOX).eval()
    # cut off, around the sky and more, beyond everything, and as nerfstudio says that a ray misses
    limits = torch.tensor([[0.0, 8.0], [1.0, 90.0], [50.0, 60.0], [1e10, 1e10]])
    guide.cropped = True
    nears, fars = limits.T
    indices, t_starts, t_ends = guided.sampling(
        origins, directions, t_min=nears, t_max=fars, **TO_THE_SKY
    )
    assert indices.tolist() == [1]
    assert t_starts.tolist() == [35.0] and t_ends.tolist() == [40.0]


def test_rays_of_a_bounded_occupancy_end_so_where_pictures_show_something_there():
    walls = torch.tensor([-1.0, -1.0, -1.0, 1.0, 1.0, 1.0])
    origins = torch.tensor([[0.0, 0.0, -3.0], [0.0, 5.0, -3.0]])  # one ray meets the box
    directions = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
    march: dict[str, Any] = {"far_plane": 40.0, "render_step_size": 0.5}
    prices = ((0.0, []), (0.5, []), ("?", []), (math.inf, []), (2.0, [4.0, 40.0]))
    for price, ends in prices:
        guide, report = Guide(), {BACKDROP_PRICE: price}
        space = Space("box", (0.0, 0.0, 0.0), 1.0)
        guide.set_occupancy(Occupancy(ball().gate, space, 2.0, report=report, walls=walls))
        guided: Any = guide.estimator(None).eval()
        indices, t_starts, t_ends = guided.sampling(origins, directions, **march)
        assert t_ends.tolist() == ends and indices.tolist() == list(range(len(ends)))
        assert t_starts.tolist() == [end - 0.5 for end in ends]
        guided.train()
        guided.sampling(origins, directions, **march)
        assert guide.kept == 0  # a backdrop is nothing that the gate keeps
        guide.dense = True  # what skipping is measured against has the same sky
        assert guided.sampling(origins, directions, **march)[2].max() == max(ends, default=4.0)


def test_what_an_unbounded_occupancy_keeps_comes_before_the_backdrop_in_order():
    origins, directions = rays()
    march: dict[str, Any] = {"cone_angle": 0.05, "far_plane": 9.0, "render_step_size": 0.05}
    guide = an_unbounded_guide(0.5)
    own = LearnedOccupancyEstimator(guide.the_occupancy()).eval()
    indices, t_starts, t_ends = own.sampling(origins, directions, **march)
    before = 0.5 * (t_starts + t_ends) < 9.0 - 0.05 * 9.0
    guided: Any = guide.estimator(BOX).eval()
    found = guided.sampling(origins, directions, **march)
    is_last = found[2] == 9.0
    assert int(is_last.sum()) == len(origins)
    assert bool((found[0].diff() >= 0).all())
    assert bool(((found[1].diff() > 0) | (found[0].diff() > 0)).all())
    for ours, theirs in zip(found, (indices, t_starts, t_ends)):
        assert torch.equal(ours[~is_last], theirs[before])


def test_a_proposal_host_in_other_coordinates_samples_the_ball(guide: Guide):
    turn = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    origins, directions = rays(3)
    directions = torch.nn.functional.normalize(torch.tensor(CENTRE) - origins, dim=-1)
    guide.set_occupancy(ball(), torch.cat([turn, torch.zeros(3, 1)], dim=1))
    bundle = RayBundle(
        origins=origins @ turn,
        directions=directions @ turn,
        pixel_area=torch.ones(3, 1),
        nears=torch.zeros(3, 1),
        fars=torch.full((3, 1), 8.0),
    )
    samples, _, _ = guide.proposal(num_samples=16).eval()(bundle)
    inside = (samples.frustums.get_positions() @ turn.T - torch.tensor(CENTRE)).norm(dim=-1)
    assert (inside < 1.3).float().mean() > 0.9


def test_a_host_in_half_precision_moves_its_rays_in_full(guide: Guide):
    turn = torch.linalg.qr(torch.randn(3, 3))[0]
    guide.set_occupancy(ball(), torch.cat([turn * torch.det(turn), torch.ones(3, 1)], dim=1))
    origins, directions = rays()
    expected = guide.estimator(BOX).sampling(origins, directions, **MARCH)
    with torch.autocast("cpu", torch.bfloat16):
        found = guide.estimator(BOX).sampling(origins, directions, **MARCH)
    assert torch.equal(found[1], expected[1])


def test_a_guide_that_is_dense_for_the_moment_keeps_every_candidate(guide: Guide):
    guide.set_occupancy(copy.deepcopy(ball()))
    origins = (torch.tensor(CENTRE) + torch.tensor([0.0, 0.0, 3.0])).expand(4, 3)
    directions = torch.tensor([[0.0, 0.0, -1.0]]).expand(4, 3)
    march = MARCH | {"far_plane": 4.0}
    stand_in = guide.estimator(BOX).train()
    some = stand_in.sampling(origins, directions, **march)[0]
    assert guide.kept == len(some)
    guide.dense = True
    every = stand_in.sampling(origins, directions, **march)[0]
    guide.dense = False
    guide.the_occupancy().threshold_value.fill_(0.0)
    inside = stand_in.sampling(origins, directions, **march)[0]
    assert 0 < len(some) < len(every) and abs(len(every) - len(inside)) <= 8


class ByComposition(torch.nn.Module):
    """A sampler of another package that has an estimator, and is none of `Estimator`'s kind."""

    def __init__(self, occupancy: Occupancy) -> None:
        super().__init__()
        self.inner = LearnedOccupancyEstimator(occupancy, cache_bytes=0)

    def sampling(self, *args: Any, **kwargs: Any) -> Any:
        return self.inner.sampling(*args, **kwargs)


def test_a_sampler_that_names_no_bounds_is_compared_within_those_of_the_occupancy(
    monkeypatch: pytest.MonkeyPatch,
):
    """Beyond them nerfacc's own far plane has more candidates than anybody can shade."""
    monkeypatch.setitem(
        registry.OURS,
        "composed",
        SamplerSpec("", lambda occupancy, aabb: ByComposition(occupancy), needs_occupancy=True),
    )
    march, dense = MARCH | {"far_plane": 1e10}, []
    for sampler in ("learned-occupancy", "composed"):
        guide = Guide(sampler)
        guide.set_occupancy(copy.deepcopy(ball()))
        guide.dense = True
        dense.append(guide.estimator(BOX).sampling(*rays(), **march))
    assert all(torch.equal(one, other) for one, other in zip(*dense))


def test_the_viewer_looks_for_its_elements_before_there_is_an_occupancy():
    host = torch.nn.Module()
    host.guide = Guide()
    host.grid, host.chooser = host.guide.estimator(BOX), host.guide.proposal(num_samples=3)
    assert parse_object(host, ViewerElement, "Custom Elements") == []


def test_the_viewer_does_not_ask_a_gate_when_it_looks_for_its_elements(guide: Guide):
    host = torch.nn.Module()
    host.guide, host.grid = guide, guide.estimator(BOX)
    parse_object(host, ViewerElement, "Custom Elements")
    assert host.grid._built == {}


def test_the_backdrop_of_a_ray_whose_back_is_to_the_scene_lies_at_its_end() -> None:
    """As that of one that misses the walls beside it; one that looks at them ends behind them."""
    origins = torch.tensor([[0.0, 0.0, 3.0]]).expand(3, 3)
    directions = torch.tensor([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    nothing = torch.zeros(0, dtype=torch.int64), torch.zeros(0), torch.zeros(0)
    options = {"near_plane": 0.1, "far_plane": 9.0, "render_step_size": 0.5}
    walls = torch.tensor([-1.0] * 3 + [1.0] * 3)
    of_rays, starts, ends = stand_ins._ending_in_a_backdrop(
        nothing, origins, directions, options, walls, (None, None), None
    )
    assert of_rays.tolist() == [0, 1, 2]
    torch.testing.assert_close(ends, torch.tensor([4.0, 9.0, 9.0]))
    torch.testing.assert_close(starts, ends - 0.5)


def test_the_backdrop_of_a_ray_that_begins_behind_the_walls_lies_at_its_end() -> None:
    """One that leaves them later ends there; one that ends before it begins has none."""
    origins, directions = torch.zeros(3, 3), torch.tensor([[1.0, 0.0, 0.0]]).expand(3, 3)
    nothing = torch.zeros(0, dtype=torch.int64), torch.zeros(0), torch.zeros(0)
    limits = {"t_min": torch.tensor([2.0, 0.2, 6.0]), "t_max": torch.full((3,), 5.0)}
    walls = torch.tensor([-1.0] * 3 + [1.0] * 3)
    of_rays, starts, ends = stand_ins._ending_in_a_backdrop(
        nothing, origins, directions, limits | {"render_step_size": 0.5}, walls, (None, None), None
    )
    assert of_rays.tolist() == [0, 1] and ends.tolist() == [5.0, 1.0]
    torch.testing.assert_close(starts, ends - 0.5)
