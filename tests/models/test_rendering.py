"""Volume rendering through gate and field: skipping nothing changes nothing."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from leco_plugin.models import rendering
from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.field import FieldConfig, HMoEField
from leco_plugin.models.figures import before_the_backdrop, gate_pictures
from leco_plugin.models.gate import Gate, GateConfig
from leco_plugin.models.hmoe import HMoEConfig
from leco_plugin.models.rendering import (
    Intervals,
    Rays,
    Routing,
    Shaded,
    backdrop_of,
    backdrop_starts,
    composite,
    gate_values_and_routes,
    mapped_middles,
    shade,
    sum_up,
    weigh,
    with_backdrop,
)
from leco_plugin.samplers import marching
from leco_plugin.samplers.marching import March, march
from leco_plugin.space import Space

ROUTINGS = {
    "threshold": Routing(0.2, False),
    "paper": Routing(None, False),
    "homogeneous": Routing(None, True),
}


class Scene:
    """A small gate and field, as they are when training begins."""

    def __init__(self) -> None:
        torch.manual_seed(0)
        encoding = EncodingConfig("hash", levels=2, log2_table=6, coarsest=4, finest=16)
        experts = HMoEConfig(scene_experts=3, width=16)
        self.field = HMoEField(FieldConfig(encoding, experts, appearance_dim=4), num_images=3)
        self.gate = Gate(GateConfig(EncodingConfig(octaves=2), width=8, scene_experts=3))
        self.space = Space("contraction", half_extent=0.5)

    def shade(self, rays: Rays, intervals: Intervals, routing: Routing, freeze=False) -> Shaded:
        scene = rendering.Scene(self.field, self.gate, self.space, routing)
        return shade(scene, rays, intervals, freeze)

    def parameters(self) -> list[Tensor]:
        return [*self.field.parameters(), *self.gate.parameters()]


def some_rays(count: int) -> Rays:
    directions = torch.nn.functional.normalize(torch.randn(count, 3), dim=-1)
    return Rays(
        torch.rand(count, 3) - 0.5,
        directions,
        torch.full((count,), 0.1),
        torch.full((count,), 3.0),
        torch.arange(count) % 3,
    )


def intervals_of(rays: Rays, occupied=None) -> Intervals:
    return Intervals(*march(marching.Rays(*rays[:4]), March(0.05), occupied))


@pytest.mark.parametrize("routing", ROUTINGS.values(), ids=ROUTINGS)
def test_a_gate_that_keeps_everything_renders_what_no_gate_renders(routing: Routing) -> None:
    scene, rays = Scene(), some_rays(9)
    everything = intervals_of(rays, lambda x: torch.ones(len(x), dtype=torch.bool))
    dense = scene.shade(rays, intervals_of(rays), routing)
    for ours, expected in zip(scene.shade(rays, everything, routing), dense):
        assert torch.equal(ours, expected)


@pytest.mark.parametrize("routing", ROUTINGS.values(), ids=ROUTINGS)
def test_weights_of_a_ray_are_opacities_that_sum_to_one_at_most(routing: Routing) -> None:
    with torch.no_grad():
        shaded = Scene().shade(some_rays(9), intervals_of(some_rays(9)), routing)
    assert float(shaded.weights.min()) >= 0.0
    assert float(shaded.accumulation.max()) <= 1.0 + 1e-5
    torch.testing.assert_close(shaded.weights.sum(), shaded.accumulation.sum())
    assert float(shaded.rgb.min()) >= 0.0 and float(shaded.rgb.max()) <= 1.0 + 1e-5


@pytest.mark.parametrize("routing", ROUTINGS.values(), ids=ROUTINGS)
@pytest.mark.parametrize(("rays", "kept"), [(0, False), (5, False), (5, True)])
def test_there_may_be_no_rays_and_no_samples(routing: Routing, rays: int, kept: bool) -> None:
    scene, batch = Scene(), some_rays(rays)
    intervals = intervals_of(batch, lambda x: torch.full((len(x),), kept))
    shaded = scene.shade(batch, intervals, routing)
    assert shaded.rgb.shape == (rays, 3)
    assert shaded.accumulation.shape == shaded.depth.shape == (rays,)
    assert shaded.packed_info.shape == (rays, 2)
    assert len(shaded.weights) == len(intervals.ray_indices)
    if not kept:
        assert not bool(shaded.rgb.any()) and torch.equal(shaded.depth, batch.t_maxs)
    met, shown = before_the_backdrop(shaded, intervals, batch)
    experts = shaded.logits.shape[-1]
    of_gate = gate_pictures(met, intervals.ray_indices, torch.rand(rays), experts)
    for picture in (shown | of_gate).values():
        assert picture.shape == (rays, 1) and picture.dtype == torch.float32
        assert bool(picture.isfinite().all())
    (shaded.rgb.sum() + shaded.depth.sum() + shaded.accumulation.sum()).backward()
    for parameter in scene.parameters():
        assert parameter.grad is None or bool(parameter.grad.isfinite().all())


def test_a_sample_behind_an_opaque_one_has_no_weight() -> None:
    scene, rays = Scene(), some_rays(4)
    torch.nn.init.constant_(scene.field.density_head.bias, 12.0)
    shaded = scene.shade(rays, intervals_of(rays), ROUTINGS["threshold"])
    first = shaded.packed_info[:, 0]
    torch.testing.assert_close(shaded.weights[first], torch.ones(4), rtol=0, atol=1e-3)
    torch.testing.assert_close(shaded.depth, torch.full((4,), 0.125), rtol=0, atol=1e-3)


def test_no_gradient_reaches_a_frozen_gate() -> None:
    scene, rays = Scene(), some_rays(4)
    scene.shade(rays, intervals_of(rays), ROUTINGS["paper"], freeze=True).rgb.sum().backward()
    assert all(parameter.grad is None for parameter in scene.gate.parameters())
    assert scene.field.density_head.weight.grad is not None


@pytest.mark.parametrize("routing", ROUTINGS.values(), ids=ROUTINGS)
def test_routes_are_experts_and_factors_teach_the_gate(routing: Routing) -> None:
    torch.manual_seed(0)
    logits = torch.randn(200, 4, requires_grad=True)
    values, routes = gate_values_and_routes(logits, routing)
    assert set(routes.tolist()) == ({1, 2, 3} if routing.homogeneous else {0, 1, 2, 3})
    assert bool(((values > 0) & (values <= 1)).all())
    values.square().sum().backward()
    assert logits.grad is not None and bool(logits.grad[routes > 0].any(dim=-1).all())


def test_by_threshold_the_factor_is_one_with_the_gradient_of_the_logarithm_of_the_share() -> None:
    torch.manual_seed(0)
    logits = torch.randn(200, 4, dtype=torch.float64, requires_grad=True)
    values, routes = gate_values_and_routes(logits, ROUTINGS["threshold"])
    assert bool((values == 1.0).all())
    (found,) = torch.autograd.grad(values.sum(), logits)
    shares = logits[:, 1:].log_softmax(dim=-1).amax(dim=-1)
    (expected,) = torch.autograd.grad(shares[routes > 0].sum(), logits)
    torch.testing.assert_close(found, expected)


@pytest.mark.parametrize("name", ["threshold", "paper"])
def test_points_of_a_dropped_expert_go_to_the_next_best_and_no_other_point_changes(
    name: str,
) -> None:
    torch.manual_seed(0)
    logits = torch.randn(500, 4)
    values, routes = gate_values_and_routes(logits, ROUTINGS[name])
    left = torch.tensor([True, False, True])
    values_left, routes_left = gate_values_and_routes(logits, ROUTINGS[name], left)
    assert torch.equal(values_left, values)
    moved = routes == 2
    assert torch.equal(routes_left[~moved], routes[~moved])
    assert bool(moved.any()) and 0 in routes
    for one, route in zip(logits[moved].tolist(), routes_left[moved].tolist(), strict=True):
        assert route == (1 if one[1] >= one[3] else 3)


def test_the_papers_factor_is_the_probability_of_the_chosen_expert() -> None:
    logits = torch.randn(200, 4)
    values, routes = gate_values_and_routes(logits, ROUTINGS["paper"])
    assert torch.equal(routes, logits.argmax(dim=-1))
    assert torch.equal(values, logits.softmax(dim=-1).amax(dim=-1))


def test_every_ray_ends_in_a_backdrop_that_absorbs_what_is_left() -> None:
    scene, rays = Scene(), some_rays(7)
    no_samples = Intervals(torch.zeros(0, dtype=torch.int64), torch.zeros(0), torch.zeros(0))
    for intervals in (intervals_of(rays), no_samples):
        ended = with_backdrop(intervals, rays, 0.05, 0.0)
        is_backdrop = backdrop_of(ended, rays)
        assert torch.equal(ended.ray_indices[is_backdrop], torch.arange(7))
        assert bool((ended.ray_indices.diff() >= 0).all())
        on_one_ray = ended.ray_indices.diff() == 0
        assert bool((ended.t_starts.diff()[on_one_ray] >= 0).all())
        shaded = scene.shade(rays, ended, ROUTINGS["threshold"])
        torch.testing.assert_close(shaded.accumulation, torch.ones(7))


def test_the_backdrop_is_the_same_whatever_was_skipped_before_it() -> None:
    rays = some_rays(5)
    ends = []
    for occupied in (None, lambda positions: positions[:, 0] > 0.0):
        ended = with_backdrop(intervals_of(rays, occupied), rays, 0.05, 0.02)
        mask = backdrop_of(ended, rays)
        ends.append(torch.stack([ended.t_starts[mask], ended.t_ends[mask]]))
    assert torch.equal(*ends)


def test_an_interval_gives_way_to_the_backdrop_that_holds_its_middle() -> None:
    rays = some_rays(1)  # ends at 3.0, in a backdrop from 2.9 on
    given = Intervals(torch.zeros(3).long(), *torch.tensor([[2.7, 2.8, 2.88], [2.8, 2.95, 3.0]]))
    ended = with_backdrop(given, rays, 0.1, 0.0)
    torch.testing.assert_close(ended.t_starts, torch.tensor([2.7, 2.8, 2.9]))
    torch.testing.assert_close(ended.t_ends, torch.tensor([2.8, 2.95, 3.0]))


def test_what_is_too_faint_to_be_coloured_changes_a_pixel_by_a_fortieth_of_a_step() -> None:
    def white(features: Tensor, *_: object) -> Tensor:
        return torch.ones(len(features), 3)

    weights = torch.logspace(-6, -1, 50)
    given = Intervals(torch.arange(50), torch.ones(50), torch.full((50,), 2.0))
    rgb = composite(white, torch.zeros(50, 2), weights, some_rays(50), given)  # type: ignore[arg-type]
    assert float((rgb - weights[:, None]).abs().max()) < 1.05 / 40.0 / 255.0
    assert torch.equal(rgb[:, 0] > 0.0, weights > 1e-4)


def test_a_ray_meets_something_from_half_opacity_on() -> None:
    rays = some_rays(2)
    given = Intervals(torch.arange(2), torch.ones(2), torch.full((2,), 2.0))
    accumulation, depth = sum_up(torch.tensor([0.49, 0.51]), rays, given)
    torch.testing.assert_close(accumulation, torch.tensor([0.49, 0.51]))
    torch.testing.assert_close(depth, torch.tensor([3.0, 1.5]))


def test_a_ray_that_misses_the_scene_stays_transparent() -> None:
    """As does one that ends where it begins, at 0.1."""
    rays = some_rays(3)
    rays = rays._replace(t_maxs=torch.tensor([0.05, 0.1, 3.0]))
    ended = with_backdrop(intervals_of(rays), rays, 0.05, 0.0)
    assert ended.ray_indices[backdrop_of(ended, rays)].tolist() == [2]


def test_the_backdrop_absorbs_without_changing_what_the_field_says() -> None:
    scene, rays = Scene(), some_rays(6)
    ended = with_backdrop(intervals_of(rays), rays, 0.05, 0.0)
    shaded = scene.shade(rays, ended, ROUTINGS["threshold"])
    assert bool(backdrop_of(ended, rays).any())
    assert float(shaded.sigmas.detach().max()) < 1e3


def test_intervals_are_asked_in_their_middles() -> None:
    space = Space()
    space.set("box", torch.zeros(3), 8.0)
    rays = Rays(
        torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]),
        torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]),
        torch.zeros(2),
        torch.full((2,), 4.0),
        None,
    )
    intervals = Intervals(
        torch.tensor([0, 1, 1, 1]),
        torch.tensor([0.0, 1.0, 2.0, 9.0]),
        torch.tensor([1.0, 2.0, 4.0, 13.0]),
    )
    # the last one lies beyond the cube, on whose face it is asked
    middles = torch.tensor([[0.0, 0.0, 0.5], [1.0, 1.5, 0.0], [1.0, 3.0, 0.0], [1.0, 8.0, 0.0]])
    torch.testing.assert_close(mapped_middles(space, rays, intervals), middles / 8.0)


def test_the_backdrop_of_a_ray_shorter_than_a_step_begins_where_the_ray_does() -> None:
    """Where some rays are cut off, by a crop, the others keep to where they enter."""
    rays = some_rays(3)._replace(
        t_mins=torch.tensor([1.0, 1.0, 1.0]),
        t_maxs=torch.tensor([1.02, 3.0, 3.0]),
        cut_off=torch.tensor([False, False, True]),
    )
    starts = backdrop_starts(rays, step_size=0.5, cone_angle=0.0)
    torch.testing.assert_close(starts, torch.tensor([1.0, 2.5, 3.0]))
    growing = backdrop_starts(rays, step_size=0.2, cone_angle=0.1)
    torch.testing.assert_close(growing, torch.tensor([1.0, 2.7, 3.0]))
    of_all = backdrop_starts(rays._replace(cut_off=None), step_size=0.2, cone_angle=0.1)
    torch.testing.assert_close(of_all, torch.tensor([0.82, 2.7, 2.7]))


def test_weights_are_of_densities_per_half_extent() -> None:
    """Of lengths of 1, 2 and 1/2 half extents, on two of three rays; and of what is opaque."""
    edges = torch.tensor([[1.0, 1.5, 2.0], [1.5, 2.5, 2.25]])
    given, sigmas = Intervals(torch.tensor([0, 0, 2]), *edges), torch.tensor([0.8, 2.0, 3.0])
    for opaque in (False, True):
        is_backdrop = torch.tensor([False, opaque, False])
        weights, packed_info = weigh(sigmas, is_backdrop, given, torch.tensor(0.5), 3)
        light = torch.tensor(-0.8).exp()
        second = light if opaque else light * -torch.tensor(-4.0).expm1()
        expected = torch.stack([1.0 - light, second, -torch.tensor(-1.5).expm1()])
        torch.testing.assert_close(weights, expected)
        assert packed_info.tolist() == [[0, 2], [2, 0], [2, 1]]
