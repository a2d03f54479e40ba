"""Under autocast on a CPU numbers of rows are few, and answers stay what they are."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from leco_plugin.models.compute import device
from leco_plugin.models.compute.device import fast_precision
from leco_plugin.models.compute.dispatch import SIZES_PER_OCTAVE, pad_to_steady_size, steady_size
from leco_plugin.models.field import FieldConfig, HMoEField
from leco_plugin.models.gate import Gate, GateConfig

HALF = torch.bfloat16


@given(st.integers(0, 1 << 24))
def test_a_size_is_filled_by_less_than_a_sixteenth(count: int) -> None:
    with torch.autocast("cpu", dtype=HALF):
        size = steady_size(count, "cpu")
    assert count <= size <= count + count / SIZES_PER_OCTAVE


def test_there_are_few_sizes() -> None:
    with torch.autocast("cpu", dtype=HALF):
        sizes = {steady_size(count, "cpu") for count in range(1 << 14, 1 << 16)}
    assert len(sizes) <= 2 * SIZES_PER_OCTAVE + 1


@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_nothing_is_filled_where_nothing_is_compiled(device: str) -> None:
    assert steady_size(1001, device) == 1001
    with torch.autocast("cpu", dtype=HALF, enabled=device != "cpu"):
        assert steady_size(1001, device) == 1001


def test_rows_are_followed_by_zeros() -> None:
    rows = torch.rand(1001, 3)
    with torch.autocast("cpu", dtype=HALF):
        filled = pad_to_steady_size(rows)
    assert torch.equal(filled[:1001], rows)
    assert len(filled) > 1001
    assert not filled[1001:].any()


def gradients(field: HMoEField, gate: Gate, mapped: torch.Tensor) -> list[torch.Tensor]:
    """Answers and gradients of a field and a gate in half precision."""
    with torch.autocast("cpu", dtype=HALF):
        logits = gate(mapped)
        routes = logits.argmax(dim=-1)
        sigmas, features = field.density(mapped, routes, torch.ones(len(mapped)))
        colors = field.color(features, torch.arange(len(mapped)), mapped, None)
    loss = (colors * sigmas[:, None]).sum() + logits.square().sum()
    parameters = [*field.parameters(), *gate.parameters()]
    given = torch.autograd.grad(loss, parameters, allow_unused=True)
    return [
        logits.detach(),
        sigmas.detach(),
        colors.detach(),
        *(grad for grad in given if grad is not None),
    ]


def test_filling_changes_neither_answers_nor_gradients(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    gate, field = Gate(GateConfig()), HMoEField(FieldConfig(), num_images=2)
    for expert in list(field.experts.experts)[1:]:
        torch.nn.init.normal_(expert.layers[-1].weight, std=0.1)
    mapped = torch.nn.functional.normalize(torch.randn(1003, 3), dim=-1)
    filled = gradients(field, gate, mapped)
    for module in ("dispatch",):
        name = f"leco_plugin.models.compute.{module}.steady_size"
        monkeypatch.setattr(name, lambda count, device_type: count)
    for mine, plain in zip(filled, gradients(field, gate, mapped), strict=True):
        scale = float(plain.abs().max())
        assert torch.allclose(mine, plain, rtol=2e-2, atol=1e-2 * scale)


@pytest.mark.parametrize(
    ("feature", "in_c", "precision"),
    [
        ("amx_tile", True, "bfloat16"),
        ("amx_tile", False, "bfloat16"),
        ("avx512_bf16", False, "bfloat16"),
        ("avx512_bf16", True, "float32"),
    ],
)
def test_half_precision_where_it_is_the_fastest(
    feature: str, in_c: bool, precision: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(device, "has_native", lambda: in_c)
    for other in ("amx_tile", "avx512_bf16"):
        supported = f"_is_{other}_supported"
        monkeypatch.setattr(torch.cpu, supported, lambda: False, raising=False)
    assert fast_precision("cpu") == "float32"
    monkeypatch.setattr(torch.cpu, f"_is_{feature}_supported", lambda: True, raising=False)
    assert fast_precision("cpu") == precision
