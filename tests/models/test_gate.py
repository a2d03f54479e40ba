"""The gate's logits, what occupancy makes of them, and which expert they choose."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.gate import (
    EMPTY,
    Gate,
    GateConfig,
    occupancy_from_logits,
    occupancy_logit,
    route,
)


def random_logits(seed: int, experts: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(100, 1 + experts, generator=generator, dtype=torch.float64) * 5


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 2**16), experts=st.integers(1, 8))
def test_occupancy_is_one_minus_the_probability_of_emptiness(seed: int, experts: int) -> None:
    logits = random_logits(seed, experts)
    expected = 1.0 - logits.softmax(dim=-1)[:, EMPTY]
    torch.testing.assert_close(occupancy_from_logits(logits), expected, rtol=0, atol=1e-12)
    torch.testing.assert_close(occupancy_logit(logits).sigmoid(), expected, rtol=0, atol=1e-12)


def test_occupancy_keeps_its_digits_where_the_gate_is_sure_of_emptiness() -> None:
    value = occupancy_from_logits(torch.tensor([[40.0, 0.0, 0.0]]))
    assert value.item() == pytest.approx(2.0 * torch.tensor(-40.0).double().exp().item(), rel=1e-5)


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 2**16), experts=st.integers(1, 8))
def test_without_a_threshold_the_route_is_the_argmax(seed: int, experts: int) -> None:
    logits = random_logits(seed, experts)
    assert torch.equal(route(logits, None), logits.argmax(dim=-1))


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 2**16), below=st.floats(0.0, 1.0))
def test_with_a_threshold_exactly_the_points_below_it_are_empty(seed: int, below: float) -> None:
    logits = random_logits(seed, 4)
    routes = route(logits, below)
    assert torch.equal(routes == EMPTY, occupancy_from_logits(logits) < below)
    on_scene = routes != EMPTY
    assert torch.equal(routes[on_scene], logits[on_scene, 1:].argmax(dim=-1) + 1)


@pytest.mark.parametrize("kind", ["frequency", "hash"])
def test_a_gate_answers_for_every_point_also_for_none(kind) -> None:
    gate = Gate(GateConfig(EncodingConfig(kind, levels=2, log2_table=5), width=8, scene_experts=3))
    assert gate(torch.rand(5, 3)).shape == (5, 4)
    assert gate.occupancy(torch.zeros(0, 3)).shape == (0,)


def test_logits_are_float32_under_autocast() -> None:
    with torch.autocast("cpu", torch.bfloat16):
        assert Gate(GateConfig(width=8))(torch.rand(5, 3)).dtype == torch.float32


def test_a_configuration_survives_its_dictionary() -> None:
    config = GateConfig(EncodingConfig("hash", levels=3), width=17, scene_experts=5)
    assert GateConfig.from_dict(config.to_dict()) == config
