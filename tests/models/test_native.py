"""The routines in C against their slow twins in torch."""

from __future__ import annotations

import logging

import pytest
import torch
from torch import Tensor

from leco_plugin.models.compute import native
from leco_plugin.models.encodings import EncodingConfig, HashEncoding
from leco_plugin.models.field import FieldConfig, HMoEField
from leco_plugin.models.front_to_back import shade_front_to_back
from leco_plugin.models.frozen_gate import occupancy_of
from leco_plugin.models.gate import Gate, GateConfig
from leco_plugin.models.hmoe import HMoEConfig
from leco_plugin.models.rendering import Intervals, Rays, Routing, Scene, composite
from leco_plugin.samplers.kernels import VARIABLE
from leco_plugin.space import Space

needs_compiler = pytest.mark.skipif(not native.has_native(), reason="no C compiler")


def features_and_gradient(encoding: HashEncoding, positions: Tensor) -> tuple[Tensor, Tensor]:
    features = encoding(positions)
    worth = torch.linspace(-1.0, 1.0, features.numel()).view_as(features)
    return features.detach(), torch.autograd.grad((features * worth).sum(), encoding.table)[0]


@needs_compiler
@pytest.mark.parametrize("features", [1, 2, 4])
@pytest.mark.parametrize("threads", [1, 3])
def test_a_hash_grid_is_that_of_torch(
    features: int, threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    torch.manual_seed(0)
    encoding = HashEncoding(levels=5, features=features, log2_table=9, coarsest=4, finest=300)
    positions = torch.cat([torch.rand(331, 3) * 2 - 1, torch.tensor([[-1.0] * 3, [1.0] * 3])])
    monkeypatch.setattr(native, "FEWEST", 1)
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    ours = features_and_gradient(encoding, positions)
    monkeypatch.setenv(VARIABLE, "native")
    theirs = features_and_gradient(encoding, positions)
    torch.testing.assert_close(ours[0], theirs[0], rtol=1e-6, atol=1e-10)
    torch.testing.assert_close(ours[1], theirs[1], rtol=1e-4, atol=1e-5)


@needs_compiler
@pytest.mark.parametrize(("width", "layers", "octaves"), [(64, 3, 6), (17, 1, 9)])
@pytest.mark.parametrize("normed", [True, False])
def test_a_gate_answers_as_torch_does(
    width: int, layers: int, octaves: int, normed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    torch.manual_seed(0)
    encoding = EncodingConfig(octaves=octaves)
    gate = Gate(GateConfig(encoding, width, layers, scene_experts=3, normed=normed))
    gate.norm.bias.data.normal_()
    mapped = (torch.rand(3, 157) * 2 - 1).t()  # the strides of the march
    with torch.no_grad():
        ours, occupancy = gate(mapped), occupancy_of(gate, mapped, torch.float32)
        assert gate(mapped[:0]).shape == (0, 4)
        monkeypatch.setenv(VARIABLE, "native")
        theirs = gate(mapped)
        torch.testing.assert_close(occupancy, gate.occupancy(mapped), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-4)


@needs_compiler
def test_sines_of_large_angles_are_those_of_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    encoding = EncodingConfig(octaves=10)
    gate = Gate(GateConfig(encoding, width=63, layers=1, scene_experts=62))
    gate.hidden[0].weight.data.copy_(torch.eye(63))
    gate.hidden[0].bias.data.fill_(2.0)  # no feature is cut off
    gate.head.weight.data.copy_(torch.eye(63))
    gate.norm.eps = 0.0
    mapped = torch.rand(500, 3) * 2 - 1
    with torch.no_grad():
        ours = gate(mapped)
        monkeypatch.setenv(VARIABLE, "native")
        torch.testing.assert_close(ours, gate(mapped), rtol=0, atol=3e-4)


@needs_compiler
def test_a_field_answers_as_torch_does(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    hash_grid = EncodingConfig("hash", levels=3, log2_table=6, coarsest=4, finest=20)
    field = HMoEField(FieldConfig(hash_grid, HMoEConfig(scene_experts=3, width=18, layers=3)), 1)
    for parameter in field.parameters():
        parameter.data.normal_(0.0, 0.3)
    field.experts.drop(2)
    mapped, routes = torch.rand(333, 3) * 2 - 1, torch.tensor([0, 1, 3]).repeat(111)
    factors = torch.rand(333) + 0.5
    monkeypatch.setattr(native, "FEWEST", 1)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    with torch.no_grad():
        ours = field.density(mapped, routes, factors)
    theirs = field.density(mapped, routes, factors)
    assert theirs[0].requires_grad and not ours[0].requires_grad
    for one, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(one, other.detach(), rtol=1e-4, atol=1e-4)


@needs_compiler
def test_a_gate_that_does_not_learn_answers_alike_with_and_without_gradients() -> None:
    gate = Gate(GateConfig(width=16, layers=1)).requires_grad_(False)
    mapped = torch.rand(99, 3)
    with torch.no_grad():
        ours = gate(mapped)
    assert torch.equal(gate(mapped), ours)
    assert gate(mapped.requires_grad_()).requires_grad


@needs_compiler
def test_a_gate_does_not_hide_what_is_no_number() -> None:
    gate = Gate(GateConfig(width=16, layers=1)).requires_grad_(False)
    gate.hidden[0].bias[3] = torch.nan
    assert bool(gate(torch.rand(5, 3)).isnan().all())


@needs_compiler
def test_experts_of_one_layer_answer_as_they_learn() -> None:
    torch.manual_seed(0)
    grid = EncodingConfig("hash", levels=2, log2_table=6, coarsest=4, finest=9)
    field = HMoEField(FieldConfig(grid, HMoEConfig(scene_experts=2, width=9, layers=1)), 1)
    for parameter in field.parameters():
        parameter.data.normal_(0.0, 0.3)
    mapped, routes, factors = torch.rand(30, 3), torch.arange(30) % 3, torch.ones(30)
    with torch.no_grad():
        ours = field.density(mapped, routes, factors)
    for one, other in zip(ours, field.density(mapped, routes, factors), strict=True):
        torch.testing.assert_close(one, other.detach(), rtol=1e-4, atol=1e-5)


@needs_compiler
def test_positions_in_other_strides_are_read_as_they_are() -> None:
    encoding = HashEncoding(levels=2, features=2, log2_table=6, coarsest=4, finest=9)
    columns = torch.rand(3, 50) * 2 - 1
    assert torch.equal(encoding(columns.t()), encoding(columns.t().contiguous()))


def turn_in_memory(module: torch.nn.Module) -> None:
    """Leaves all weights as they are, matrices with their columns in one piece."""
    for parameter in module.parameters():
        if parameter.dim() == 2:
            parameter.data = parameter.data.t().contiguous().t()


def test_weights_in_other_strides_are_read_as_they_are() -> None:
    torch.manual_seed(0)
    grid = EncodingConfig("hash", levels=2, log2_table=6, coarsest=4, finest=9)
    gate = Gate(GateConfig(width=16, layers=2, scene_experts=2))
    field = HMoEField(FieldConfig(grid, HMoEConfig(scene_experts=2, width=9)), 3)
    for parameter in field.parameters():
        parameter.data.normal_(0.0, 0.3)
    mapped, weights, rays = torch.rand(30, 3), torch.rand(30), torch.arange(30)
    directions = torch.nn.functional.normalize(mapped, dim=-1)
    along = Rays(mapped, directions, torch.zeros(30), torch.ones(30), None)
    intervals = Intervals(rays, torch.zeros(30), torch.ones(30))
    scene = Scene(field, gate, Space(), Routing(0.2, False))

    def answers() -> list[Tensor]:
        sigmas, features = field.density(mapped, rays % 3, torch.ones(30))
        colors = composite(field.color, features, weights, along, intervals)
        logits = gate(mapped)
        (logits.square().sum() + sigmas.sum() + colors.sum()).backward()
        parts = [*gate.parameters(), *field.parameters()]
        slopes = [part.grad for part in parts if part.grad is not None]
        shown, _ = shade_front_to_back(scene, along, intervals)
        found = [logits, sigmas, features, colors, shown.rgb, *slopes]
        gate.zero_grad()
        field.zero_grad()
        return [each.detach() for each in found]

    before = answers()
    turn_in_memory(gate)
    turn_in_memory(field)
    for ours, theirs in zip(answers(), before, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-4)


def test_one_part_of_a_batch_without_memory_ends_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else the room of that part is read, which nobody has written to."""
    found = {0: 3, 4: 2}
    monkeypatch.setattr(native, "RAYS_AT_ONCE", 4)
    monkeypatch.setattr(native, "routine_of", lambda _: lambda begin, end: found[begin.value])
    rooms = 10 * torch.arange(8)
    assert native.call_along_rays("march_cells", rooms) == [slice(0, 3), slice(40, 42)]
    found[4] = -1
    with pytest.raises(MemoryError, match="no memory for a batch of rays"):
        native.call_along_rays("march_cells", rooms)


def test_without_a_compiler_torch_answers_and_the_log_says_so(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    native._library.cache_clear()
    monkeypatch.setattr(native.shutil, "which", lambda _: None)
    try:
        with caplog.at_level(logging.INFO):
            assert not native.has_native()
        encoding = HashEncoding(levels=2, features=2, log2_table=6, coarsest=4, finest=9)
        assert encoding(torch.rand(7, 3)).shape == (7, 4)
    finally:
        native._library.cache_clear()
    assert "no C compiler" in caplog.text


def test_a_compiler_that_fails_is_named_with_what_it_said(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    native._library.cache_clear()
    monkeypatch.setattr(native, "FLAGS", ("--no-such-flag",))
    try:
        with caplog.at_level(logging.INFO):
            found = native.has_native()
    finally:
        native._library.cache_clear()
    assert not found
    assert "no-such-flag" in caplog.text or "no C compiler" in caplog.text
