"""The sampler for proposal hosts draws from the gate's distribution and keeps its host working."""

from __future__ import annotations

import copy

import pytest
import torch
from ball_occupancy import CENTRE, HALF, ball
from hypothesis import given, settings
from hypothesis import strategies as st
from samplers.analytic_occupancy import Balls, camera_rays

pytest.importorskip("nerfstudio")

from nerfstudio.cameras.rays import RayBundle
from nerfstudio.model_components.losses import distortion_loss, interlevel_loss
from nerfstudio.model_components.ray_samplers import UniformSampler
from nerfstudio.model_components.renderers import DepthRenderer, RGBRenderer

from leco_plugin.hosts.proposal import DenseSampler, LearnedOccupancySampler
from leco_plugin.occupancy import Occupancy

NEAR, FAR = 0.5, 4.0


def bundle(n_rays: int = 200) -> RayBundle:
    origins, directions = camera_rays(n_rays)
    return RayBundle(
        origins=origins,
        directions=directions,
        pixel_area=torch.ones(n_rays, 1),
        nears=torch.full((n_rays, 1), NEAR),
        fars=torch.full((n_rays, 1), FAR),
    )


@pytest.fixture(scope="module")
def sampler():
    return LearnedOccupancySampler(
        Balls(),
        num_samples=32,
        num_candidates=128,
        initial_sampler=UniformSampler(),
        cache_bytes=1 << 16,
    )


@pytest.mark.parametrize("training", [True, False])
def test_samples_are_sorted_between_near_and_far_and_fixed_in_number(sampler, training):
    samples, _, _ = sampler.train(training)(bundle())
    starts, ends = samples.frustums.starts[..., 0], samples.frustums.ends[..., 0]
    assert starts.shape == (200, 32)
    assert (starts >= NEAR).all()
    assert (ends <= FAR).all()
    assert (ends >= starts).all()
    torch.testing.assert_close(starts[:, 1:], ends[:, :-1])


def test_samples_lie_where_the_gate_says(sampler):
    rays = bundle()
    samples, weights, candidates = sampler.eval()(rays)
    meets = weights[0].sum(dim=1)[:, 0] > 0.5
    positions = samples.frustums.get_positions()[meets]
    occupied = sampler.estimator.occupancy.occupied(positions.reshape(-1, 3))
    # Half a candidate on either side of each ball is as near as a histogram gets.
    assert occupied.float().mean() > 0.8
    uniform = candidates[0].frustums.get_positions()[meets]
    assert sampler.estimator.occupancy.occupied(uniform.reshape(-1, 3)).float().mean() < 0.25


def test_weights_are_the_normalised_worth_of_candidates(sampler):
    rays = bundle(50)
    _, weights, candidates = sampler.eval()(rays)
    positions = candidates[0].frustums.get_positions()
    values = sampler.estimator.occupancy.query(positions.reshape(-1, 3)).view(50, 128, 1)
    worth = values * (values >= sampler.estimator.occupancy.threshold)
    expected = worth / worth.sum(dim=1, keepdim=True).clamp(min=1e-12)
    torch.testing.assert_close(weights[0], expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("training", [True, False])
def test_samples_split_the_weight_of_a_ray_evenly(sampler, training):
    samples, weights, candidates = sampler.train(training)(bundle(40))
    ends, of_candidates = samples.frustums.ends[:, -1:, 0], candidates[0].frustums
    edges = torch.cat([samples.frustums.starts[..., 0], ends], dim=1).double()
    meets = (weights[0].sum(dim=1)[:, 0] > 0.5).nonzero()[:, 0].tolist()
    for ray in meets:
        pieces = (of_candidates.starts[ray], of_candidates.ends[ray], weights[0][ray])
        in_front = torch.zeros(33, dtype=torch.float64)
        for start, end, weight in zip(*(piece[:, 0].tolist() for piece in pieces), strict=True):
            in_front += weight * ((edges[ray] - start) / (end - start)).clamp(0.0, 1.0)
        middles = (torch.arange(33) + 0.5) / 33.0
        away = 0.5 / 33.0 if training else 0.0
        assert ((in_front - middles).abs() <= away + 1e-3).all()
    assert len(meets) > 10


def test_an_empty_ray_is_sampled_uniformly(sampler):
    rays = bundle(5)
    rays.directions = rays.origins / 2.0  # away from the scene
    samples, weights, _ = sampler.eval()(rays)
    assert weights[0].sum() == 0.0
    widths = samples.deltas[..., 0]
    torch.testing.assert_close(widths, widths.mean().expand_as(widths), rtol=1e-2, atol=1e-3)


def along_y(x: float) -> RayBundle:
    """A ray through the ball's space at its centre's height, and at this x from its centre."""
    place, end = torch.tensor(CENTRE), torch.full((1, 1), 2.0 * HALF)
    origins = (place + torch.tensor([x, -HALF, 0.0]))[None]
    ahead = torch.tensor([[0.0, 1.0, 0.0]])
    return RayBundle(origins, ahead, torch.ones(1, 1), nears=torch.zeros(1, 1), fars=end)


@pytest.mark.parametrize(("x", "shown"), [(0.0, True), (1.5, False)])
def test_what_no_photograph_shows_has_no_weight_however_dense_a_host_calls_it(x, shown):
    known = ball()
    half_seen = Occupancy(known.gate, known.space, 0.5)
    half_seen.seen.cells[:, 26:38] = False  # a slab amid the ball, across the first ray
    if not shown:
        half_seen.seen.cells[48:] = False  # all that the second ray meets
    sampler = LearnedOccupancySampler(half_seen, 16, 64, UniformSampler(), cache_bytes=0).eval()
    samples, weights, candidates = sampler(along_y(x))
    unseen = half_seen.unseen(samples.frustums.get_positions()[0])
    assert bool(unseen.any()) and bool(unseen.all()) is not shown
    densities = torch.ones(1, 16, 1, requires_grad=True)
    found = samples.get_weights(densities)
    loss = interlevel_loss([*weights, found], [*candidates, samples])
    loss = loss + distortion_loss([found], [samples])
    rgb = RGBRenderer("white")(torch.zeros(1, 16, 3), found)
    (loss + rgb.sum()).backward()
    assert bool(loss.isfinite()) and bool(densities.grad.isfinite().all())
    assert not bool(found[0, unseen].any()) and not bool(densities.grad[0, unseen].any())
    assert bool((rgb < 0.9).all()) if shown else bool((rgb == 1.0).all())


def test_the_hosts_losses_and_depths_keep_working(sampler):
    def never(*_):
        raise AssertionError("there is no proposal network to ask")

    samples, weights, candidates = sampler.train()(bundle(), density_fns=[never, never])
    assert len(weights) == len(candidates) == 2
    densities = torch.rand(200, 32, 1, requires_grad=True)
    weights.append(samples.get_weights(densities))
    candidates.append(samples)
    loss = interlevel_loss(weights, candidates) + distortion_loss(weights, candidates)
    loss.backward()
    assert loss.isfinite()
    assert densities.grad is not None
    depth = DepthRenderer(method="median")(weights=weights[0], ray_samples=candidates[0])
    assert depth.shape == (200, 1)
    assert depth.isfinite().all()
    sampler.set_anneal(0.5)
    sampler.step_cb(3)


def test_the_cache_spares_the_gate(sampler):
    sampler.estimator.occupancy.asked = 0
    _, weights, _ = sampler.eval()(bundle())
    kept = int((weights[0] > 0.0).sum())
    assert sampler.estimator.occupancy.asked < kept + 0.05 * weights[0].numel()


def test_rays_without_bounds_are_refused(sampler):
    rays = bundle(3)
    rays.nears = None
    with pytest.raises(ValueError, match="nears and fars"):
        sampler(rays)


@pytest.mark.parametrize("name", ["num_samples", "num_candidates"])
@pytest.mark.parametrize("size", [0, -1, 3.5])
def test_what_is_no_number_of_samples_is_refused_in_a_line(name, size):
    with pytest.raises(ValueError, match=f"whole number of samples, got {name} {size}$"):
        LearnedOccupancySampler(Balls(), cache_bytes=0, **{name: size})
    with pytest.raises(ValueError, match=f"got samples {size}$"):
        DenseSampler(samples=size)
    assert DenseSampler(samples=4.0).samples == 4


def test_one_sample_and_one_candidate_are_enough():
    one = LearnedOccupancySampler(Balls(), num_samples=1, num_candidates=1, cache_bytes=0)
    samples, weights, _ = one.eval()(bundle(3))
    assert samples.frustums.starts.shape == weights[0].shape == (3, 1, 1)


def test_no_rays_is_no_samples(sampler):
    samples, weights, _ = sampler(bundle(0))
    assert samples.frustums.starts.shape == (0, 32, 1)
    assert weights[0].shape == (0, 128, 1)


def test_a_ray_that_ends_before_it_begins_has_samples_without_length(sampler):
    rays = bundle(4)
    rays.nears[0], rays.fars[0] = FAR, NEAR
    frustums = sampler(rays)[0].frustums
    assert torch.equal(frustums.starts[0], torch.full_like(frustums.starts[0], FAR))
    assert torch.equal(frustums.ends[0], frustums.starts[0])
    assert (frustums.ends[1:] > frustums.starts[1:]).all()


BAD = {
    "nothing": ("origins", 1.0),
    "NaN origin": ("origins", torch.nan),
    "infinite origin": ("origins", torch.inf),
    "NaN direction": ("directions", torch.nan),
    "infinite direction": ("directions", -torch.inf),
    "no direction": ("directions", 0.0),
    "NaN near": ("nears", torch.nan),
    "NaN far": ("fars", torch.nan),
    "infinite near": ("nears", torch.inf),
    "no near": ("nears", -torch.inf),
    "infinite far": ("fars", torch.inf),
    "far as if infinite": ("fars", 1e10),
    "far before all": ("fars", -torch.inf),
    "ends before it begins": ("fars", -1.0),
}


@settings(deadline=None, max_examples=60)
@given(n_rays=st.integers(0, 4), bad=st.sampled_from(sorted(BAD)), training=st.booleans())
def test_bad_rays_give_samples_that_can_be_rendered_and_harm_no_other(
    sampler, n_rays, bad, training
):
    rays, name, value = bundle(n_rays), *BAD[bad]
    clean = sampler.eval()(bundle(n_rays))[0].frustums.starts
    if n_rays and bad != "nothing":
        getattr(rays, name)[0] = value
    samples, weights, _ = sampler.train(training)(rays)
    starts, ends = samples.frustums.starts, samples.frustums.ends
    assert starts.shape == ends.shape == (n_rays, 32, 1)
    assert starts.isfinite().all() and (ends >= starts).all() and ends.isfinite().all()
    assert weights[0].isfinite().all() and (weights[0] >= 0.0).all()
    if not training:
        assert starts[1:].equal(clean[1:])
    densities = torch.rand(n_rays, 32, 1, requires_grad=True)
    samples.get_weights(densities).sum().backward()
    assert densities.grad.isfinite().all()


def test_a_frame_moves_with_its_sampler_and_is_in_no_checkpoint():
    made = LearnedOccupancySampler(ball(), cache_bytes=0, frame=torch.eye(3, 4).double())
    assert made.frame.dtype == torch.float32
    assert copy.deepcopy(made).to("meta").frame.is_meta
    assert not any("frame" in name for name in made.state_dict())
    with pytest.raises(ValueError, match=r"^frame must be \[3, 4\], got \[4, 4\]$"):
        LearnedOccupancySampler(ball(), cache_bytes=0, frame=torch.eye(4))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16])
def test_a_host_may_be_in_another_precision(dtype):
    rays = bundle(4)
    for name in ("origins", "directions", "pixel_area", "nears", "fars"):
        setattr(rays, name, getattr(rays, name).to(dtype))
    turned = LearnedOccupancySampler(
        ball(), num_samples=8, num_candidates=32, cache_bytes=0, frame=torch.eye(3, 4)
    )
    samples, weights, _ = turned(rays)
    assert samples.frustums.starts.isfinite().all()
    assert weights[0].isfinite().all() and weights[0].shape == (4, 32, 1)
