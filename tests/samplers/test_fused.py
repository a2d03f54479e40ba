"""Kernels are chosen where they can run, and one that fails is replaced by its twin, once said."""

from __future__ import annotations

import copy
import logging
import subprocess
import sys
from types import SimpleNamespace
from typing import Any
from weakref import WeakKeyDictionary

import pytest
import torch
from ball_occupancy import ENCODINGS, ball

from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.gate import Gate, GateConfig
from leco_plugin.occupancy import Occupancy
from leco_plugin.samplers.cells.cache import CellCache
from leco_plugin.samplers.estimator import LearnedOccupancyEstimator
from leco_plugin.samplers.kernels import fused
from leco_plugin.samplers.kernels.gate_weights import GateWeights, gate_weights, why_not
from leco_plugin.samplers.marching import RUN, Candidates, March, Rays, Samples, cut, keep_steps
from leco_plugin.samplers.rays import (
    TooManyCandidates,
    candidate_counts,
    growth_table,
    powers_needed,
    switch,
)
from leco_plugin.space import Space


@pytest.fixture(autouse=True)
def switched_on(monkeypatch) -> None:
    monkeypatch.setattr(fused, "_off", set())
    monkeypatch.setattr(fused, "_passed", {kind: WeakKeyDictionary() for kind in fused._passed})


@pytest.fixture
def on_any_device(monkeypatch) -> None:
    monkeypatch.setattr(fused, "is_ready", lambda device, name="gate": name not in fused._off)


def test_without_cuda_triton_is_never_imported() -> None:
    code = (
        "import sys, torch; from leco_plugin.samplers.estimator import LearnedOccupancyEstimator;"
        "from leco_plugin.occupancy import Occupancy; from leco_plugin.models.gate import *;"
        "from leco_plugin.space import Space;"
        "made = LearnedOccupancyEstimator(Occupancy(Gate(GateConfig()), Space(), 0.5), "
        "cache_bytes=0); made.sampling(torch.zeros(2, 3), torch.ones(2, 3), render_step_size=0.1);"
        "assert not torch.cuda.is_available(); assert 'triton' not in sys.modules"
    )
    if torch.cuda.is_available():
        pytest.skip("there is CUDA")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.usefixtures("on_any_device")
def test_a_failing_kernel_is_said_once_and_its_twin_answers(monkeypatch, caplog) -> None:
    asked = Occupancy(Gate(GateConfig()), Space(), 0.5)

    monkeypatch.setitem(sys.modules, "leco_plugin.samplers.kernels.gate_kernel", None)
    places = torch.randn(50, 3)
    with caplog.at_level(logging.WARNING):
        first, second = asked.occupied(places), asked.occupied(places)
    assert torch.equal(first, asked.query(places) >= asked.threshold_value)
    assert torch.equal(first, second)
    said = [record.getMessage() for record in caplog.records]
    assert len(said) == 1 and "the fused gate does not run, torch answers" in said[0]
    assert "\n" not in said[0]


@pytest.mark.usefixtures("on_any_device")
def test_a_missing_triton_is_said_once_and_torch_answers(steep, monkeypatch, caplog) -> None:
    monkeypatch.setitem(sys.modules, "triton", None)
    for name in ("gate_kernel", "march_kernel"):
        monkeypatch.delitem(sys.modules, f"leco_plugin.samplers.{name}", raising=False)
    rays = torch.rand(9, 3), torch.randn(9, 3)
    with caplog.at_level(logging.WARNING):
        samples = [steep.sampling(*rays, render_step_size=0.1) for _ in range(2)]
        steep.occupancy.occupied(torch.rand(50, 3))
    with fused.twins_only():
        wanted = steep.sampling(*rays, render_step_size=0.1)
    assert all(map(torch.equal, samples[0], wanted)) and all(map(torch.equal, samples[1], wanted))
    said = [record.getMessage() for record in caplog.records]
    assert len(said) == 1 and "triton" in said[0] and "torch answers in its place" in said[0]


def right_gate(made: LearnedOccupancyEstimator, monkeypatch) -> None:
    """Puts a kernel that decides as its twin in the place of the gate's."""
    gate = SimpleNamespace(gate_decisions=lambda w, x: made.occupancy.query(x) >= w.facts[10])
    monkeypatch.setitem(sys.modules, "leco_plugin.samplers.kernels.gate_kernel", gate)


def keep(candidates: Candidates, n_steps: int, occupied: Any, near: Any = None) -> Samples:
    """Those candidates that are occupied; `n_steps` is the most of any ray."""
    rays, runs = cut(candidates, n_steps, near)
    return keep_steps(runs, RUN, rays, occupied, near is not None)


class MarchKernel:
    """Stands where the march's kernel is, and answers as the twin with a fault of its own."""

    def __init__(self, made: LearnedOccupancyEstimator, fault: str) -> None:
        self.made, self.fault, self.calls = made, fault, 0

    def march_kept(self, cache: CellCache, weights: GateWeights, candidates: Candidates) -> Samples:
        self.calls += 1
        longest = int(candidates.counts.max())
        with fused.twins_only():
            samples = keep(candidates, longest, self.made.occupied, cache.near)
        if self.fault == "keeps all":
            return keep(candidates, longest, None)
        if self.fault == "skips some":
            return tuple(part[len(part) // 25 :] for part in samples)
        if self.fault == "other order":
            return tuple(part.flip(0) for part in samples)
        if self.fault == "raises":
            raise RuntimeError("out of resource: shared memory\nand more")
        return samples


@pytest.fixture(scope="module")
def steep() -> LearnedOccupancyEstimator:
    """Cells of a ball with a sharp border."""
    return LearnedOccupancyEstimator(ball(), cache_bytes=1 << 16, tolerance=0.02)


@pytest.mark.usefixtures("on_any_device")
@pytest.mark.parametrize("cone_angle", [0.0, 0.01])
@pytest.mark.parametrize("fault", ["keeps all", "skips some", "other order", "raises"])
def test_a_march_that_keeps_otherwise_is_never_believed(
    fault: str, cone_angle: float, steep, monkeypatch, caplog
) -> None:
    kernel = MarchKernel(steep, fault)
    monkeypatch.setitem(sys.modules, "leco_plugin.samplers.kernels.march_kernel", kernel)
    right_gate(steep, monkeypatch)
    rays = torch.rand(9, 3), torch.randn(9, 3)
    options = {"render_step_size": 0.05, "cone_angle": cone_angle, "far_plane": 4.0}
    with caplog.at_level(logging.WARNING):
        samples = [steep.sampling(*rays, **options) for _ in range(2)]
    assert kernel.calls == 1 and fused._off == {"march"}  # the gate goes on
    with fused.twins_only():
        wanted = steep.sampling(*rays, **options)
    assert all(map(torch.equal, samples[0], wanted)) and all(map(torch.equal, samples[1], wanted))
    said = [record.getMessage() for record in caplog.records]
    assert len(said) == 1 and "the fused march does not run" in said[0] and "\n" not in said[0]


@pytest.mark.usefixtures("on_any_device")
def test_a_march_is_compared_with_its_twin_once_for_each_kind_of_step(steep, monkeypatch) -> None:
    kernel = MarchKernel(steep, "none")
    monkeypatch.setitem(sys.modules, "leco_plugin.samplers.kernels.march_kernel", kernel)
    right_gate(steep, monkeypatch)
    calls = []
    for cone_angle in (0.0, 0.0, 0.01, 0.0, 0.01):
        steep.sampling(
            *(torch.rand(9, 3), torch.randn(9, 3)),
            render_step_size=0.05,
            cone_angle=cone_angle,
            far_plane=4.0,
        )
        calls.append(kernel.calls)
    assert calls == [2, 3, 5, 6, 7] and not fused._off


@pytest.mark.usefixtures("on_any_device")
def test_a_kernel_that_decides_otherwise_is_never_believed(monkeypatch, caplog) -> None:
    asked = Occupancy(Gate(GateConfig()), Space(), 0.0)
    wrong = SimpleNamespace(gate_decisions=lambda weights, x: torch.zeros(len(x), dtype=bool))
    monkeypatch.setitem(sys.modules, "leco_plugin.samplers.kernels.gate_kernel", wrong)
    with caplog.at_level(logging.WARNING):
        assert asked.occupied(torch.rand(50, 3)).all()
        assert asked.occupied(torch.rand(50, 3)).all()
    said = [record.getMessage() for record in caplog.records]
    assert len(said) == 1 and "decides otherwise about" in said[0]


@pytest.mark.usefixtures("on_any_device")
def test_a_kernel_is_compared_with_its_twin_once_for_each_gate(monkeypatch) -> None:
    asked = Occupancy(Gate(GateConfig()), Space(), 0.5)
    sizes: list[int] = []

    def answer(weights: GateWeights, positions: torch.Tensor) -> torch.Tensor:
        sizes.append(len(positions))
        return asked.query(positions) >= asked.threshold_value

    kernel = SimpleNamespace(gate_decisions=answer)
    monkeypatch.setitem(sys.modules, "leco_plugin.samplers.kernels.gate_kernel", kernel)
    for _ in range(2):
        asked.occupied(torch.rand(50, 3))
    assert sizes == [fused.COMPARED, 50, 50]
    asked.threshold_value.fill_(0.25)
    asked.occupied(torch.rand(50, 3))
    assert sizes[3:] == [fused.COMPARED, 50]


def test_kernels_are_launched_where_their_tensors_are() -> None:
    there = fused.on(torch.device("cuda", 1))
    assert isinstance(there, torch.cuda.device) and there.idx == 1


@pytest.mark.usefixtures("on_any_device")
def test_positions_on_another_device_are_no_failure_of_a_kernel(steep, monkeypatch) -> None:
    elsewhere = torch.device("meta")
    assert fused.decide(steep.occupancy, torch.empty(9, 3, device=elsewhere)) is None
    rays = Rays(*(torch.empty(shape, device=elsewhere) for shape in ((9, 3), (9, 3), 9, 9)))
    assert fused.march(steep.occupancy, steep.cache, rays, March(0.1)) is None
    assert not fused._off


@pytest.mark.usefixtures("on_any_device")
@pytest.mark.parametrize("dtype", [torch.float64, torch.float16])
def test_positions_that_are_not_in_float32_are_left_to_torch(dtype, steep, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "leco_plugin.samplers.kernels.gate_kernel", None)
    places, occupancy = torch.rand(50, 3, dtype=dtype), steep.occupancy
    assert torch.equal(occupancy.occupied(places), occupancy.query(places) >= occupancy.threshold)
    assert not fused._off


@pytest.mark.usefixtures("on_any_device")
@pytest.mark.parametrize("cone_angle", [0.0, 0.01])
def test_rays_in_double_are_left_to_torch(cone_angle: float, steep, monkeypatch) -> None:
    torch.manual_seed(0)
    right_gate(steep, monkeypatch)
    monkeypatch.setitem(sys.modules, "leco_plugin.samplers.kernels.march_kernel", None)
    rays = torch.rand(9, 3).double(), torch.randn(9, 3).double()
    options = {"render_step_size": 0.05, "cone_angle": cone_angle, "far_plane": 4.0}
    samples = steep.sampling(*rays, **options)
    with fused.twins_only():
        wanted = steep.sampling(*rays, **options)
    assert len(samples[0]) > 0 and samples[1].dtype == torch.float64
    assert all(map(torch.equal, samples, wanted)) and not fused._off


def test_rays_without_an_end_are_no_failure_of_a_kernel() -> None:
    def endless() -> None:
        raise TooManyCandidates("over 2^24 steps")

    with pytest.raises(ValueError, match="over 2"):
        fused.attempt("march", endless, torch.device("cpu"))
    assert not fused._off


def test_twins_only_is_over_afterwards() -> None:
    with fused.twins_only():
        assert fused._off
    assert not fused._off


def test_what_had_failed_before_twins_only_stays_off(monkeypatch) -> None:
    monkeypatch.setattr(fused, "_off", {"march"})
    with fused.twins_only():
        assert fused._off == {"gate", "march"}
    assert fused._off == {"march"}


@pytest.mark.gpu
def test_sampling_waits_once_for_the_device() -> None:
    made = LearnedOccupancyEstimator(copy.deepcopy(ball()).cuda(), tolerance=0.02)
    rays = torch.rand(64, 3, device="cuda"), torch.randn(64, 3, device="cuda")
    options = {"render_step_size": 0.05, "far_plane": 4.0}
    made.sampling(*rays, **options)  # compiled, and tried
    assert fused.is_ready(made.device, "march")
    torch.cuda.set_sync_debug_mode("warn")
    try:
        with pytest.warns(UserWarning, match="synchronizing") as said:
            made.sampling(*rays, **options)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert len(said) == 1


def test_gates_on_frequencies_have_a_kernel() -> None:
    occupancy = Occupancy(Gate(GateConfig(ENCODINGS["frequency"])), Space(), 0.5)
    assert why_not(occupancy) is None and fused.weights_of(occupancy) is not None


@pytest.mark.usefixtures("on_any_device")
@pytest.mark.parametrize("kind", sorted(ENCODINGS.keys() - {"frequency"}))
def test_gates_on_tables_are_left_to_torch_with_a_reason(
    kind: str, steep, monkeypatch, caplog
) -> None:
    for name in ("gate_kernel", "march_kernel"):
        monkeypatch.setitem(sys.modules, f"leco_plugin.samplers.kernels.{name}", None)
    asked = Occupancy(Gate(GateConfig(ENCODINGS[kind])), Space(), 0.5)
    places = torch.rand(50, 3)
    rays = Rays(places, torch.randn(50, 3), torch.zeros(50), torch.ones(50))
    with caplog.at_level(logging.INFO, fused.__name__):
        assert fused.decide(asked, places) is None
        assert fused.march(asked, steep.cache, rays, March(0.1)) is None
        assert torch.equal(asked.occupied(places), asked.query(places) >= asked.threshold_value)
    reason = f"its gate has {kind} features; the kernel knows frequencies only"
    assert why_not(asked) == reason
    assert [entry.getMessage() for entry in caplog.records] == [f"no fused gate: {reason}"]
    assert not fused._off


@pytest.mark.parametrize(
    ("sizes", "reason"),
    [
        ({"width": 512}, "width 512; the kernel holds 256"),
        ({"layers": 9}, "layers 9; the kernel holds 8"),
        ({"encoding": EncodingConfig(octaves=21)}, "frequency features 66; the kernel holds 64"),
        ({"scene_experts": 64}, "logits 65; the kernel holds 64"),
    ],
)
def test_gates_that_do_not_fit_are_named(sizes, reason: str) -> None:
    occupancy = Occupancy(Gate(GateConfig(**sizes)), Space(), 0.5)
    found = why_not(occupancy)
    assert found is not None and reason in found


def test_each_card_gets_the_widths_that_were_compiled_for_it(monkeypatch) -> None:
    def left_to_torch(capability: tuple[int, int], width: int, precision: str) -> bool:
        monkeypatch.setattr(torch.cuda, "get_device_capability", lambda *_: capability)
        asked = Occupancy(Gate(GateConfig(width=width)), Space(), 0.5, precision)
        return fused._why_not(asked, torch.device("cuda")) is not None

    assert not left_to_torch((9, 0), 256, "bfloat16")
    for capability in ((8, 0), (8, 9), (10, 0)):
        assert left_to_torch(capability, 256, "bfloat16")
        assert not left_to_torch(capability, 128, "bfloat16")
    assert left_to_torch((9, 0), 128, "float32") and not left_to_torch((9, 0), 64, "float32")
    assert left_to_torch((7, 5), 16, "bfloat16")


def test_a_gate_in_float16_stays_with_torch() -> None:
    occupancy = Occupancy(Gate(GateConfig()), Space(), 0.5, "float16")
    assert why_not(occupancy) == "its gate is asked in float16"


def test_what_is_no_occupancy_of_ours_stays_with_torch() -> None:
    assert why_not(object()) == "it has no gate of this package"
    assert fused.weights_of(torch.nn.Module()) is None


def test_weights_are_packed_anew_only_when_the_gate_changes() -> None:
    occupancy = Occupancy(Gate(GateConfig()), Space(), 0.5)
    packed = fused.weights_of(occupancy)
    assert fused.weights_of(occupancy) is packed
    occupancy.threshold_value.fill_(0.25)
    renewed = fused.weights_of(occupancy)
    assert renewed is not None and float(renewed.facts[10]) == 0.25
    with torch.no_grad():
        occupancy.gate.head.bias.add_(1.0)
    assert fused.weights_of(occupancy) is not renewed


def test_a_new_threshold_at_the_address_of_the_old_one_is_noticed() -> None:
    occupancy = Occupancy(Gate(GateConfig()), Space(), 0.5)
    for value in (0.125, 0.25, 0.375, 0.75):
        del occupancy.threshold_value
        occupancy.register_buffer("threshold_value", torch.tensor(value))
        packed = fused.weights_of(occupancy)
        assert packed is not None and float(packed.facts[10]) == value


def logits_by_hand(weights: GateWeights, features: torch.Tensor) -> torch.Tensor:
    """What the kernel computes behind the hidden layers, from its last matrix and vectors."""
    size = weights.padded_width * weights.padded_logits
    last = weights.matrices.float()[-size * (1 + weights.half) :].view(-1, weights.padded_logits)
    last = last.view(1 + weights.half, -1, weights.padded_logits).sum(dim=0)
    totals, constants = weights.vectors[-2 * weights.padded_logits :].view(2, -1)
    mean = features.mean(dim=1, keepdim=True)
    spread = (features.var(dim=1, unbiased=False, keepdim=True) + weights.facts[11]).rsqrt()
    padded = torch.nn.functional.pad(features, (0, weights.padded_width - weights.width))
    return ((padded @ last - mean * totals) * spread + constants)[:, : weights.logits]


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_the_norm_folds_into_the_last_layer(precision) -> None:
    gate = Gate(GateConfig(width=40))
    torch.nn.init.normal_(gate.norm.weight)
    torch.nn.init.normal_(gate.norm.bias)
    weights = gate_weights(Occupancy(gate, Space(), 0.5, precision))
    features = torch.rand(30, 40)
    expected = gate.head(gate.norm(features))
    torch.testing.assert_close(logits_by_hand(weights, features), expected, rtol=1e-4, atol=1e-4)


def test_packing_within_a_hosts_autocast_rounds_nothing() -> None:
    occupancy = Occupancy(Gate(GateConfig()), Space(), 0.5)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        within = gate_weights(occupancy)
    for one, other in zip(within[:3], gate_weights(occupancy)[:3]):
        assert torch.equal(one, other)


@pytest.mark.parametrize("cone_angle", [1e-3, 1.0 / 256.0, 0.5])
def test_the_powers_reach_as_far_as_a_float_can(cone_angle: float) -> None:
    t_mins, t_maxs = torch.tensor([0.0, 3.0]), torch.full((2,), 1e30)
    counts = candidate_counts(t_mins, t_maxs, 0.01, cone_angle)
    n_linear, _ = switch(t_mins, 0.01, cone_angle)
    assert float((counts + 1.0 - n_linear).max()) < powers_needed(0.01, cone_angle)
    table = growth_table(0.01, cone_angle, torch.device("cpu"))
    assert len(table) == powers_needed(0.01, cone_angle)
    assert float(table[0]) == 1.0
