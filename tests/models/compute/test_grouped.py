"""Grouped products give the dense mixture, forward and backward, wherever the points lie."""

from __future__ import annotations

import pytest
import torch
from dense_hmoe import dense_hmoe
from waits import Waits

from leco_plugin.models.compute.grouped import grouped_dispatch, may_group
from leco_plugin.models.hmoe import Expert, HMoE, HMoEConfig

pytestmark = pytest.mark.skipif(
    not hasattr(torch.nn.functional, "grouped_mm"), reason="this torch has no grouped_mm"
)


def results(hmoe: HMoE, grouped: bool, routes: torch.Tensor) -> list[torch.Tensor]:
    """Output and all gradients of the grouped or of the dense mixture, float32."""
    torch.manual_seed(1)
    features = torch.randn(len(routes), 8, requires_grad=True)
    values = torch.ones(len(routes))
    hmoe.zero_grad(set_to_none=True)
    if grouped:
        output = hmoe._grouped(features, routes, torch.float32)
    else:
        output = dense_hmoe(hmoe, features, routes, values)
    (output * torch.randn_like(output)).sum().backward()
    parameters = [p if p.grad is None else p.grad for p in hmoe.parameters()]
    return [output, features.grad, *parameters]


@pytest.mark.parametrize("empty_expert", ["identity", "mlp", "none"])
@pytest.mark.parametrize("residual", [False, True])
@pytest.mark.parametrize("routing", ["mixed", "all empty", "all one", "last missing"])
def test_grouped_is_the_dense_mixture(routing: str, residual: bool, empty_expert) -> None:
    torch.manual_seed(0)
    config = HMoEConfig(3, 8, 3, None if residual else 2, residual, empty_expert)
    hmoe = HMoE(config)
    for parameter in hmoe.parameters():
        torch.nn.init.normal_(parameter, std=0.5)
    routes = {
        "mixed": torch.randint(4, (41,)),
        "all empty": torch.zeros(41, dtype=torch.int64),
        "all one": torch.full((41,), 2),
        "last missing": torch.randint(3, (41,)),
    }[routing]
    for ours, dense in zip(results(hmoe, True, routes), results(hmoe, False, routes), strict=True):
        torch.testing.assert_close(ours, dense, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("empty_expert", ["identity", "none"])
def test_grouped_is_the_dense_mixture_of_those_left(empty_expert) -> None:
    torch.manual_seed(0)
    hmoe = HMoE(HMoEConfig(4, 8, 2, empty_expert=empty_expert))
    for parameter in hmoe.parameters():
        torch.nn.init.normal_(parameter, std=0.5)
    hmoe.drop(1)
    hmoe.drop(3)
    routes = torch.tensor([0, 2, 4])[torch.randint(3, (41,))]
    for ours, dense in zip(results(hmoe, True, routes), results(hmoe, False, routes), strict=True):
        torch.testing.assert_close(ours, dense, rtol=1e-4, atol=1e-4)


def test_without_points_there_are_no_answers() -> None:
    none = grouped_dispatch(torch.zeros(0, 8), torch.zeros(0, dtype=torch.int64), [Expert(8, 2)])
    assert none.shape == (0, 8)


def test_it_serves_bfloat16_on_cuda_only() -> None:
    assert not may_group(torch.zeros(2, 8, dtype=torch.bfloat16), 4, 8)


def test_nothing_waits_for_the_sizes_of_groups() -> None:
    hmoe = HMoE(HMoEConfig(4, 8, 3, None, False))
    features = torch.randn(100, 8, requires_grad=True)
    routes = torch.randint(5, (100,))
    with Waits() as grouped:
        hmoe._grouped(features, routes, torch.float32).sum().backward()
    with Waits() as plain:
        hmoe(features, routes, torch.ones(100))
    assert grouped.seen == [] and plain.seen == ["tolist"]


@pytest.mark.gpu
def test_it_never_waits_for_the_device() -> None:
    hmoe = HMoE(HMoEConfig(4, 64, 3, None, False)).cuda()
    features = torch.randn(1000, 64, device="cuda")
    routes, values = torch.randint(5, (1000,), device="cuda"), torch.rand(1000, device="cuda")
    with torch.autocast("cuda", dtype=torch.bfloat16):
        if not may_group(features, 4, 64):
            pytest.skip("this device has no grouped products")
        torch.cuda.set_sync_debug_mode("error")
        try:
            ours = hmoe(features, routes, values)
        finally:
            torch.cuda.set_sync_debug_mode("default")
        dense = dense_hmoe(hmoe, features, routes, values)
    torch.testing.assert_close(ours.float(), dense.float(), rtol=0.05, atol=0.05)
