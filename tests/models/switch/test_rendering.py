"""Coarse and fine samples are one set of intervals, and what is said of each is of its place."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from leco_plugin.models.field import ColorHead
from leco_plugin.models.rendering import (
    Answers,
    Intervals,
    Rays,
    backdrop_of,
    render,
    with_backdrop,
)
from leco_plugin.models.switch.rendering import coarse_and_fine
from leco_plugin.samplers.base import DenseEstimator, SampleFn, densities_of_samples
from leco_plugin.space import Space

SPACE = Space("box", half_extent=10.0)


def ball(mapped: Tensor) -> Answers:
    """A ball around the origin; features and logits hold the place, so that it can be told."""
    sigmas = 200.0 * (mapped.norm(dim=-1) < 0.1).float()
    return Answers(sigmas, mapped.clone(), mapped * 2.0, (mapped[:, 0] > 0).long())


def some_rays(count: int = 6) -> Rays:
    """From outside the ball, the first straight at it."""
    origins = torch.randn(count, 3) * 0.2
    origins[:, 0] = -4.0
    origins[0, 1:] = 0.0
    directions = torch.tensor([[1.0, 0.0, 0.0]]).expand(count, 3)
    return Rays(origins, directions, torch.full((count,), 1.0), torch.full((count,), 8.0), None)


def sampled(rays: Rays, step: float, sigma_fn: SampleFn | None = None) -> Intervals:
    """All candidates of rays, but those that lie behind an opaque place."""
    limits = {"t_min": rays.t_mins, "t_max": rays.t_maxs, "render_step_size": step}
    found = DenseEstimator().sampling(rays.origins, rays.directions, sigma_fn, **limits)
    return Intervals(*found)


@pytest.mark.parametrize("jittered", [False, True])
@pytest.mark.parametrize("growing", [False, True])
def test_samples_are_disjoint_cover_the_ray_and_are_answered_in_place(growing, jittered) -> None:
    rays = some_rays()
    stops = rays.t_maxs - 0.5
    intervals, answers = coarse_and_fine(ball, SPACE, rays, stops, (9, 14), growing, jittered)
    starts, ends = (part.view(6, 24) for part in intervals[1:])
    assert torch.equal(intervals.ray_indices, torch.arange(6).repeat_interleave(24))
    assert torch.equal(starts[:, 1:], ends[:, :-1])
    assert bool((ends >= starts).all())
    assert torch.equal(starts[:, 0], rays.t_mins) and torch.equal(ends[:, -1], rays.t_maxs)
    assert torch.equal(backdrop_of(intervals, rays).view(6, 24)[:, -1], torch.ones(6).bool())
    assert int(backdrop_of(intervals, rays).sum()) == 6
    places = answers.features * 10.0
    along = (places - rays.origins[intervals.ray_indices])[:, 0].view(6, 24)
    assert bool((along >= starts - 1e-4).all() and (along <= ends + 1e-4).all())
    torch.testing.assert_close(along[:, -1], torch.full((6,), 7.75))
    for mine, asked in zip(answers, ball(answers.features)):
        assert torch.equal(mine, asked)


def test_fine_samples_gather_where_coarse_ones_have_weight() -> None:
    rays = some_rays(1)
    intervals, _ = coarse_and_fine(ball, SPACE, rays, rays.t_maxs - 0.5, (32, 64), False, False)
    middles = 0.5 * (intervals.t_starts + intervals.t_ends)
    assert int(((middles > 2.8) & (middles < 3.5)).sum()) > 60


def test_a_thin_fog_draws_fine_samples_from_all_of_a_ray() -> None:
    """Its density is 1 per half extent, of which the ray crosses 0.65."""

    def fog(mapped: Tensor) -> Answers:
        return ball(mapped)._replace(sigmas=torch.ones(len(mapped)))

    rays = some_rays(1)
    intervals, _ = coarse_and_fine(fog, SPACE, rays, rays.t_maxs - 0.5, (64, 200), False, False)
    middles = 0.5 * (intervals.t_starts + intervals.t_ends)
    first_half = (1.0 - math.exp(-0.325)) / (1.0 - math.exp(-0.65))
    assert abs(int((middles < 4.25).sum()) - (32 + 200 * first_half)) < 5


def test_the_backdrop_gives_its_colour_and_is_nothing_met() -> None:
    color, rays = ColorHead(3, 8, 1, 0, 1), some_rays()
    intervals, answers = coarse_and_fine(
        ball, SPACE, rays, rays.t_maxs - 0.5, (64, 64), False, False
    )
    shaded = render(color, answers, rays, intervals, SPACE.half_extent, meets_backdrop=False)
    met = rays.origins[:, 1:].norm(dim=-1) < 0.9
    assert bool(met.any())
    torch.testing.assert_close(shaded.accumulation[met], torch.ones(int(met.sum())))
    torch.testing.assert_close(shaded.depth[0], torch.tensor(3.0), atol=0.1, rtol=0)

    empty = answers._replace(sigmas=torch.zeros_like(answers.sigmas))
    through = render(color, empty, rays, intervals, SPACE.half_extent, meets_backdrop=False)
    assert not bool(through.accumulation.any()) and not bool(through.weights.any())
    assert torch.equal(through.depth, rays.t_maxs)
    last = answers.features.view(6, -1, 3)[:, -1]
    torch.testing.assert_close(
        through.rgb, color(last, torch.arange(6), rays.directions, None), atol=1e-5, rtol=0
    )


def test_packed_samples_of_all_candidates_render_what_coarse_and_fine_do() -> None:
    color, rays = ColorHead(3, 8, 1, 0, 1), some_rays()
    intervals = with_backdrop(sampled(rays, 0.02), rays, 0.02, 0.0)
    places = rays.origins[intervals.ray_indices] + rays.directions[intervals.ray_indices] * (
        0.5 * (intervals.t_starts + intervals.t_ends)
    ).unsqueeze(-1)
    dense = render(
        color, ball(places / 10.0), rays, intervals, SPACE.half_extent, meets_backdrop=False
    )
    own = coarse_and_fine(ball, SPACE, rays, rays.t_maxs - 0.02, (200, 400), False, False)
    ours = render(color, own[1], rays, own[0], SPACE.half_extent, meets_backdrop=False)
    torch.testing.assert_close(ours.rgb, dense.rgb, atol=2e-3, rtol=0)
    torch.testing.assert_close(ours.accumulation, dense.accumulation, atol=2e-2, rtol=0)


def test_pruning_leaves_out_what_lies_behind_an_opaque_place() -> None:
    rays = some_rays(1)

    def density_fn(positions: Tensor) -> Tensor:
        return ball(positions / 10.0).sigmas[:, None] / 10.0

    densities = densities_of_samples(density_fn, rays.origins, rays.directions)
    everything, seen = sampled(rays, 0.05), sampled(rays, 0.05, densities)
    assert 3.0 < float(seen.t_ends.max()) < 5.0 < float(everything.t_ends.max())


def test_there_may_be_no_rays() -> None:
    rays = some_rays(1)._replace(
        origins=torch.zeros(0, 3),
        directions=torch.zeros(0, 3),
        t_mins=torch.zeros(0),
        t_maxs=torch.zeros(0),
    )
    intervals, answers = coarse_and_fine(ball, SPACE, rays, rays.t_maxs, (4, 4), True, True)
    shaded = render(
        ColorHead(3, 8, 1, 0, 1), answers, rays, intervals, SPACE.half_extent, meets_backdrop=False
    )
    assert shaded.rgb.shape == (0, 3)
