"""The gate's logits, what occupancy makes of them, and which expert they choose."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from ball_occupancy import CENTRE, ENCODINGS, HALF, RADIUS, ball
from hypothesis import given, settings
from hypothesis import strategies as st

from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.gate import (
    EMPTY,
    LARGEST_SIZES,
    MOST_VALUES,
    Gate,
    GateConfig,
    check_sizes,
    occupancy_from_logits,
    occupancy_logit,
    route,
)
from leco_plugin.occupancy import LARGEST_FILE


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


def test_a_point_exactly_at_the_threshold_is_not_empty() -> None:
    assert route(torch.zeros(1, 2), 0.5).tolist() == [1]  # o is exactly a half


def test_a_norm_that_is_neither_there_nor_not_is_refused() -> None:
    with pytest.raises(ValueError, match="neither true nor false"):
        check_sizes(replace(GateConfig(), normed="no"))  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", ENCODINGS)
def test_a_gate_answers_for_every_point_also_for_none(kind) -> None:
    gate = Gate(GateConfig(ENCODINGS[kind], width=8, scene_experts=3))
    assert gate(torch.rand(5, 3)).shape == (5, 4)
    assert gate.occupancy(torch.zeros(0, 3)).shape == (0,)


def test_logits_are_float32_under_autocast() -> None:
    with torch.autocast("cpu", torch.bfloat16):
        assert Gate(GateConfig(width=8))(torch.rand(5, 3)).dtype == torch.float32


def test_gates_of_the_same_values_and_other_sizes_decide_otherwise() -> None:
    config = GateConfig(EncodingConfig("hash", levels=2, log2_table=5, finest=16), width=8)
    finer = replace(config, encoding=replace(config.encoding, finest=32))
    gate, same, other = Gate(config), Gate(config), Gate(finer)
    for each in (same, other):
        for parameter, its in zip(each.parameters(), gate.parameters(), strict=True):
            parameter.data.copy_(its.data)
    assert gate.decides_as(same) and not gate.decides_as(other)


def test_without_a_norm_features_keep_their_lengths() -> None:
    torch.manual_seed(0)
    gate, mapped = Gate(GateConfig(width=16, normed=False)), torch.rand(100, 3) * 2 - 1
    features = gate.encoding(mapped)
    for layer in gate.hidden:
        features = torch.relu(layer(features))
    centred = features - features.mean(dim=1, keepdim=True)
    expected = centred @ gate.head.weight.T + gate.head.bias
    torch.testing.assert_close(gate(mapped), expected, rtol=1e-5, atol=1e-6)


def test_a_configuration_survives_its_dictionary() -> None:
    config = GateConfig(EncodingConfig("hash", levels=3), width=17, scene_experts=5)
    assert GateConfig.from_dict(config.to_dict()) == config


@pytest.mark.parametrize("kind", ENCODINGS)
def test_a_gate_on_any_features_learns_a_ball(kind) -> None:
    """To half a percent of the cube, and not beyond a twentieth of its half extent."""
    generator = torch.Generator().manual_seed(1)
    offsets = HALF * (torch.rand(1 << 16, 3, generator=generator) * 2 - 1)
    distances = offsets.norm(dim=-1)
    wrong = ball(kind).occupied(offsets + torch.tensor(CENTRE)) != (distances < RADIUS)
    assert float(wrong.float().mean()) < 5e-3
    assert not bool(wrong[(distances - RADIUS).abs() > 0.05 * HALF].any())


@pytest.mark.parametrize("name", LARGEST_SIZES)
def test_a_size_out_of_range_is_refused_in_one_line(name) -> None:
    for size in (0, -1, 1.5, "a\nb", None, True, LARGEST_SIZES[name] + 1, 10**400):
        config = GateConfig()
        if hasattr(config, name):
            config = replace(config, **{name: size})
        else:
            config = replace(config, encoding=replace(config.encoding, **{name: size}))
        with pytest.raises(ValueError, match=f"the gate's {name} is") as error:
            check_sizes(config)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("kind", ENCODINGS)
def test_the_largest_sizes_are_refused_before_they_are_allocated(kind) -> None:
    sizes = {name: size for name, size in LARGEST_SIZES.items() if hasattr(EncodingConfig, name)}
    wide = 2**12 if kind == "frequency" else 64
    with pytest.raises(ValueError, match=r"on .* features of these sizes holds \d+ values"):
        check_sizes(GateConfig(EncodingConfig(kind, **sizes), width=wide))
    assert 4 * MOST_VALUES < LARGEST_FILE


@pytest.mark.parametrize("kind", ENCODINGS)
def test_usual_sizes_are_accepted(kind) -> None:
    check_sizes(GateConfig(EncodingConfig(kind)))
