"""Each point goes through its expert, and an expert takes as many as it has places for."""

from __future__ import annotations

import math

import pytest
import torch

from leco_plugin.models.compute.dispatch import Places, dispatch, within_capacity


def test_each_point_goes_through_its_expert_and_comes_back_in_its_place() -> None:
    features = torch.randn(50, 3)
    routes = torch.randint(4, (50,))
    experts = [lambda x: x + 1.0, None, lambda x: x * 2.0, lambda x: -x]
    dispatched = dispatch(features, routes, experts)
    for point, expert, answer in zip(features, routes.tolist(), dispatched):
        function = experts[expert]
        expected = torch.zeros(3) if function is None else function(point)
        assert torch.equal(answer, expected)


def test_without_points_there_are_no_answers() -> None:
    none = dispatch(torch.zeros(0, 3), torch.zeros(0, dtype=torch.int64), [torch.neg, None])
    assert none.shape == (0, 3)


def slow_within_capacity(routes, gate_values, num_experts, capacity_factor) -> torch.Tensor:
    """From the definition: each expert lists its points by gate value and takes the first ones."""
    capacity = math.floor(capacity_factor * math.ceil(len(routes) / num_experts))
    within = torch.zeros(len(routes), dtype=torch.bool)
    for expert in range(num_experts):
        points = [i for i in range(len(routes)) if routes[i] == expert]
        points.sort(key=lambda i: -float(gate_values[i]))
        within[points[:capacity]] = True
    return within


@pytest.mark.parametrize("capacity_factor", [0.3, 1.0, 1.25, 8.0])
@pytest.mark.parametrize("count", [0, 1, 7, 100])
def test_capacity_goes_to_the_highest_gate_values(count: int, capacity_factor: float) -> None:
    routes = torch.randint(3, (count,))
    gate_values = torch.rand(count)
    within = within_capacity(routes, gate_values, 4, capacity_factor)
    assert torch.equal(within, slow_within_capacity(routes, gate_values, 4, capacity_factor))


def test_a_place_for_every_point_drops_none() -> None:
    routes = torch.zeros(40, dtype=torch.int64)
    assert bool(within_capacity(routes, torch.rand(40), 4, 4.0).all())
    assert int(within_capacity(routes, torch.rand(40), 4, 1.0).sum()) == 10


def test_filled_places_answer_and_teach_as_one_point_at_a_time() -> None:
    routes = torch.randint(3, (1001,))
    experts = [torch.nn.Linear(4, 4), None, torch.nn.Linear(4, 4)]
    features = torch.randn(1001, 4, requires_grad=True)
    weights = torch.randn(1001, 4)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert Places(routes, 3).filling, "autocast on a CPU fills up"
        mine = (dispatch(features, routes, experts).float() * weights).sum()
    plain = sum(
        (expert(features[routes == i]) * weights[routes == i]).sum()
        for i, expert in enumerate(experts)
        if expert is not None
    )
    wanted = [features, *experts[0].parameters(), *experts[2].parameters()]
    for ours, theirs in zip(torch.autograd.grad(mine, wanted), torch.autograd.grad(plain, wanted)):
        scale = float(theirs.abs().max())
        assert torch.allclose(ours, theirs, rtol=2e-2, atol=2e-2 * scale)
