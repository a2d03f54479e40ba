"""The estimators answer as nerfacc's does, argument for argument."""

from __future__ import annotations

import copy
import inspect

import pytest
import torch
from ball_occupancy import CENTRE, RADIUS, ball
from hypothesis import given, settings
from hypothesis import strategies as st
from samplers.analytic_occupancy import Balls, camera_rays, slow_march

from leco_plugin.models.compute import native
from leco_plugin.samplers import marching, packed
from leco_plugin.samplers.base import DenseEstimator
from leco_plugin.samplers.estimator import LearnedOccupancyEstimator
from leco_plugin.samplers.grid import OccupancyGridEstimator
from leco_plugin.samplers.kernels import VARIABLE, native_march

BUDGET = 1 << 16

needs_compiler = pytest.mark.skipif(not native.has_native(), reason="no C compiler")


@pytest.fixture(scope="module", params=["box", "contraction"])
def learned(request):
    return LearnedOccupancyEstimator(Balls(request.param), cache_bytes=BUDGET)


@pytest.fixture(scope="module")
def bare():
    return LearnedOccupancyEstimator(Balls(), cache_bytes=0)


def test_the_interface_is_that_of_nerfaccs_grid():
    nerfacc = pytest.importorskip("nerfacc")
    theirs = inspect.signature(nerfacc.OccGridEstimator.sampling).parameters
    ours = inspect.signature(LearnedOccupancyEstimator.sampling).parameters
    assert [(p.name, p.default) for p in ours.values()] == [
        (p.name, p.default) for p in theirs.values()
    ]


def test_samples_are_the_occupied_candidates(bare):
    origins, directions = camera_rays(40)
    near, far = torch.tensor([0.3, 0.7]).repeat(20), torch.tensor([2.1, 3.0, 1.9, 1.7]).repeat(10)
    planes = {"near_plane": 0.5, "far_plane": 2.0}  # each is the narrower limit of some rays
    samples = bare.sampling(
        origins, directions, t_min=near, t_max=far, render_step_size=0.03, **planes
    )
    ends = near.clamp(min=0.5), far.clamp(max=2.0)
    expected = slow_march(origins, directions, *ends, 0.03, 0.0, bare.occupancy.occupied)
    assert samples[0].tolist() == [ray for ray, _, _ in expected]
    assert samples[1].tolist() == pytest.approx([start for _, start, _ in expected], abs=1e-5)


def test_the_cache_changes_almost_no_sample(learned):
    bare = LearnedOccupancyEstimator(learned.occupancy, cache_bytes=0)
    origins, directions = camera_rays(3000)
    options = {"render_step_size": 0.01, "far_plane": 6.0}
    with_cache = learned.sampling(origins, directions, **options)
    learned.occupancy.asked = 0
    without = bare.sampling(origins, directions, **options)
    kept = [set(zip(s[0].tolist(), s[1].tolist(), strict=True)) for s in (with_cache, without)]
    assert len(kept[0] ^ kept[1]) <= 1e-4 * learned.occupancy.asked


@needs_compiler
@pytest.mark.parametrize("cone_angle", [0.0, 0.01])
def test_the_march_in_c_is_that_of_torch(learned, cone_angle, monkeypatch):
    monkeypatch.setattr(native, "RAYS_AT_ONCE", 70)
    monkeypatch.setattr(native_march, "CANDIDATES_AT_ONCE", 100_000)  # a batch in parts
    origins, directions = camera_rays(500)
    directions[7] = torch.nan
    options = {"render_step_size": 0.01, "near_plane": 0.1, "far_plane": 6.0}
    learned.occupancy.asked = 0
    ours = learned.sampling(origins, directions, cone_angle=cone_angle, **options)
    asked, learned.occupancy.asked = learned.occupancy.asked, 0
    monkeypatch.setenv(VARIABLE, "native")
    theirs = learned.sampling(origins, directions, cone_angle=cone_angle, **options)
    assert 0 < asked == learned.occupancy.asked < len(ours[0])
    for one, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(one, other)


def test_stratified_sampling_shifts_by_less_than_a_step(bare):
    origins, directions = camera_rays(50)
    options = {"render_step_size": 0.1, "near_plane": 1.0, "far_plane": 3.0}
    dense = DenseEstimator()
    torch.manual_seed(0)
    one = dense.sampling(origins, directions, stratified=True, **options)
    torch.manual_seed(1)
    other = dense.sampling(origins, directions, stratified=True, **options)
    still = dense.sampling(origins, directions, **options)
    first = [samples[1][packed.pack_info(samples[0], 50)[:, 0]] for samples in (one, other, still)]
    assert not torch.equal(first[0], first[1])
    for start in first[:2]:
        assert ((start - first[2] >= 0.0) & (start - first[2] < 0.1)).all()


def test_densities_prune_what_cannot_be_seen(bare):
    origins, directions = camera_rays(100)
    plain = bare.sampling(origins, directions, render_step_size=0.01)

    def sigma_fn(t_starts, t_ends, ray_indices):
        return torch.full_like(t_starts, 100.0)

    seen = bare.sampling(origins, directions, sigma_fn=sigma_fn, render_step_size=0.01)
    counts = packed.pack_info(seen[0], 100)[:, 1]
    # An opacity of 1 - 1/e each: transmittance passes 1e-4 after ten samples.
    assert counts.equal(packed.pack_info(plain[0], 100)[:, 1].clamp(max=10))
    alphas = bare.sampling(
        origins,
        directions,
        alpha_fn=lambda t, *_: torch.full_like(t, 1.0 - torch.e**-1),
        render_step_size=0.01,
    )
    assert alphas[0].equal(seen[0])


def test_a_field_that_knows_nothing_yet_loses_no_sample(bare):
    origins, directions = camera_rays(100)
    plain = bare.sampling(origins, directions, render_step_size=0.01)
    pruned = bare.sampling(
        origins,
        directions,
        sigma_fn=lambda t, *_: torch.full_like(t, 1e-3),
        alpha_thre=0.01,
        render_step_size=0.01,
    )
    assert len(pruned[0]) == len(plain[0])


@settings(deadline=None, max_examples=30)
@given(alpha_thre=st.floats(0.0, 0.3), brightest=st.floats(1e-3, 1.0), seed=st.integers(0, 2**16))
def test_samples_are_dropped_below_the_given_opacity_and_a_tenth_of_the_mean(
    bare, alpha_thre, brightest, seed
):
    origins, directions = camera_rays(20)
    plain = bare.sampling(origins, directions, render_step_size=0.03)
    torch.manual_seed(seed)
    alphas = torch.rand(len(plain[0])) * brightest
    kept = bare.sampling(
        origins,
        directions,
        alpha_fn=lambda *_: alphas,
        alpha_thre=alpha_thre,
        early_stop_eps=0.0,
        render_step_size=0.03,
    )
    least = min(alpha_thre, sum(alphas.tolist()) / len(alphas) / 10.0)
    expected = [n for n, alpha in enumerate(alphas.tolist()) if alpha >= least]
    assert abs(len(kept[0]) - len(expected)) <= 1  # one may lie on the threshold
    if len(kept[0]) == len(expected):
        assert kept[1].equal(plain[1][expected])


@pytest.mark.parametrize("training", [True, False])
def test_no_more_candidates_than_a_chunk_are_worked_on_at_once(training, monkeypatch):
    estimator, asked = LearnedOccupancyEstimator(Balls(), cache_bytes=0).train(training), []
    estimator.occupancy.occupied = lambda positions: (
        asked.append(len(positions)) or (positions[:, 0] > 0.0)
    )
    rays = camera_rays(100)
    whole = estimator.sampling(*rays, render_step_size=0.01)
    at_most = max(asked)
    monkeypatch.setattr(marching, "CPU_CHUNK", 256)
    asked.clear()
    in_chunks = estimator.sampling(*rays, render_step_size=0.01)
    assert all(map(torch.equal, whole, in_chunks))
    assert max(asked) <= 256 < at_most


def test_a_frozen_gate_is_not_updated_and_answers_like_a_grid(learned):
    learned.update_every_n_steps(step=0, occ_eval_fn=None)
    resolution = learned.resolution.tolist()
    assert learned.binaries.shape == (1, *resolution)
    assert learned.occs.shape == (resolution[0] ** 3,)
    assert learned.aabbs.shape == (1, 6)
    filled = OccupancyGridEstimator(learned.aabbs[0], resolution=resolution)
    filled.binaries.copy_(learned.binaries)
    positions = torch.rand(5000, 3) * 1.6 - 0.8
    agreement = filled.occupied(positions) == learned.occupancy.occupied(positions)
    assert agreement.float().mean() > 0.98


def test_a_threshold_of_0_marks_every_cell():
    balls = Balls(sharpness=1e4)
    balls.threshold = 0.0
    estimator = LearnedOccupancyEstimator(balls, cache_bytes=0)
    assert float(estimator.occs.min()) == 0.0 and bool(estimator.binaries.all())


def test_no_box_is_needed_and_one_may_be_given():
    balls = Balls("contraction")
    origins, directions = camera_rays(50)
    free = LearnedOccupancyEstimator(balls, cache_bytes=0)
    boxed = LearnedOccupancyEstimator(balls, [-0.1, -1.0, -1.0, 1.0, 1.0, 1.0], cache_bytes=0)
    options = {"render_step_size": 0.01, "cone_angle": 0.004}
    assert free.bounds() is None
    everything = free.sampling(origins, directions, far_plane=1e10, **options)
    part = boxed.sampling(origins, directions, **options)
    assert 0 < len(part[0]) < len(everything[0])
    positions = origins[part[0]] + directions[part[0]] * ((part[1] + part[2]) / 2)[:, None]
    assert positions[:, 0].min() > -0.1 - 1e-4


NO_BOXES = {
    "inverted": [1.0, 1.0, 1.0, 0.0, 0.0, 0.0],
    "flat": [0.0, 0.0, 0.0, 1.0, 1.0, 0.0],
    "NaN": [torch.nan] * 6,
    "infinite": [0.0] * 3 + [torch.inf] * 3,
    "of three numbers": [0.0, 1.0, 2.0],
    "ragged": [[0.0], [1.0, 2.0]],
    "a word": "box",
}


@pytest.mark.parametrize("aabb", NO_BOXES.values(), ids=NO_BOXES)
def test_what_is_no_box_is_refused_in_a_line(aabb):
    for build in (
        DenseEstimator,
        OccupancyGridEstimator,
        lambda aabb: LearnedOccupancyEstimator(Balls(), aabb, cache_bytes=0),
    ):
        with pytest.raises(ValueError, match=r"^aabb must be a finite box \(min, max\), got "):
            build(aabb)


@settings(deadline=None, max_examples=30)
@given(
    n_rays=st.integers(0, 5),
    bad=st.sampled_from(["none", "nan", "inf", "no direction", "backwards"]),
    cone_angle=st.sampled_from([0.0, 0.01]),
)
def test_bad_rays_give_well_formed_samples_that_can_be_rendered(learned, n_rays, bad, cone_angle):
    origins, directions = camera_rays(n_rays)
    t_min, t_max = torch.zeros(n_rays), torch.full((n_rays,), 4.0)
    if n_rays:
        origins[0] = {"nan": torch.nan, "inf": torch.inf}.get(bad, 0.0) + origins[0]
        directions[0] = directions[0] * (bad != "no direction")
        t_min[0] = 5.0 if bad == "backwards" else 0.0
    ray_indices, t_starts, t_ends = learned.sampling(
        origins, directions, t_min=t_min, t_max=t_max, render_step_size=0.05, cone_angle=cone_angle
    )
    assert ray_indices.dtype == torch.int64
    assert ray_indices.shape == t_starts.shape == t_ends.shape
    assert bad == "none" or not (ray_indices == 0).any()
    sigmas = torch.ones_like(t_starts).requires_grad_()
    weights, *_ = packed.render_weight_from_density(
        t_starts, t_ends, sigmas, ray_indices=ray_indices, n_rays=n_rays
    )
    packed.accumulate_along_rays(weights, None, ray_indices, n_rays).sum().backward()
    assert sigmas.grad is not None


def test_rays_that_do_not_fit_are_named(bare):
    origins, directions = camera_rays(3)
    with pytest.raises(ValueError, match=r"t_min must be \[3\], got \[2\]"):
        bare.sampling(origins, directions, t_min=torch.zeros(2))
    with pytest.raises(ValueError, match="t_max is on meta, the estimator on cpu"):
        bare.sampling(origins, directions, t_max=torch.ones(3, device="meta"))
    with pytest.raises(ValueError, match="rays are on meta"):
        bare.sampling(origins.to("meta"), directions.to("meta"))
    with pytest.raises(ValueError, match=r"rays_d must be \[3, 3\]"):
        bare.sampling(origins, directions[:2])
    for boxed in (bare, LearnedOccupancyEstimator(Balls("contraction"), cache_bytes=0)):
        with pytest.raises(ValueError, match=r"^rays_d is torch\.float32 on meta, but rays_o"):
            boxed.sampling(origins, directions.to("meta"), far_plane=4.0)
        with pytest.raises(ValueError, match=r"^rays_d is torch\.float64 on cpu, but rays_o"):
            boxed.sampling(origins, directions.double(), far_plane=4.0)
    for shape in ((3,), (1, 3, 3), (3, 2), ()):
        with pytest.raises(ValueError, match=r"rays_o must be \[n_rays, 3\], got \["):
            bare.sampling(torch.zeros(shape), directions)
    with pytest.raises(ValueError, match="give a far plane"):
        DenseEstimator().sampling(origins, directions)
    for wrong in ({"t_min": 0.2}, {"rays_o": origins.numpy()}, {"rays_d": None}):
        with pytest.raises(TypeError, match=f"^{next(iter(wrong))} must be a tensor, got "):
            bare.sampling(**{"rays_o": origins, "rays_d": directions, **wrong})


@pytest.mark.parametrize(
    ("step_size", "cone_angle", "said"),
    [
        (0.0, 0.01, "step_size must be positive and finite, got 0.0"),
        (torch.inf, 0.01, "step_size must be positive and finite, got inf"),
        (0.01, torch.inf, "cone_angle must be finite and not negative, got inf"),
    ],
)
def test_a_march_that_cannot_be_is_refused_in_the_same_words_with_cells(
    learned, bare, step_size, cone_angle, said
):
    for estimator in (learned, bare):
        with pytest.raises(ValueError, match=said):
            estimator.sampling(
                *camera_rays(3), far_plane=4.0, render_step_size=step_size, cone_angle=cone_angle
            )


@pytest.mark.parametrize("number", [int, torch.tensor], ids=["whole", "tensor"])
def test_a_step_may_be_a_whole_number_or_a_tensor(learned, number):
    rays = camera_rays(200)
    expected, given = (
        learned.sampling(*rays, far_plane=200.0, render_step_size=step, cone_angle=cone)
        for step, cone in ((1.0, 0.0), (number(1), number(0)))
    )
    assert len(expected[0]) > 10
    assert all(map(torch.equal, given, expected))


def test_positions_that_do_not_fit_are_named(learned):
    for asked in (learned, LearnedOccupancyEstimator(ball(), cache_bytes=0).occupancy):
        with pytest.raises(ValueError, match=r"^positions must be \[N, 3\], got \[3\]$"):
            asked.occupied(torch.zeros(3))
        with pytest.raises(TypeError, match="must be a tensor, got list"):
            asked.occupied([[0.0, 0.0, 0.0]])


def test_what_is_no_occupancy_is_refused_in_a_line():
    with pytest.raises(TypeError, match=r"^Occupancy\.load\(FILE\) gives an .*; a str is none$"):
        LearnedOccupancyEstimator("box.safetensors")


@pytest.mark.parametrize("kind", ["box", "contraction"])
def test_rays_in_other_coordinates_are_named_once(kind, caplog):
    estimator = LearnedOccupancyEstimator(Balls(kind), cache_bytes=0)
    origins, directions = camera_rays(40)
    for _ in range(2):
        estimator.sampling(origins * 100.0, directions, far_plane=4.0)
    said = [record.getMessage() for record in caplog.records]
    assert len(said) == 1 and said[0].startswith("none of a batch of 40 rays comes near what this")
    caplog.clear()
    quiet = LearnedOccupancyEstimator(Balls(kind), cache_bytes=0)
    quiet.eval().sampling(origins * 100.0, directions, far_plane=4.0)  # a part of a picture
    quiet.train().sampling(origins, directions, far_plane=4.0)
    quiet.sampling(origins[:9] * 100.0, directions[:9], far_plane=4.0)
    given = LearnedOccupancyEstimator(Balls(kind), [5.0] * 3 + [6.0] * 3, cache_bytes=0)
    given.sampling(origins, directions, far_plane=4.0)
    assert not caplog.records


def test_an_occupancy_in_double_precision_keeps_what_it_keeps_in_single():
    rays = camera_rays(400)
    one, other = (
        LearnedOccupancyEstimator(occupancy, cache_bytes=BUDGET).sampling(
            *rays, render_step_size=0.05, far_plane=8.0
        )
        for occupancy in (ball(), copy.deepcopy(ball()).double())
    )
    assert len(one[0]) > 100
    assert all(map(torch.equal, one, other))


def test_rays_that_end_before_they_begin_are_told_as_such(caplog):
    rays = camera_rays(40)
    estimator = LearnedOccupancyEstimator(ball(), cache_bytes=0).train()
    assert not len(estimator.sampling(*rays, near_plane=5.0, far_plane=4.0)[0])
    assert [each.message for each in caplog.records] == [
        "all of a batch of 40 rays end before they begin"
    ]


def test_rays_that_begin_behind_what_an_occupancy_is_of_are_named_too(caplog):
    origins, directions = camera_rays(40)
    for begin, said in ((0.0, 0), (4.0, 1)):
        caplog.clear()
        estimator = LearnedOccupancyEstimator(Balls(), cache_bytes=0)
        estimator.sampling(origins, directions, near_plane=begin, far_plane=8.0)
        assert len(caplog.records) == said


def test_rays_may_be_in_double_precision():
    learned = LearnedOccupancyEstimator(ball(), cache_bytes=BUDGET)
    origins = torch.tensor(CENTRE).double() + torch.tensor([[0.0, 0.0, 4.0]]).double()
    downwards = torch.tensor([[0.0, 0.0, -1.0]]).double()
    _, t_starts, t_ends = learned.sampling(origins, downwards, render_step_size=0.1, far_plane=8.0)
    assert t_starts.dtype == torch.float64
    middles = 0.5 * (t_starts + t_ends)
    assert len(middles) > 15 and (middles - 4.0).abs().max() < RADIUS + 0.1
