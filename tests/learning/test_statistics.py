"""The figures of the log are of all candidates, whatever was left out of them."""

from __future__ import annotations

import pytest
import torch

from leco_plugin.models.figures import gate_statistics, kept_fraction, prices
from leco_plugin.models.rendering import Intervals, Rays, Shaded, with_backdrop
from leco_plugin.samplers import marching
from leco_plugin.samplers.marching import March, march

NUM_RAYS, STEP = 6, 0.05


def rays_along_x() -> Rays:
    """Rays of random lengths, all of which meet the scene."""
    directions = torch.tensor([[1.0, 0.0, 0.0]]).expand(NUM_RAYS, 3)
    starts = 0.1 + 0.1 * torch.rand(NUM_RAYS)
    return Rays(torch.zeros(NUM_RAYS, 3), directions, starts, starts + 1.0, None)


def shaded_of(occupancies: torch.Tensor, **parts: torch.Tensor) -> Shaded:
    """Samples of one ray with these o(x), of two scene experts, and other parts as given."""
    # two scene experts of half the probability each have a log-sum-exp of zero
    scene = torch.full_like(occupancies, 0.5).log()
    logits = torch.stack([torch.logit(1.0 - occupancies), scene, scene], dim=-1)
    samples, ray = torch.zeros_like(occupancies), torch.zeros(1)
    shaded = Shaded(
        torch.zeros(1, 3),
        ray,
        ray,
        samples,
        samples,
        logits,
        samples.long(),
        torch.tensor([[0, len(samples)]]),
    )
    return shaded._replace(**parts)


@pytest.mark.parametrize("cone_angle", [0.0, 0.1])
@pytest.mark.parametrize("dropped_below", [0.0, 0.02, 0.5])
def test_what_is_kept_is_a_share_of_all(dropped_below: float, cone_angle: float) -> None:
    torch.manual_seed(0)
    rays = rays_along_x()
    all_of_them = Intervals(*march(marching.Rays(*rays[:4]), March(STEP, cone_angle)))
    every = with_backdrop(all_of_them, rays, STEP, cone_angle)
    occupancies = torch.rand(len(every.t_starts))
    backdrop = every.t_ends >= rays.t_maxs[every.ray_indices]
    assert int(backdrop.sum()) == NUM_RAYS
    left = (occupancies >= dropped_below) | backdrop
    found = kept_fraction(
        shaded_of(occupancies[left]),
        Intervals(*(part[left] for part in every)),
        rays,
        0.5,
        STEP,
        cone_angle,
    )
    expected = ((occupancies >= 0.5) | backdrop).float().mean()
    assert float(found) == pytest.approx(float(expected), abs=0.03)  # a backdrop is a step or two
    assert 0.3 < float(found) < 0.7


def test_a_batch_that_misses_the_scene_keeps_nothing() -> None:
    rays = rays_along_x()
    rays = rays._replace(t_maxs=rays.t_mins)
    nothing = Intervals(torch.zeros(0, dtype=torch.int64), torch.zeros(0), torch.zeros(0))
    assert float(kept_fraction(shaded_of(torch.zeros(0)), nothing, rays, 0.5, STEP, 0.0)) == 0.0


def test_shares_and_mean_densities_are_those_of_each_expert() -> None:
    routes, sigmas = torch.tensor([0, 2, 2, 0]), torch.tensor([0.0, 3.0, 5.0, 1.0])
    figures = gate_statistics(shaded_of(torch.rand(4), routes=routes, sigmas=sigmas), 2)
    assert [float(figures[f"share_expert_{i}"]) for i in range(3)] == [0.5, 0.0, 0.5]
    assert [float(figures[f"density_expert_{i}"]) for i in range(3)] == [0.5, 0.0, 4.0]
    assert float(figures["samples_per_ray"]) == 4.0


def test_prices_are_those_of_the_report_as_far_as_it_has_them() -> None:
    report = {
        "lost_mass": 0.5,
        "image_price_db": -0.01,
        "bounds": "a box",
        "lost_surface_mass": None,
    }
    found = prices(report)
    assert {name: float(value) for name, value in found.items()} == {
        "lost_mass": 0.5,
        "image_price_db": pytest.approx(-0.01),
    }
