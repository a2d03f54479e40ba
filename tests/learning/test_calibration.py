"""The threshold is the largest whose measured price is within its bounds."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from leco_plugin.learning.calibration import (
    THRESHOLDS,
    CalibrationConfig,
    Measured,
    backdrop_price,
    calibrate,
    image_price,
    lost_by_each,
    measure,
    promise,
    ray_prices,
    thresholds_below,
    worst_of,
)
from leco_plugin.learning.dense import (
    SURFACE_STEPS,
    DenseRendering,
    Reference,
    evaluating,
    near_median_depth,
    near_surface,
    reference_of,
    weights_by_ray,
)
from leco_plugin.models.rendering import Intervals, Rays, Shaded
from leco_plugin.occupancy import CAMERAS_THAT_VOUCH
from leco_plugin.samplers.packed import accumulate_along_rays, pack_info

RAYS, SAMPLES = 20, 30
CONFIG = CalibrationConfig()


class Chunk:
    """Synthetic rays with grey samples, whose pixels are their weights times their greys."""

    def __init__(self, seed: int) -> None:
        generator = torch.Generator().manual_seed(seed)
        self.ray_indices = torch.arange(RAYS).repeat_interleave(SAMPLES)
        starts = torch.arange(SAMPLES).float().repeat(RAYS)
        logits = torch.randn(RAYS, SAMPLES, generator=generator) * 3
        weights = (0.9 * logits.softmax(dim=-1)).flatten()
        # the gate knows the weights, up to some noise
        noise = torch.rand(len(weights), generator=generator) ** 4
        occupancies = (weights * 10).clamp(max=1.0) * (1.0 - noise)
        self.greys = torch.rand(len(weights), 3, generator=generator)
        near = weights > 0.01
        intervals = Intervals(self.ray_indices, starts, starts + 1.0)
        self.reference = Reference(
            intervals, weights, occupancies, near, self.render(weights), torch.zeros_like(near)
        )
        self.truth = self.reference.rgb + 0.05 * torch.randn(RAYS, 3, generator=generator)

    def render(self, weights: Tensor) -> Tensor:
        return accumulate_along_rays(weights, self.greys, self.ray_indices, RAYS)


class Problem:
    def __init__(self, seed: int) -> None:
        self.chunks = [Chunk(seed), Chunk(seed + 1)]
        self.references = [chunk.reference for chunk in self.chunks]
        self.truths = [chunk.truth for chunk in self.chunks]

    def render_kept(self, number: int, mask: Tensor) -> Tensor:
        chunk = self.chunks[number]
        return chunk.render(chunk.reference.weights * mask)

    def rendering(self) -> DenseRendering:
        return DenseRendering(self.references, self.truths, self.render_kept)


def test_a_backdrop_that_the_gate_calls_empty_is_neither_skipped_nor_lost() -> None:
    problem = Problem(0)
    last = torch.arange(RAYS * SAMPLES) % SAMPLES == SAMPLES - 1
    problem.references = [
        reference._replace(
            always_kept=last, occupancies=reference.occupancies.masked_fill(last, 0.0)
        )
        for reference in problem.references
    ]
    found = measure(problem.rendering(), threshold=1.0)
    kept = sum(int((one.occupancies >= 1.0).sum()) for one in problem.references)
    backdrops = 2 * RAYS
    assert found.empty_fraction == pytest.approx(1.0 - (kept + backdrops) / (2 * RAYS * SAMPLES))
    everything = sum(float(reference.weights.sum()) for reference in problem.references)
    skipped = sum(
        float(one.weights[(one.occupancies < 1.0) & ~last].sum()) for one in problem.references
    )
    assert found.lost_mass == pytest.approx(skipped / everything, rel=1e-5)


@settings(deadline=None, max_examples=20)
@given(
    seed=st.integers(0, 2**16),
    mass=st.sampled_from([1e-4, 1e-2, 0.2]),
    price=st.sampled_from([0.01, 0.1, 1.0]),
)
def test_the_threshold_is_the_largest_that_fits(seed: int, mass: float, price: float) -> None:
    problem, config = Problem(seed), CalibrationConfig(mass, price)
    found = calibrate(problem.rendering(), config)
    fitting = [t for t in THRESHOLDS if measure(problem.rendering(), t).within(config)]
    assert found.threshold == max(fitting, default=0.0)
    assert found.threshold == 0.0 or found.within(config)


@pytest.mark.parametrize("share", [0.3, 0.9, 1.5])
@pytest.mark.parametrize("seed", range(4))
def test_earlier_and_new_costs_share_one_bound(seed: int, share: float) -> None:
    """A small gate skips on top of a learned one, so that each may not spend all of it."""
    rendering, config = Problem(seed).rendering(), CalibrationConfig(0.05, 0.5)
    spent = Measured(0.5, share * 0.05, 0.01, share * 0.5, 0.5, 0.004, 0.03)._asdict()

    def costs(threshold: float) -> Measured:
        found = measure(rendering, threshold)
        return found._replace(
            lost_surface_mass=found.lost_surface_mass + share * 0.05,
            image_price_db=max(0.0, found.image_price_db) + share * 0.5,
            surface_error=math.hypot(found.surface_error, 0.004),
            price_error_db=math.hypot(found.price_error_db, 0.03),
        )

    fitting = [t for t in THRESHOLDS if costs(t).within(config)]
    found = calibrate(rendering, config, spent=spent)
    assert found == measure(rendering, max(fitting, default=0.0))
    assert (found.threshold == 0.0) == (share > 1.0)
    assert found.threshold <= calibrate(rendering, config).threshold


def test_a_price_that_nobody_knows_was_not_spent_and_one_that_is_no_number_stays_none() -> None:
    """A report of another program may say null for a price."""
    found = Measured(0.5, 1e-4, 1e-3, 0.02, 0.5, 1e-5, 1e-3)
    known = found.on_top_of({"lost_surface_mass": 2e-4, "image_price_db": None})
    assert known.lost_surface_mass == pytest.approx(3e-4)
    assert known.image_price_db == 0.02
    gained = {"image_price_db": -0.5, "lost_mass": 2e-3, "price_error_db": 2e-3}
    assert found.on_top_of(gained)[2:4] == (pytest.approx(3e-3), 0.02), "no gain is spent"
    assert found.on_top_of(gained).price_error_db == pytest.approx(math.hypot(1e-3, 2e-3))
    costs = Measured(0.5, math.nan, 0.1, math.nan, 0.5).on_top_of({"image_price_db": 0.01})
    assert math.isnan(costs.image_price_db) and math.isnan(costs.lost_surface_mass)
    assert costs.lost_mass == 0.1


def test_no_photograph_that_vouches_loses_more_than_its_bound() -> None:
    """What it has lost so far counts too."""
    problem, config = Problem(0), CalibrationConfig(0.05, 1.0)
    cameras = [Chunk(seed).reference for seed in (12, 13, 17, 25, 36, 39, 42, 43, 44)]
    alone = calibrate(problem.rendering(), config)
    lower = THRESHOLDS[THRESHOLDS.index(alone.threshold) + 1]
    bound, allowed = (worst_of(lost_by_each(cameras, one)) for one in (lower, alone.threshold))
    assert allowed > bound > config.camera_surface_mass
    narrow = replace(config, camera_surface_mass=bound)
    found = calibrate(problem.rendering(), narrow, cameras=cameras)
    assert found == measure(problem.rendering(), lower)
    promised = promise(lost_by_each(cameras, found.threshold), narrow)
    assert promised["worst_surface_mass"] == promised["bound"] == bound
    assert (promised["count"], promised["confidence"]) == (9, 0.9)

    config = replace(config, camera_surface_mass=allowed)
    assert calibrate(problem.rendering(), config, cameras=cameras) == alone
    earlier = allowed - bound
    spent = {CAMERAS_THAT_VOUCH: {"worst_surface_mass": earlier}}
    assert calibrate(problem.rendering(), config, cameras=cameras, spent=spent).threshold == lower
    assert promise([0.0, earlier], config)["bound"] == allowed
    assert promise([0.0], config, taught=True)["confidence"] is None
    beyond = {CAMERAS_THAT_VOUCH: {"worst_surface_mass": 2.0 * allowed}}
    # a view that is lost already does not give up the others
    assert calibrate(problem.rendering(), narrow, cameras=cameras, spent=beyond) == found


def test_a_view_that_no_threshold_does_justice_to_lowers_nothing_and_is_said() -> None:
    problem, config = Problem(0), CalibrationConfig(0.05, 1.0, camera_surface_mass=0.01)
    strange = Chunk(10).reference
    strange = strange._replace(occupancies=torch.zeros_like(strange.occupancies))
    alone = calibrate(problem.rendering(), config)
    assert calibrate(problem.rendering(), config, cameras=[strange]) == alone
    lost = lost_by_each([strange], alone.threshold)
    assert promise(lost, config)["bound"] == pytest.approx(1.0)
    assert promise([], config) is None


@pytest.mark.parametrize(("more", "followed"), [(24, True), (26, False)])
def test_vouching_photographs_keep_a_quarter_more(more: int, followed: bool) -> None:
    """A hundred candidates are kept for the held-out ray, and some more for the photograph."""
    occupancies = torch.tensor([1.0] * 100 + [0.2] * more + [0.0] * 300)
    ray_indices, starts = torch.zeros(len(occupancies)).long(), torch.arange(len(occupancies)) * 1.0
    grey, intervals = torch.full((1, 3), 0.5), Intervals(ray_indices, starts, starts + 1.0)

    def seen_at(occupancy: float) -> Reference:
        there, weights = occupancies == occupancy, (occupancies == occupancy).float()
        never = occupancies < 0
        return Reference(intervals, weights / there.sum(), occupancies, there, grey, never)

    ray, photograph = seen_at(1.0), seen_at(0.2)
    rendering = DenseRendering([ray], [grey], lambda number, mask: grey)
    found = calibrate(rendering, CONFIG, cameras=[photograph])
    assert (found.threshold <= 0.2) == followed
    assert followed or found == calibrate(rendering, CONFIG)


def test_what_a_photograph_loses_never_falls_as_the_threshold_rises() -> None:
    losses = [lost_by_each([Chunk(3).reference], one)[0] for one in reversed(THRESHOLDS)]
    assert losses == sorted(losses) and losses[0] < losses[-1] < 1.0


def test_a_photograph_whose_loss_is_no_number_vouches_for_nothing() -> None:
    problem, sound = Problem(0), Chunk(3).reference
    broken = sound._replace(weights=sound.weights.masked_fill(sound.near_surface, math.nan))
    assert math.isnan(worst_of(lost_by_each([sound, broken, sound], 0.1)))
    config = CalibrationConfig(1.0, 100.0, camera_surface_mass=1.0)
    trusting = calibrate(problem.rendering(), config, cameras=[sound])
    doubting = calibrate(problem.rendering(), config, cameras=[broken])
    assert trusting.threshold == doubting.threshold == THRESHOLDS[0]
    assert not math.isnan(promise(lost_by_each([sound], 0.1), config)["bound"])
    assert math.isnan(promise(lost_by_each([broken], 0.1), config)["bound"])


def test_nothing_is_skipped_when_no_threshold_fits() -> None:
    problem = Problem(0)
    for reference in problem.references:
        reference.occupancies.zero_()  # a gate that calls the whole scene empty
    found = calibrate(problem.rendering(), CalibrationConfig())
    assert found == (0.0,) * len(found)


@pytest.mark.parametrize("missed_only", [False, True])
def test_skipping_nothing_is_measured_to_cost_exactly_nothing(missed_only: bool) -> None:
    """So that a host, which cannot measure all of it, may declare zeros."""
    found = measure(Problem(1).rendering(), 0.0, missed_only=missed_only)
    assert found == (0.0,) * len(found)


def test_a_perfect_gate_gets_the_largest_threshold_for_nothing() -> None:
    problem = Problem(0)
    for chunk in problem.chunks:
        empty = torch.rand(len(chunk.reference.weights)) < 0.5
        chunk.reference.weights[empty] = 0.0
        chunk.reference.rgb.copy_(chunk.render(chunk.reference.weights))
        chunk.reference.occupancies.copy_((~empty).float())
    found = calibrate(problem.rendering(), CalibrationConfig(0.0, 0.0))
    assert found.threshold == max(THRESHOLDS)
    assert found[1:4] == (0.0, 0.0, 0.0)
    assert 0.4 < found.empty_fraction < 0.6


def test_prices_are_those_of_their_definitions() -> None:
    problem, threshold = Problem(3), 0.3
    weights = torch.cat([reference.weights for reference in problem.references]).double()
    near = torch.cat([reference.near_surface for reference in problem.references])
    gone = torch.cat([reference.occupancies for reference in problem.references]) < threshold
    masks = gone.view(2, -1)
    errors = [
        torch.cat(
            [(image - truth).double() ** 2 for image, truth in zip(images, problem.truths)]
        ).mean()
        for images in (
            [reference.rgb for reference in problem.references],
            [problem.render_kept(i, ~masks[i]) for i in range(2)],
        )
    ]
    found = measure(problem.rendering(), threshold)
    assert found.lost_mass == pytest.approx(float(weights[gone].sum() / weights.sum()), rel=1e-5)
    expected = float(weights[gone & near].sum() / weights[near].sum())
    assert found.lost_surface_mass == pytest.approx(expected, rel=1e-5)
    assert found.image_price_db == pytest.approx(
        float(10 * (errors[1] / errors[0]).log10()), abs=1e-4
    )
    assert found.empty_fraction == pytest.approx(float(gone.float().mean()))


def test_standard_errors_are_those_of_a_bootstrap_over_rays() -> None:
    problem, threshold = Problem(5), 0.4
    rays = ray_prices(problem.rendering(), threshold)
    found = measure(problem.rendering(), threshold)
    drawn = torch.randint(2 * RAYS, (4000, 2 * RAYS), generator=torch.Generator().manual_seed(0))
    masses = rays.lost_surface[drawn].sum(dim=1) / rays.surface[drawn].sum(dim=1)
    prices = 10.0 * torch.log10(
        rays.gated_error[drawn].sum(dim=1) / rays.dense_error[drawn].sum(dim=1)
    )
    assert found.surface_error == pytest.approx(float(masses.std()), rel=0.15)
    assert found.price_error_db == pytest.approx(float(prices.std()), rel=0.15)


def test_the_error_of_a_price_is_that_of_two_shares_however_much_is_lost() -> None:
    """By hand: of a ray with 3/4 of the gated error and 1/2 of the dense one, and one with less."""
    price, error = image_price(torch.tensor([6.0, 2.0]), torch.tensor([0.5, 0.5]), 0.0)
    assert price == pytest.approx(10.0 * math.log10(8.0))
    assert error == pytest.approx(10.0 / math.log(10.0) * math.hypot(0.25, 0.25))


@pytest.mark.parametrize(("errors", "fits"), [(0.99, True), (1.01, False)])
def test_a_price_may_lie_one_standard_error_beyond_its_bound(errors: float, fits: bool) -> None:
    mass, price = CONFIG.lost_surface_mass, CONFIG.image_price_db
    surface = Measured(0.5, mass + errors * 1e-4, 0.0, 0.0, 0.5, 1e-4, 9.0)
    image = Measured(0.5, 0.0, 0.0, price + errors * 0.02, 0.5, 9.0, 0.02)
    assert surface.within(CONFIG) == image.within(CONFIG) == fits


@pytest.mark.parametrize(("times", "fits"), [(9.9, True), (10.1, False)])
def test_a_price_is_at_most_ten_times_its_bound_by_any_error(times: float, fits: bool) -> None:
    mass, price = times * CONFIG.lost_surface_mass, times * CONFIG.image_price_db
    surface = Measured(0.5, mass, 0.0, 0.0, 0.5, 9.0, 9.0)
    image = Measured(0.5, 0.0, 0.0, price, 0.5, 9.0, 9.0)
    assert surface.within(CONFIG) == image.within(CONFIG) == fits


def test_one_ray_of_a_few_does_not_decide_and_many_do() -> None:
    for scene, fits in ((Problem(0), True), (Problem(1), False)):
        for reference in scene.references:
            reference.occupancies.fill_(1.0)
            of_first = reference.intervals.ray_indices == 0
            lost = of_first if fits else torch.ones_like(of_first)
            reference.occupancies[lost & reference.near_surface] = 0.0
        if fits:
            scene.references[1].occupancies.fill_(1.0)
        found = measure(scene.rendering(), 0.5)
        found = found._replace(image_price_db=0.0, price_error_db=0.0)
        config = CalibrationConfig(lost_surface_mass=5e-3)
        assert found.lost_surface_mass > 4 * config.lost_surface_mass
        assert found.within(config) == fits
        ten_times_less = CalibrationConfig(lost_surface_mass=5e-4)  # whatever the error is
        assert not found.within(ten_times_less)


def test_a_backdrop_is_worth_what_the_image_loses_without_it() -> None:
    problem = Problem(2)
    assert backdrop_price(problem.rendering()) == 0.0  # there is none
    last = torch.arange(RAYS * SAMPLES) % SAMPLES == SAMPLES - 1
    errors = torch.zeros(2)
    for number, chunk in enumerate(problem.chunks):
        chunk.reference.always_kept.copy_(last)
        images = chunk.reference.rgb, problem.render_kept(number, ~last)
        errors += torch.stack([(image - chunk.truth).square().sum() for image in images])
    expected = float(10.0 * torch.log10(errors[1] / errors[0]))
    assert expected > 0.0
    assert backdrop_price(problem.rendering()) == pytest.approx(expected, rel=1e-4)
    assert backdrop_price(DenseRendering([], [], problem.render_kept)) == 0.0


def test_against_an_exact_rendering_prices_are_above_100_db() -> None:
    problem, threshold = Problem(4), 0.3
    problem.truths = [reference.rgb.clone() for reference in problem.references]
    floor = 1e-10 * 2 * RAYS * 3
    gone = [reference.occupancies < threshold for reference in problem.references]
    for way in ("measured", "of a backdrop"):
        images = [problem.render_kept(i, ~mask) for i, mask in enumerate(gone)]
        error = sum(float((a - b).square().sum()) for a, b in zip(images, problem.truths))
        expected = pytest.approx(10.0 * math.log10((error + floor) / floor), rel=1e-4)
        if way == "measured":
            assert measure(problem.rendering(), threshold).image_price_db == expected
            for reference, mask in zip(problem.references, gone):
                reference.always_kept.copy_(mask)
        else:
            assert backdrop_price(problem.rendering()) == expected


def test_without_an_image_there_is_no_image_price_and_no_rays_cost_nothing() -> None:
    assert math.isnan(measure(Problem(0).rendering(), 0.1, with_image=False).image_price_db)
    found = measure(DenseRendering([], [], lambda i, mask: mask), 0.5)
    assert found.lost_surface_mass == found.lost_mass == found.empty_fraction == 0.0


def shaded_of(
    weights: Tensor, ray_indices: Tensor, accumulation: Tensor, logits: Tensor | None = None
) -> Shaded:
    """What is known of rays [R] by their weights [N] and their accumulation [R]."""
    none, packed = torch.zeros(0), pack_info(ray_indices, len(accumulation))
    logits = none if logits is None else logits
    return Shaded(none, accumulation, none, weights, none, logits, none, packed)


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 2**16))
def test_near_the_median_depth_is_within_two_steps_of_it(seed: int) -> None:
    torch.manual_seed(seed)
    counts = torch.tensor([7, 0, 12, 1, 30])
    ray_indices = torch.arange(5).repeat_interleave(counts)
    starts = torch.cat([torch.arange(int(count)) * 0.5 for count in counts])
    weights = torch.rand(50) ** 8 / 30
    accumulation = accumulate_along_rays(weights, None, ray_indices, 5)[:, 0]
    shaded = shaded_of(weights, ray_indices, accumulation)
    near = near_median_depth(shaded, Intervals(ray_indices, starts, starts + 0.5))
    for ray in range(5):
        mine = (ray_indices == ray).nonzero()[:, 0].tolist()
        total = 0.0
        for median in mine:
            total += float(weights[median])
            if total >= 0.5 * float(accumulation[ray]) * (1 - 1e-6):
                break
        for sample in mine:
            assert bool(near[sample]) == (abs(sample - median) <= SURFACE_STEPS)


def test_steps_from_the_median_are_as_long_as_its_own() -> None:
    """It lies in the fourth, at 3.5; the fifth has its middle 2.3 behind."""
    ends = torch.tensor([1.0, 1.0, 1.0, 1.0, 3.6, 4.0]).cumsum(0)
    starts = torch.cat([torch.zeros(1), ends[:-1]])
    on_one_ray = torch.zeros(6, dtype=torch.int64)
    shaded = shaded_of(torch.tensor([0.1, 0.1, 0.1, 0.5, 0.1, 0.1]), on_one_ray, torch.ones(1))
    near = near_median_depth(shaded, Intervals(on_one_ray, starts, ends))
    assert near.tolist() == [False, True, True, True, False, False]


def test_before_a_backdrop_that_holds_the_median_there_is_no_surface() -> None:
    ray_indices, starts = torch.arange(3).repeat_interleave(4), torch.arange(4).repeat(3) * 0.5
    intervals = Intervals(ray_indices, starts, starts + 0.5)
    hazy, solid, thin = [0.0, 0.2, 0.2, 0.6], [0.0, 0.7, 0.1, 0.2], [0.5, 0.0, 0.0, 0.5]
    shaded = shaded_of(torch.tensor([*hazy, *solid, *thin]), ray_indices, torch.ones(3))
    backdrops = torch.tensor([False, False, False, True]).repeat(3)
    near = near_surface(*weights_by_ray(shaded), intervals, backdrops)
    assert near.view(3, 4).tolist() == [[False] * 4, [True] * 4, [True, True, True, False]]
    everywhere = near_surface(*weights_by_ray(shaded), intervals, torch.zeros(12, dtype=torch.bool))
    assert torch.equal(everywhere, near_median_depth(shaded, intervals))


def test_a_field_without_surfaces_does_not_pass_for_one_with_nothing_to_lose() -> None:
    ends = torch.zeros(50), torch.full((50,), 2.0)
    rays = Rays(torch.zeros(50, 3), torch.ones(50, 3), *ends, None)
    ray_indices, starts = torch.arange(50).repeat_interleave(4), torch.arange(4).repeat(50) * 0.5
    intervals = Intervals(ray_indices, starts, starts + 0.5)
    weights = torch.tensor([0.0, 0.2, 0.2, 0.6]).repeat(50)
    for solid in (0, 1):
        weights[1 : 4 * solid : 4] = 0.9
        shaded = shaded_of(weights, ray_indices, torch.ones(50), torch.zeros(200, 2))
        near = reference_of(shaded, intervals, rays).near_surface
        assert int(near.sum()) == (4 if solid else 150)


def test_no_samples_have_no_median() -> None:
    none, no_rays = torch.zeros(0), torch.zeros(0, dtype=torch.int64)
    shaded, nothing = shaded_of(none, no_rays, torch.zeros(3)), Intervals(no_rays, none, none)
    assert near_median_depth(shaded, nothing).shape == (0,)
    assert near_surface(*weights_by_ray(shaded), nothing, none.bool()).shape == (0,)


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 1000), which=st.integers(0, len(THRESHOLDS) - 1))
def test_rays_exceed_the_bounds_on_average_where_the_price_does(seed: int, which: int) -> None:
    problem, threshold = Problem(seed), THRESHOLDS[which]
    rendering = problem.rendering()
    measured = measure(rendering, threshold, missed_only=True)
    rays = ray_prices(rendering, threshold, missed_only=True)
    surface, image = rays.surface_excess(CONFIG), rays.image_excess(CONFIG)
    assert surface.shape == image.shape == (2 * RAYS,)
    for excess, price, bound in (
        (surface, measured.lost_surface_mass, CONFIG.lost_surface_mass),
        (image, measured.image_price_db, CONFIG.image_price_db),
    ):
        if abs(price - bound) > 1e-4:
            assert (float(excess.mean()) > 0.0) == (price > bound)


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 1000))
def test_what_no_photograph_misses_is_not_lost(seed: int) -> None:
    problem, threshold = Problem(seed), 0.5
    masks = [reference.occupancies >= threshold for reference in problem.references]
    surface = lost = 0.0
    for number, (reference, mask) in enumerate(zip(problem.references, masks)):
        gated, truth = problem.render_kept(number, mask), problem.truths[number]
        for ray in range(RAYS):
            mine = reference.intervals.ray_indices == ray
            weights = (reference.weights * reference.near_surface)[mine]
            surface += float(weights.sum())
            images = gated, problem.render_kept(number, mask | reference.near_surface)
            errors = [float((rgb[ray] - truth[ray]).norm()) for rgb in images]
            lost += float(weights[~mask[mine]].sum()) if errors[0] > errors[1] else 0.0
    found = measure(problem.rendering(), threshold, missed_only=True)
    assert found.lost_surface_mass == pytest.approx(lost / surface, rel=1e-4)
    assert found.lost_surface_mass <= measure(problem.rendering(), threshold).lost_surface_mass


def test_a_dense_rendering_that_is_wrong_lowers_no_threshold() -> None:
    problem = Problem(0)
    haze = [reference.occupancies < 0.3 for reference in problem.references]
    problem.truths[:] = [problem.render_kept(i, ~gone) for i, gone in enumerate(haze)]
    config = CalibrationConfig(1e-6, 99.0)
    trusting = calibrate(problem.rendering(), config)
    wary = calibrate(problem.rendering(), config, missed_only=True)
    assert trusting.threshold < 0.1 < 0.2 < wary.threshold < 0.3


def test_only_lower_thresholds_are_tried_where_that_is_asked() -> None:
    problem = Problem(0)
    rendering = problem.rendering()
    free = CalibrationConfig(lost_surface_mass=1.0, image_price_db=99.0)
    assert calibrate(rendering, free).threshold == THRESHOLDS[0]
    assert calibrate(rendering, free, below=THRESHOLDS[3]).threshold == THRESHOLDS[4]
    assert calibrate(rendering, free, below=THRESHOLDS[-1]).threshold == 0.0


@pytest.mark.parametrize("number", range(len(THRESHOLDS)))
def test_lower_than_a_threshold_that_was_kept_in_float32_is_the_next_one(number: int) -> None:
    kept = float(torch.tensor(THRESHOLDS[number], dtype=torch.float32))
    assert thresholds_below(kept) == list(THRESHOLDS[number + 1 :])


@pytest.mark.parametrize("training", [True, False])
def test_a_model_is_left_in_the_mode_that_it_was_in(training: bool) -> None:
    model = torch.nn.Sequential(torch.nn.Dropout()).train(training)
    with suppress(ValueError), evaluating(model):
        assert not model[0].training
        raise ValueError
    assert model.training == model[0].training == training
