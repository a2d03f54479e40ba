"""Coarse points cover the ray, and fine points have the distribution of the weights."""

from __future__ import annotations

import pytest
import torch

from leco_plugin.models.switch.rendering import draw, edges_around, spread, strata

CPU = torch.device("cpu")


@pytest.mark.parametrize("jittered", [False, True])
def test_each_part_of_the_ray_has_one_share(jittered: bool) -> None:
    shares = strata(6, 10, jittered, CPU)
    assert torch.equal((shares * 10).floor(), torch.arange(10.0).expand(6, 10))
    if not jittered:
        torch.testing.assert_close(shares[0], (torch.arange(10.0) + 0.5) / 10)
    assert jittered == (not torch.equal(shares[0], shares[1]))


def test_points_are_even_in_a_box_and_grow_with_distance_without_one() -> None:
    t_mins, t_maxs = torch.tensor([0.5, 1.0]), torch.tensor([2.0, 9.0])
    shares = torch.linspace(0.0, 1.0, 9).expand(2, 9)
    even = spread(t_mins, t_maxs, shares, growing=False)
    growing = spread(t_mins, t_maxs, shares, growing=True)
    for points in (even, growing):
        torch.testing.assert_close(points[:, 0], t_mins)
        torch.testing.assert_close(points[:, -1], t_maxs)
    steps, ratios = even.diff(dim=1), growing[:, 1:] / growing[:, :-1]
    torch.testing.assert_close(steps, steps[:, :1].expand_as(steps))
    torch.testing.assert_close(ratios, ratios[:, :1].expand_as(ratios))


def test_each_point_lies_in_its_stretch_and_no_part_of_the_ray_is_left_out() -> None:
    points = torch.rand(5, 12).sort(dim=-1).values + 1.0
    edges = edges_around(points, torch.full((5,), 1.0), torch.full((5,), 2.0))
    assert bool((edges[:, :-1] <= points).all() and (points <= edges[:, 1:]).all())
    assert bool((edges[:, 0] == 1.0).all() and (edges[:, -1] == 2.0).all())
    asked = torch.rand(5, 40) + 1.0
    nearest = (asked[:, :, None] - points[:, None, :]).abs().argmin(dim=-1)
    found = torch.searchsorted(edges[:, 1:-1].contiguous(), asked)
    assert torch.equal(nearest, found)


def slow_draw(edges: list[float], weights: list[float], share: float) -> float:
    """Walks along the ray until the share of the sum of weights is behind."""
    left = share * sum(weights)
    for start, end, weight in zip(edges, edges[1:], weights):
        if left <= weight:
            return start + (end - start) * left / weight
        left -= weight
    return edges[-1]


def test_drawing_inverts_the_cumulative_sum() -> None:
    edges = torch.rand(4, 9).double().sort(dim=-1).values
    weights = torch.rand(4, 8).double()
    shares = torch.rand(4, 30).double().sort(dim=-1).values
    drawn = draw(edges, weights, shares)
    for ray in range(4):
        expected = [
            slow_draw(edges[ray].tolist(), weights[ray].tolist(), share)
            for share in shares[ray].tolist()
        ]
        torch.testing.assert_close(
            drawn[ray], torch.tensor(expected, dtype=torch.float64), atol=1e-3, rtol=0
        )
    assert bool((drawn.diff(dim=-1) >= 0).all())


def test_points_gather_where_the_weight_is_and_spread_where_there_is_none() -> None:
    edges = torch.linspace(0.0, 1.0, 11).expand(2, 11)
    weights = torch.zeros(2, 10)
    weights[0, 7] = 1.0
    drawn = draw(edges, weights, strata(2, 100, False, CPU))
    inside = (drawn[0] >= 0.7 - 1e-6) & (drawn[0] <= 0.8 + 1e-6)
    assert float(inside.float().mean()) >= 0.99
    torch.testing.assert_close(drawn[1], (torch.arange(100.0) + 0.5) / 100)


def test_a_ray_of_no_length_keeps_all_points_in_one_place() -> None:
    at = torch.full((1,), 3.0)
    coarse = spread(at, at, strata(1, 4, True, CPU), growing=True)
    edges = edges_around(coarse, at, at)
    drawn = draw(edges, torch.zeros(1, 4), strata(1, 5, True, CPU))
    torch.testing.assert_close(drawn, torch.full((1, 5), 3.0))
