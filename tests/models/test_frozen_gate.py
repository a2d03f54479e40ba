"""A frozen gate on a CPU answers as the gate does, whatever its weights are and become."""

from __future__ import annotations

import pytest
import torch
from ball_occupancy import ENCODINGS
from torch import Tensor

from leco_plugin.models import frozen_gate
from leco_plugin.models.frozen_gate import occupancy_of
from leco_plugin.models.gate import Gate, GateConfig

DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16}
STATED = {"float32": 1e-5, "bfloat16": 1e-2}
"""How far o may lie from the gate's: products of another order round a unit to its neighbour."""


def gate_of(
    kind: str = "frequency", scale: float = 1.0, experts: int = 3, normed: bool = True
) -> Gate:
    torch.manual_seed(0)
    gate = Gate(GateConfig(ENCODINGS[kind], 24, 3, experts, normed))
    with torch.no_grad():
        for parameter in gate.parameters():
            parameter += 0.2 * torch.randn_like(parameter)
        gate.head.weight *= scale
    return gate


@torch.no_grad()
def slow_occupancy(gate: Gate, mapped: Tensor) -> Tensor:
    """1 - softmax(W LN(MLP(gamma(x))))_0 in float64, to its last digits (DESIGN, section 3)."""
    features = gate.encoding(mapped).double()
    for layer in gate.hidden:
        features = (features @ layer.weight.double().T + layer.bias.double()).clamp(min=0.0)
    centered = features - features.mean(dim=1, keepdim=True)
    spread = (centered.square().mean(dim=1, keepdim=True) + gate.norm.eps).sqrt()
    normed = centered / spread * gate.norm.weight.double() + gate.norm.bias.double()
    logits = normed @ gate.head.weight.double().T + gate.head.bias.double()
    return logits.softmax(dim=1)[:, 1:].sum(dim=1)


@pytest.mark.parametrize("kind", ENCODINGS)
@pytest.mark.parametrize(("experts", "normed"), [(1, True), (3, True), (1, False), (3, False)])
@pytest.mark.parametrize("count", [0, 1, 1003])
def test_answers_are_those_of_the_definition(kind, experts, normed, count) -> None:
    gate, mapped = gate_of(kind, experts=experts, normed=normed), torch.rand(count, 3) * 2 - 1
    expected = slow_occupancy(gate, mapped).float()
    values = occupancy_of(gate, mapped, torch.float32)
    torch.testing.assert_close(values, expected, rtol=0, atol=STATED["float32"])


@pytest.mark.parametrize(("experts", "normed"), [(1, True), (3, True), (1, False), (3, False)])
def test_rows_that_are_not_multiplied_at_once_are_answered_as_others(
    experts, normed, monkeypatch
) -> None:
    gate, mapped = gate_of(experts=experts, normed=normed), torch.rand(1003, 3) * 2 - 1
    monkeypatch.setattr(frozen_gate, "UNITS_AT_ONCE", 24 * 50)
    expected = slow_occupancy(gate, mapped).float()
    values = occupancy_of(gate, mapped, torch.float32)
    torch.testing.assert_close(values, expected, rtol=0, atol=STATED["float32"])


@pytest.mark.parametrize("kind", ENCODINGS)
@pytest.mark.parametrize("precision", DTYPES)
@pytest.mark.parametrize("alone", [True, False])
def test_answers_are_the_gates_in_its_precision(kind, precision, alone, monkeypatch) -> None:
    if alone:
        monkeypatch.setattr(frozen_gate, "_one_pass", lambda dtype: None)
    gate, mapped = gate_of(kind), torch.rand(3000, 3) * 2 - 1
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16, enabled=precision == "bfloat16"):
        expected = gate.occupancy(mapped)
        values = occupancy_of(gate, mapped, DTYPES[precision])
    assert values.dtype == torch.float32
    torch.testing.assert_close(values, expected, rtol=0, atol=STATED[precision])


@pytest.mark.parametrize(("experts", "normed"), [(1, True), (3, True), (3, False)])
def test_a_gate_that_is_sure_of_emptiness_keeps_its_digits(experts, normed) -> None:
    gate, mapped = gate_of(experts=experts, normed=normed), torch.rand(1000, 3) * 2 - 1
    with torch.no_grad():
        gate.head.bias[0] += 40.0
    values, expected = occupancy_of(gate, mapped, torch.float32), slow_occupancy(gate, mapped)
    assert float(expected.max()) < 1e-6
    torch.testing.assert_close(values.double(), expected, rtol=1e-3, atol=0)


def test_a_gate_that_is_sure_beyond_all_exponentials_stays_finite() -> None:
    gate, mapped = gate_of(scale=1e4), torch.rand(1000, 3) * 2 - 1
    values, expected = occupancy_of(gate, mapped, torch.float32), slow_occupancy(gate, mapped)
    certain = (expected < 1e-6) | (expected > 1.0 - 1e-6)
    assert int(certain.sum()) > 900 and 0 < int((expected > 0.5).sum()) < 1000
    torch.testing.assert_close(values[certain], expected[certain].float(), rtol=0, atol=1e-5)
    assert bool(((values >= 0.0) & (values <= 1.0)).all())


def test_units_that_are_all_alike_are_no_division_by_zero() -> None:
    gate, mapped = gate_of(), torch.rand(100, 3) * 2 - 1
    with torch.no_grad():
        gate.hidden[-1].weight.zero_()
        gate.hidden[-1].bias.fill_(0.3)
        expected = gate.occupancy(mapped)
    values = occupancy_of(gate, mapped, torch.float32)
    torch.testing.assert_close(values, expected, rtol=0, atol=1e-3)


def test_weights_that_change_are_noticed() -> None:
    gate, mapped = gate_of(), torch.rand(1000, 3) * 2 - 1
    other = Gate(gate.config)

    def assert_current() -> None:
        with torch.no_grad():
            expected = gate.occupancy(mapped)
        torch.testing.assert_close(
            occupancy_of(gate, mapped, torch.float32), expected, rtol=0, atol=1e-5
        )

    assert_current()
    with torch.no_grad():
        gate.head.bias[0] += 1.0
    assert_current()
    gate.hidden[0].weight.data = torch.randn_like(gate.hidden[0].weight)
    assert_current()
    gate.load_state_dict(other.state_dict(), assign=True)
    assert_current()


def test_an_unchanged_gate_is_prepared_once_for_each_precision() -> None:
    gate = gate_of()
    first = frozen_gate.folded_gate(gate, torch.float32)
    assert frozen_gate.folded_gate(gate, torch.bfloat16).layers[0][0].dtype == torch.bfloat16
    assert frozen_gate.folded_gate(gate, torch.float32) is first
