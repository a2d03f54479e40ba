"""The losses have the stationary points, limits and gradients that they are chosen for."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from leco_plugin.models.losses import (
    adjoining,
    agreement_loss,
    backdrop_loss,
    balance_loss,
    color_loss,
    contribution_loss,
    density_loss,
    distortion_loss,
    expert_shares,
    imbalanced_gate_loss,
    termination_loss,
    widen,
)
from leco_plugin.models.rendering import Intervals
from leco_plugin.samplers.packed import pack_info


def test_errors_in_hue_weigh_more_and_the_mean_is_still_the_best_colour() -> None:
    seen = torch.rand(50, 3, dtype=torch.float64)
    brightness, hue = torch.tensor([[0.1, 0.1, 0.1], [0.1, -0.1, 0.0]], dtype=torch.float64)
    assert float(color_loss(seen + brightness, seen)) == pytest.approx(0.01)
    assert float(color_loss(seen + hue, seen)) == pytest.approx(8.0 * 0.02 / 3.0)
    color = seen.mean(dim=0).requires_grad_()
    color_loss(color.expand_as(seen), seen).backward()
    torch.testing.assert_close(color.grad, torch.zeros_like(color))


def routes_with_shares(counts: list[int]) -> torch.Tensor:
    return torch.repeat_interleave(torch.arange(len(counts)), torch.tensor(counts))


def gate_gradient(counts: list[int], empty_ratio: float) -> tuple[float, torch.Tensor]:
    """Loss, and its gradient [1 + n] to the mean logits, with so many points at each expert."""
    torch.manual_seed(0)
    logits = torch.randn(sum(counts), len(counts), dtype=torch.float64, requires_grad=True)
    loss = imbalanced_gate_loss(logits.softmax(dim=-1), routes_with_shares(counts), empty_ratio)
    loss.backward()
    assert logits.grad is not None
    return loss.item(), logits.grad.sum(dim=0)


@given(seed=st.integers(0, 2**16), jitter=st.floats(0.0, 0.9))
def test_targets_reach_one_step_further_and_over_no_gap(seed: int, jitter: float) -> None:
    generator = torch.Generator().manual_seed(seed)
    rays, steps = 4, 9
    edges = (torch.arange(steps + 1) + jitter) * 0.1
    kept = (torch.rand(rays, steps, generator=generator) < 0.7).nonzero()
    intervals = Intervals(kept[:, 0], edges[kept[:, 1]], edges[kept[:, 1] + 1])
    weights = torch.rand(len(kept), generator=generator)
    at = {tuple(place): weight for place, weight in zip(kept.tolist(), weights, strict=True)}
    expected = [
        max(at.get((ray, step + more), torch.zeros(())) for more in (-1, 0, 1)) for ray, step in at
    ]
    assert widen(weights, adjoining(intervals)).tolist() == [float(value) for value in expected]


def test_target_ratio_is_the_stationary_point() -> None:
    loss, gradient = gate_gradient([80, 5, 5, 5, 5], 0.8)
    assert loss == pytest.approx(1.0, abs=1e-6)
    torch.testing.assert_close(gradient, torch.zeros_like(gradient), rtol=0, atol=1e-6)


def test_the_gate_is_pushed_back_to_the_target_ratio_from_both_sides() -> None:
    _, too_empty = gate_gradient([92, 2, 2, 2, 2], 0.8)
    _, too_full = gate_gradient([60, 10, 10, 10, 10], 0.8)
    assert too_empty[0] > 1e-3 and too_full[0] < -1e-3


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 2**16), experts=st.integers(1, 8))
def test_ratio_of_one_in_all_experts_gives_back_the_balanced_loss(seed: int, experts: int) -> None:
    torch.manual_seed(seed)
    probabilities = torch.randn(200, 1 + experts).softmax(dim=-1)
    routes = torch.randint(1 + experts, (200,))
    torch.testing.assert_close(
        imbalanced_gate_loss(probabilities, routes, 1.0 / (1 + experts)),
        balance_loss(probabilities, routes),
    )


def test_shares_sum_to_one_and_are_zero_without_points() -> None:
    assert float(expert_shares(torch.tensor([0, 2, 2]), 4).sum()) == pytest.approx(1.0)
    assert expert_shares(torch.zeros(0, dtype=torch.int64), 3).tolist() == [0.0, 0.0, 0.0]


def test_density_loss_asks_only_the_gate() -> None:
    empty = torch.tensor([0.9, 0.1], requires_grad=True)
    alphas = torch.tensor([1.0, 0.0], requires_grad=True)
    density_loss(empty, alphas).backward()
    assert alphas.grad is None and empty.grad is not None
    assert empty.grad.tolist() == [0.5, 0.0]


def test_a_saturated_gate_still_learns_in_logit_form_but_not_in_the_papers() -> None:
    """It calls one point empty that carries all of its ray's weight."""
    logits = torch.tensor([[40.0, -40.0, -40.0]], requires_grad=True)
    contribution_loss(logits, torch.ones(1), 0.05, 4.0).backward()
    assert logits.grad is not None and float(logits.grad[0, 0]) == pytest.approx(4.0)
    logits.grad = None
    density_loss(logits.softmax(dim=-1)[:, 0], torch.ones(1)).backward()
    assert logits.grad is not None and float(logits.grad.abs().max()) < 1e-12


def test_contribution_loss_is_least_at_the_emphasised_odds() -> None:
    """d/do of -k y log o - (1 - y) log(1 - o) vanishes at o = k y / (k y + 1 - y)."""
    y, k = 0.3, 4.0
    best = k * y / (k * y + 1.0 - y)
    logit = torch.tensor([[0.0, float(torch.tensor(best / (1 - best)).log())]], requires_grad=True)
    contribution_loss(logit, torch.tensor([y * 0.05]), 0.05, k).backward()
    assert logit.grad is not None and float(logit.grad.abs().max()) < 1e-6


def test_contribution_loss_does_not_teach_the_field() -> None:
    weights = torch.rand(5, requires_grad=True)
    assert contribution_loss(
        torch.randn(5, 3, requires_grad=True), weights, 0.05, 4.0
    ).requires_grad
    contribution_loss(torch.randn(5, 3, requires_grad=True), weights, 0.05, 4.0).backward()
    assert weights.grad is None


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 2**16))
def test_distortion_is_the_double_sum_of_its_definition(seed: int) -> None:
    torch.manual_seed(seed)
    ray_indices = torch.randint(6, (40,)).sort().values
    edges = torch.cumsum(torch.rand(40, 2, dtype=torch.float64).flatten(), 0).view(40, 2)
    starts, ends = edges.unbind(dim=-1)
    weights = torch.rand(40, dtype=torch.float64, requires_grad=True)
    fast = distortion_loss(weights, starts, ends, pack_info(ray_indices, 7))
    middles = 0.5 * (starts + ends)
    same_ray = ray_indices[:, None] == ray_indices[None]
    pairs = weights[:, None] * weights[None] * (middles[:, None] - middles[None]).abs()
    slow = ((pairs * same_ray).sum() + (weights**2 * (ends - starts)).sum() / 3.0) / 7
    torch.testing.assert_close(fast, slow, rtol=1e-10, atol=1e-10)
    (of_fast,) = torch.autograd.grad(fast, weights)
    (of_slow,) = torch.autograd.grad(slow, weights)
    torch.testing.assert_close(of_fast, of_slow, rtol=1e-9, atol=1e-9)


def test_distortion_of_nothing_is_zero() -> None:
    nothing = torch.zeros(0)
    for rays in (0, 3):
        info = pack_info(torch.zeros(0, dtype=torch.int64), rays)
        assert float(distortion_loss(nothing, nothing, nothing, info)) == 0.0


def two_rays() -> Intervals:
    """Two rays of four samples one unit long."""
    starts = torch.arange(4.0).repeat(2)
    return Intervals(torch.arange(2).repeat_interleave(4), starts, starts + 1.0)


def test_termination_is_least_where_all_weight_lies_at_the_known_distance() -> None:
    distances = torch.tensor([2.5, 0.0])
    there = torch.tensor([0.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    elsewhere = there.roll(2)
    best = termination_loss(there, two_rays(), distances)
    torch.testing.assert_close(best, torch.tensor(-math.log(1.03)))
    assert termination_loss(elsewhere, two_rays(), distances) > best + 3.0


def test_termination_counts_the_weight_within_one_step() -> None:
    for sample, counts in ((0, False), (1, False), (2, True), (3, True)):
        weights = torch.eye(8)[sample]
        found = termination_loss(weights, two_rays(), torch.tensor([2.8, 0.0]))
        expected = -math.log(1.03 if counts else 0.03)
        assert float(found) == pytest.approx(expected, rel=1e-5), sample


def test_termination_lets_go_of_a_ray_that_plainly_ends_before() -> None:
    def pull(weight_there: float) -> float:
        weights = torch.tensor([0.0, 0.0, 0.0, weight_there, 0.0, 0.0, 0.0, 0.0])
        weights.requires_grad_()
        termination_loss(weights, two_rays(), torch.tensor([3.5, 0.0])).backward()
        assert weights.grad is not None
        return weight_there * float(weights.grad[3].abs())

    assert pull(1e-3) < 0.05 < 0.7 < pull(0.1)


def test_termination_without_known_distances_is_zero() -> None:
    weights = torch.rand(8, requires_grad=True)
    loss = termination_loss(weights, two_rays(), torch.zeros(2))
    loss.backward()
    assert float(loss.detach()) == 0.0 and weights.grad is not None and not bool(weights.grad.any())


def test_agreement_teaches_the_field_alone_and_only_where_the_gate_says_empty() -> None:
    weights = torch.full((3,), 0.5, requires_grad=True)
    occupancies = torch.tensor([0.0, 0.1, 0.9], requires_grad=True)
    loss = agreement_loss(weights, occupancies, 0.2)
    loss.backward()
    torch.testing.assert_close(weights.grad, torch.tensor([1.0, 0.5, 0.0]))
    assert occupancies.grad is None
    torch.testing.assert_close(loss.detach(), torch.tensor(0.75))


def test_a_batch_without_points_teaches_nothing() -> None:
    logits, none = torch.zeros(0, 3, requires_grad=True), torch.zeros(0)
    routes = torch.zeros(0, dtype=torch.int64)
    losses = [
        contribution_loss(logits, none, 0.05, 4.0),
        density_loss(logits.softmax(dim=-1)[:, 0], none),
        imbalanced_gate_loss(logits.softmax(dim=-1), routes, 0.9),
    ]
    for loss in losses:
        assert loss.item() == 0.0
        loss.backward()


def test_what_is_seen_through_a_pixel_is_the_backdrops_weight() -> None:
    """A clear, a half clear and an opaque ray, of a sample and a backdrop; one meets nothing."""
    ray_indices = torch.arange(3).repeat_interleave(2)
    is_backdrop = torch.tensor([False, True]).repeat(3)
    wanted, counts = torch.tensor([1.0, 0.5, 0.0, 1.0]), torch.tensor([1.0, 0.5, 0.0, 1.0])
    right = torch.tensor([0.0, 1.0, 0.5, 0.5, 0.3, 0.7])
    assert float(backdrop_loss(right, is_backdrop, ray_indices, wanted, counts)) == 0.0
    wrong = torch.tensor([0.4, 0.6, 0.2, 0.8, 0.3, 0.7], requires_grad=True)
    loss = backdrop_loss(wrong, is_backdrop, ray_indices, wanted, counts)
    assert loss.item() == pytest.approx((0.4**2 + 0.5 * 0.3**2) / 4)
    (gradient,) = torch.autograd.grad(loss, wrong)
    assert gradient[1] < 0.0 < gradient[3] and gradient[[0, 2, 4, 5]].abs().sum() == 0.0
    nothing = torch.zeros(0)
    assert float(backdrop_loss(nothing, nothing.bool(), nothing.long(), nothing, nothing)) == 0.0
