"""Claims about what a dropped candidate is worth, from definitions and on known rays."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from ball_occupancy import CENTRE, ball

from leco_plugin.capacity.evidence import (
    UNLIKELY,
    Evidence,
    Rendered,
    gather,
    image_price,
    join,
    loss,
    unlikely_at,
)
from leco_plugin.capacity.sources import Seen
from leco_plugin.models.rendering import Intervals, Rays
from leco_plugin.occupancy import Occupancy


def evidence(rays: int = 50, each: int = 20) -> Evidence:
    torch.manual_seed(0)
    count = rays * each
    weights = torch.rand(count)
    worth = weights * (torch.rand(count) < 0.3)
    indices = torch.arange(rays).repeat_interleave(each)
    return Evidence(torch.rand(count, 3), indices, weights > 0.1, weights, worth, rays)


def test_the_loss_is_the_skipped_share_of_the_worth() -> None:
    known = evidence()
    skipped = torch.rand(len(known.worth)) < 0.1
    found = loss(known, skipped)
    worth = known.worth.double()
    assert found.share == pytest.approx(float(worth[skipped].sum() / worth.sum()))
    assert found.lost_mass == pytest.approx(
        float(known.weights[skipped].sum() / known.weights.sum()), rel=1e-5
    )
    assert found.bound > found.share


def rays_of(worth: torch.Tensor) -> Evidence:
    """One candidate a ray, worth so much: [R]."""
    count = len(worth)
    kept = torch.ones(count, dtype=torch.bool)
    return Evidence(torch.zeros(count, 3), torch.arange(count), kept, worth, worth, count)


@pytest.mark.parametrize("unlikely", [0.01, 1e-3, 1e-5])
def test_a_loss_that_nobody_has_seen_is_bounded_by_the_number_of_rays(unlikely: float) -> None:
    for rays in (50, 500):
        known = rays_of(torch.ones(rays))
        share, bound, mass = loss(known, ~known.kept, unlikely)
        # a share of so many would have been seen by n rays but for a few times
        assert share == mass == 0.0 and bound == pytest.approx(math.log(1.0 / unlikely) / rays)


def test_rays_of_no_worth_are_no_evidence() -> None:
    alone = rays_of(torch.ones(100))
    among_sky = rays_of(torch.cat([torch.ones(100), torch.zeros(900)]))
    for lost in (0, 1, 7):
        bounds = [
            loss(known, torch.arange(known.rays) < lost).bound for known in (alone, among_sky)
        ]
        assert bounds[1] == pytest.approx(bounds[0])
    nothing = rays_of(torch.zeros(100))
    assert loss(nothing, nothing.kept)[:2] == (0.0, 1.0)


def test_rays_that_are_worth_little_are_little_evidence() -> None:
    even, uneven = rays_of(torch.ones(1000)), rays_of(torch.linspace(1.0, 1e-3, 1000) ** 4)
    bounds = [loss(known, ~known.kept).bound for known in (even, uneven)]
    assert bounds[1] == pytest.approx(5**2 / 9 * bounds[0], rel=0.02)  # of fourth powers


def test_the_looks_together_are_wrong_no_more_often_than_one() -> None:
    allowed = [unlikely_at(look) for look in range(1, 10_000)]
    assert allowed[0] == UNLIKELY / 2 and allowed == sorted(allowed, reverse=True)
    assert 0.999 * UNLIKELY < sum(allowed) < UNLIKELY
    known = rays_of(torch.ones(500))
    bounds = [loss(known, torch.arange(500) < 3, unlikely_at(look)).bound for look in (1, 2, 9)]
    assert bounds == sorted(bounds) and bounds[0] > loss(known, torch.arange(500) < 3).bound


def test_evidence_is_joined_ray_by_ray() -> None:
    first, second = evidence(5, 4), evidence(7, 3)
    both = join([first, second])
    assert both.rays == 12 and torch.equal(both.ray_indices.unique(), torch.arange(12))
    assert torch.equal(both.worth, torch.cat([first.worth, second.worth]))
    per_ray = torch.zeros(12).index_add_(0, both.ray_indices, both.worth)
    expected = torch.cat([part.worth.view(part.rays, -1).sum(dim=1) for part in (first, second)])
    torch.testing.assert_close(per_ray, expected)


@pytest.mark.parametrize(
    ("often", "most", "seeing"),
    [(0.05, 1.0, 1.0), (2e-3, 1.0, 1.0), (2e-3, 0.1, 1.0), (0.05, 1.0, 0.1), (0.02, 1.0, 0.1)],
)
def test_the_bound_holds_on_other_rays_of_the_same_kind(often, most, seeing) -> None:
    """Also where few rays have lost all that is lost, and where few see a surface at all."""
    torch.manual_seed(1)
    rays, broken = 1000, 0
    truth = often * 0.5 * most
    for _ in range(300):
        whole = torch.rand(rays) * (torch.rand(rays) < seeing)
        lost = whole * (torch.rand(rays) < often) * torch.rand(rays) * most
        worth = torch.stack([lost, whole - lost], dim=1).reshape(-1)
        skipped = torch.tensor([True, False]).repeat(rays)
        indices = torch.arange(rays).repeat_interleave(2)
        seen = Evidence(torch.zeros(2 * rays, 3), indices, skipped, worth, worth, rays)
        broken += truth > loss(seen, skipped).bound
    assert broken <= 0.01 * 300


def rays_down(count: int) -> Rays:
    origins = torch.tensor(CENTRE) + torch.cat(
        [torch.linspace(-1.5, 1.5, count)[:, None], torch.zeros(count, 1), torch.ones(count, 1)], 1
    )
    directions = torch.tensor([[0.0, 0.0, -1.0]]).expand(count, 3)
    return Rays(origins, directions, torch.zeros(count), torch.full((count,), 2.0), None)


@pytest.mark.parametrize("cone_angle", [None, 0.1])
def test_without_a_field_what_is_kept_is_worth_its_occupancy(cone_angle: float | None) -> None:
    known, growth = ball(), cone_angle or 0.0
    report = {"near": 0.0, "far": 2.0, "step_size": 0.05}
    report |= {} if cone_angle is None else {"cone_angle": cone_angle}
    original = Occupancy(known.gate, known.space, known.threshold, report=report).eval()
    seen = Seen(rays_down(1500), torch.rand(1500, 3))  # more than are asked about at once
    found, rendered = gather(None, original, seen)
    assert not rendered and found.rays == 1500
    assert int(found.ray_indices.max()) == 1499
    values = original.query(found.positions)
    assert torch.equal(found.kept, values >= original.threshold)
    torch.testing.assert_close(found.worth, values * found.kept)
    t, middles = 0.0, []
    while (middle := t + 0.5 * max(0.05, growth * t)) < 2.0:  # steps as the run marched them
        middles.append(middle)
        t += max(0.05, growth * t)
    first = found.positions[found.ray_indices == 0] - seen.rays.origins[0]
    torch.testing.assert_close(first[:, 2], -torch.tensor(middles), atol=1e-5, rtol=1e-5)
    outside = loss(found, found.kept & (found.positions[:, 2] > CENTRE[2]))
    if cone_angle is None:
        assert outside.share == pytest.approx(0.5, abs=0.05)  # the upper half of the ball


def test_the_price_of_an_image_is_of_what_both_keep_and_of_every_backdrop() -> None:
    """Each interval adds the colour at which it begins. The smaller gate keeps what begins before
    0.25, and no backdrop lies there."""
    starts = torch.tensor([0.2, 0.3, 0.5, 0.3, 0.6])  # of two rays, backdrops last
    intervals = Intervals(torch.tensor([0, 0, 0, 1, 1]), starts, starts)
    before_backdrop = torch.tensor([True, True, False, True, False])

    def shade(rays: Rays, some: Intervals) -> SimpleNamespace:
        rgb = torch.zeros(len(rays.origins)).index_add_(0, some.ray_indices, some.t_starts)
        return SimpleNamespace(rgb=rgb[:, None].expand(-1, 3))

    down = torch.tensor([[0.0, 0.0, -1.0]]).expand(2, 3)
    rays = Rays(torch.zeros(2, 3), down, torch.zeros(2), torch.ones(2), None)
    known: Any = SimpleNamespace(shade=shade)
    smaller: Any = SimpleNamespace(occupied=lambda positions: positions[:, 2] > -0.25)
    truth = torch.tensor([[0.9], [0.9]]).expand(2, 3)
    one = Rendered(rays, intervals, before_backdrop, shade(rays, intervals).rgb, truth)
    # 1.0 and 0.9 with all of them; 0.7 and 0.6 without those that begin at 0.3
    expected = 10.0 * math.log10((0.2**2 + 0.3**2) / 0.1**2)
    assert image_price(known, [one, one], smaller) == pytest.approx(expected, abs=1e-3)
