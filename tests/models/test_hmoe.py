"""Dropless dispatch is exactly the dense one-hot mixture, and much faster."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

import pytest
import torch
from dense_hmoe import dense_hmoe

from leco_plugin.models.hmoe import Expert, HMoE, HMoEConfig


def mixture(**sizes) -> HMoE:
    torch.manual_seed(0)
    hmoe = HMoE(HMoEConfig(**{"width": 8, **sizes})).double()
    for parameter in hmoe.parameters():  # residual experts start from adding nothing
        torch.nn.init.normal_(parameter, std=0.5)
    return hmoe


def assert_dispatch_is_dense(hmoe: HMoE, routes: torch.Tensor) -> None:
    """Outputs and all gradients of the two agree."""
    results = []
    for function in (hmoe, lambda *inputs: dense_hmoe(hmoe, *inputs)):
        torch.manual_seed(1)
        features = torch.randn(len(routes), 8, dtype=torch.float64, requires_grad=True)
        values = torch.rand(len(routes), dtype=torch.float64, requires_grad=True)
        hmoe.zero_grad(set_to_none=True)
        output = function(features, routes, values)
        (output * torch.randn_like(output)).sum().backward()
        gradients = [
            p.grad if p.grad is not None else torch.zeros_like(p)  # an expert without points
            for p in (features, values, *hmoe.parameters())
        ]
        results.append((output, *gradients))
    for ours, dense in zip(*results, strict=True):
        torch.testing.assert_close(ours, dense, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("empty_expert", ["identity", "mlp", "none"])
@pytest.mark.parametrize("experts", range(1, 9))
def test_dispatch_is_the_dense_mixture(experts: int, empty_expert) -> None:
    hmoe = mixture(scene_experts=experts, empty_expert=empty_expert, residual=bool(experts % 2))
    assert_dispatch_is_dense(hmoe, torch.randint(1 + experts, (101,)))


@pytest.mark.parametrize("empty_expert", ["identity", "mlp", "none"])
@pytest.mark.parametrize("expert", [0, 1, 4])
def test_all_points_may_go_to_one_expert(expert: int, empty_expert) -> None:
    hmoe = mixture(scene_experts=4, empty_expert=empty_expert)
    assert_dispatch_is_dense(hmoe, torch.full((20,), expert))


@pytest.mark.parametrize("empty_expert", ["identity", "mlp", "none"])
def test_there_may_be_no_points(empty_expert) -> None:
    hmoe = mixture(scene_experts=4, empty_expert=empty_expert)
    assert_dispatch_is_dense(hmoe, torch.zeros(0, dtype=torch.int64))


def test_a_skip_connection_is_dispatched_too() -> None:
    hmoe = mixture(scene_experts=3, layers=4, skip=2, residual=False)
    assert_dispatch_is_dense(hmoe, torch.randint(4, (50,)))


def test_the_identity_expert_passes_features_scaled_by_the_gate() -> None:
    features, values = torch.randn(5, 8).double(), torch.rand(5).double()
    output = mixture()(features, torch.zeros(5, dtype=torch.int64), values)
    assert torch.equal(output, features * values[:, None])


def test_without_an_empty_expert_empty_points_have_zero_features() -> None:
    output = mixture(empty_expert="none")(
        torch.randn(5, 8).double(), torch.zeros(5, dtype=torch.int64), torch.rand(5).double()
    )
    assert not bool(output.any())


def test_a_new_residual_expert_is_the_identity() -> None:
    features = torch.randn(5, 8)
    assert torch.equal(Expert(8, 3, residual=True)(features), features)


@pytest.mark.parametrize("teaches", [False, True], ids=["forward", "forward and backward"])
def test_dispatch_is_three_times_faster_than_the_dense_mixture_for_eight_experts(
    teaches: bool,
) -> None:
    hmoe = HMoE(HMoEConfig(scene_experts=8, width=256, layers=7, skip=3, residual=False))
    features, values = torch.randn(2048, 256), torch.rand(2048)
    routes = torch.randint(9, (2048,))
    ours: list[float] = []
    dense: list[float] = []

    def took(mixed: Callable[[], torch.Tensor]) -> float:
        started = time.perf_counter()
        output = mixed()
        if teaches:
            output.sum().backward()
        return time.perf_counter() - started

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.set_grad_enabled(teaches):
            for _ in range(4):  # the first round warms up
                ours.append(took(lambda: hmoe(features, routes, values)))
                dense.append(took(lambda: dense_hmoe(hmoe, features, routes, values)))
    finally:
        torch.set_num_threads(threads)
    assert statistics.median(dense[1:]) >= 3.0 * statistics.median(ours[1:])


@pytest.mark.parametrize("empty_expert", ["identity", "mlp", "none"])
def test_those_that_are_left_dispatch_as_before(empty_expert) -> None:
    hmoe = mixture(scene_experts=4, empty_expert=empty_expert)
    routes = torch.tensor([0, 1, 3, 3, 0, 1, 1])
    before = hmoe(torch.ones(7, 8).double(), routes, torch.ones(7))
    hmoe.drop(2)
    hmoe.drop(4)
    assert hmoe.left.tolist() == [True, False, True, False]
    assert torch.equal(hmoe(torch.ones(7, 8).double(), routes, torch.ones(7)), before)
    assert_dispatch_is_dense(hmoe, routes)


def test_a_dropped_expert_takes_its_parameters_along() -> None:
    hmoe = mixture(scene_experts=4)
    each = sum(parameter.numel() for parameter in hmoe.experts[1].parameters())
    before = sum(parameter.numel() for parameter in hmoe.parameters())
    assert hmoe.remaining_experts() is None
    gone = hmoe.drop(3)
    assert sum(parameter.numel() for parameter in hmoe.parameters()) == before - each
    assert not any(name.startswith("experts.3.") for name in hmoe.state_dict())
    hmoe.put_back(3, gone)
    assert sum(parameter.numel() for parameter in hmoe.parameters()) == before
    assert hmoe.remaining_experts() is None and bool(hmoe.left.all())


def test_who_loads_a_state_dict_has_the_experts_that_are_left_in_it() -> None:
    full, reduced = mixture(scene_experts=3), mixture(scene_experts=3)
    reduced.drop(1)
    features, values = torch.randn(30, 8).double(), torch.ones(30)
    fewer = torch.tensor([0, 2, 3])[torch.randint(3, (30,))]
    for source, target in ((reduced, full), (mixture(scene_experts=3), reduced)):
        target.load_state_dict(source.state_dict())
        assert target.left.tolist() == source.left.tolist()
        assert list(target.state_dict()) == list(source.state_dict())
        assert torch.equal(target(features, fewer, values), source(features, fewer, values))
    full.drop(2)
    full.load_state_dict({}, strict=False)  # as nerfstudio does after it has loaded a model
    assert full.left.tolist() == [False, False, True]
