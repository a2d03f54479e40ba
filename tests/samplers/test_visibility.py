"""Both ways of leaving out what cannot be seen give what the definition gives."""

from __future__ import annotations

import pytest
import torch
from samplers.analytic_occupancy import Balls, camera_rays

from leco_plugin.samplers import packed
from leco_plugin.samplers.base import DenseEstimator, densities_of_samples, prune
from leco_plugin.samplers.marching import March, Rays, march

N_RAYS, STEP = 150, 0.01
BALLS = Balls()


def density(positions):
    return BALLS.query(positions) * 100.0


@pytest.fixture
def scene():
    origins, directions = camera_rays(N_RAYS)
    lengths = torch.rand(N_RAYS, generator=torch.Generator().manual_seed(0))
    return Rays(origins, directions, torch.zeros(N_RAYS), lengths * 3.0 + 1.0)


def render(samples, sigma_fn):
    ray_indices, t_starts, t_ends = samples
    weights, _, _ = packed.render_weight_from_density(
        t_starts, t_ends, sigma_fn(t_starts, t_ends, ray_indices), None, ray_indices, N_RAYS
    )
    values = torch.stack([t_starts, torch.ones_like(t_starts)], dim=-1)
    return packed.accumulate_along_rays(weights, values, ray_indices, N_RAYS)


def test_the_density_of_a_sample_is_that_of_its_middle(scene):
    origins, directions = scene[:2]
    ray_indices, t_starts, t_ends = march(scene, March(0.5))
    expected = []
    for ray, start, end in zip(*(t.tolist() for t in (ray_indices, t_starts, t_ends)), strict=True):
        middle = origins[ray] + directions[ray] * (0.5 * (start + end))
        expected.append(float(density(middle[None])))
    for shape in ((-1,), (-1, 1)):  # as hosts answer
        sigma_fn = densities_of_samples(
            lambda x, shape=shape: density(x).view(shape), origins, directions
        )
        sigmas = sigma_fn(t_starts, t_ends, ray_indices)
        torch.testing.assert_close(sigmas, torch.tensor(expected), rtol=1e-3, atol=1e-3)


def test_the_image_changes_by_no_more_than_the_threshold(scene):
    sigma_fn = densities_of_samples(density, *scene[:2])
    samples = march(scene, March(STEP), BALLS.occupied)
    visible = prune(samples, N_RAYS, sigma_fn=sigma_fn, early_stop_eps=1e-4)
    difference = (render(samples, sigma_fn) - render(visible, sigma_fn)).abs().max()
    assert len(visible[0]) < len(samples[0])
    assert difference <= 1e-3


def test_pruning_is_two_comparisons(scene):
    sigma_fn = densities_of_samples(density, *scene[:2])
    samples = march(scene, March(STEP))
    ray_indices, t_starts, t_ends = samples
    sigmas = sigma_fn(t_starts, t_ends, ray_indices)
    expected = packed.render_visibility_from_density(
        t_starts, t_ends, sigmas, None, ray_indices, N_RAYS, early_stop_eps=0.01, alpha_thre=0.1
    )
    limits = {"early_stop_eps": 0.01, "alpha_thre": 0.1}
    by_density = prune(samples, N_RAYS, sigma_fn=sigma_fn, **limits)
    alphas = 1.0 - torch.exp(-sigmas * (t_ends - t_starts))
    by_alpha = prune(samples, N_RAYS, alpha_fn=lambda *_: alphas, **limits)
    for pruned in (by_density, by_alpha):
        assert pruned[0].equal(ray_indices[expected])
        assert pruned[1].equal(t_starts[expected])


@pytest.mark.parametrize("asked", ["sigma_fn", "alpha_fn"])
@pytest.mark.parametrize("cap", [DenseEstimator().alpha_cap, lambda _: torch.tensor(torch.nan)])
def test_a_sample_in_the_light_whose_answer_is_nan_stays_and_changes_no_other_ray(
    scene, asked, cap
):
    samples = march(scene, March(STEP))
    answers = densities_of_samples(density, *scene[:2])(samples[1], samples[2], samples[0])
    if asked == "alpha_fn":
        answers = 1.0 - torch.exp(-answers * STEP)
    limits = {"early_stop_eps": 0.01, "alpha_thre": 1e-3, "alpha_cap": cap}
    expected = prune(samples, N_RAYS, **{asked: lambda *_: answers}, **limits)
    ray, start = expected[0][0], expected[1][0]
    bad = (samples[0] == ray) & (samples[1] == start)
    lacking = answers.masked_fill(bad, torch.nan)
    found = prune(samples, N_RAYS, **{asked: lambda *_: lacking}, **limits)
    assert bool(((found[0] == ray) & (found[1] == start)).any())
    for before, after in zip(expected, found, strict=True):
        assert torch.equal(before[expected[0] != ray], after[found[0] != ray])
    assert 0 < len(expected[0]) < len(samples[0])


def test_opacities_that_are_nan_do_not_count_in_the_cap():
    cap = DenseEstimator().alpha_cap(torch.tensor([0.2, torch.nan, 0.4]))
    assert float(cap) == pytest.approx(0.03)


def test_nothing_to_see_is_no_samples(scene):
    def never(*_):
        raise AssertionError("the field must not be asked about nothing")

    nowhere = march(scene, March(STEP), lambda p: torch.zeros(len(p)).bool())
    assert len(prune(nowhere, N_RAYS, sigma_fn=never)[0]) == 0


def test_answers_of_another_shape_are_named(scene):
    samples = march(scene, March(STEP))
    n = len(samples[0])
    with pytest.raises(ValueError, match=rf"must answer \[{n}\], got \[{n}, 1\]"):
        prune(samples, N_RAYS, sigma_fn=lambda *_: torch.ones(n, 1))


def test_a_sample_exactly_as_opaque_as_asked_is_worth_shading():
    alphas, one_ray = torch.tensor([0.5, 0.25, 0.125]), torch.zeros(3, dtype=torch.int64)
    seen = packed.render_visibility_from_alpha(alphas, None, one_ray, 1, alpha_thre=0.25)
    assert seen.tolist() == [True, True, False]
