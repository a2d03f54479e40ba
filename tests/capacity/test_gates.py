"""Claims about gates of growing size, and about teaching a gate alone."""

from __future__ import annotations

import pytest
import torch
from ball_occupancy import ENCODINGS

from leco_plugin.capacity.choice import NAMES
from leco_plugin.capacity.gates import (
    Lesson,
    gates,
    grids,
    ladder,
    name_of,
    round_weights,
    teach,
    values_of,
)
from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.gate import Gate, GateConfig, check_sizes, occupancy_logit
from leco_plugin.models.losses import contribution_loss


def ball_lesson(count: int = 40_000) -> Lesson:
    mapped = 2.0 * torch.rand(count, 3, generator=torch.Generator().manual_seed(0)) - 1.0
    inside = (mapped.norm(dim=-1) < 0.6).float()
    return Lesson(mapped, inside, 1.0 - inside)


@pytest.mark.parametrize("kind", ENCODINGS)
def test_every_kind_of_gate_learns_a_ball(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("leco_plugin.capacity.gates.BATCH", 2048)
    lesson = ball_lesson()
    shares: list[float] = []
    config = GateConfig(ENCODINGS[kind], 16, 1, 1)
    gate = teach(config, lesson, 120, "float32", on_progress=shares.append)
    kept = occupancy_logit(gate(lesson.mapped)) >= 0.0
    assert float((kept == (lesson.keep > 0)).float().mean()) > 0.96
    assert len(shares) == 120 and shares[-1] == 1.0
    assert not any(parameter.requires_grad for parameter in gate.parameters())


def test_the_loss_is_the_contribution_loss() -> None:
    """What `teach` minimises, with the targets of `leco-occupancy`, is its gate's own loss."""
    torch.manual_seed(0)
    logits, weights = torch.randn(100, 2), 0.3 * torch.rand(100)
    target = (weights / 0.15).clamp(max=1.0)
    occupied = occupancy_logit(logits)
    keep, skip = 8.0 * target, 1.0 - target
    softplus = torch.nn.functional.softplus
    found = (keep * softplus(-occupied) + skip * softplus(occupied)).mean()
    torch.testing.assert_close(found, contribution_loss(logits, weights, 0.15, 8.0))


def test_the_same_seed_gives_the_same_gate_and_leaves_other_dice_alone() -> None:
    config = GateConfig(EncodingConfig(octaves=2), 8, 1, 1)
    torch.manual_seed(3)
    before = torch.get_rng_state()
    first = teach(config, ball_lesson(1000), 3, "float32")
    assert torch.equal(torch.get_rng_state(), before)
    second = teach(config, ball_lesson(1000), 3, "float32")
    for a, b in zip(first.parameters(), second.parameters()):
        assert torch.equal(a, b)


def test_rounded_weights_are_held_by_bfloat16() -> None:
    gate = Gate(GateConfig()).requires_grad_(False)
    round_weights(gate)
    assert all(torch.equal(p, p.bfloat16().float()) for p in gate.parameters())


def test_it_goes_from_small_to_large_and_stays_below_the_original() -> None:
    gates = ladder(values_of(GateConfig()))
    sizes = [values_of(gate) for gate in gates]
    assert sizes == sorted(sizes) and sizes[0] < 300 and sizes[-1] < values_of(GateConfig())
    assert {gate.encoding.kind for gate in gates} == {"frequency", "hash", "vm", "k-planes"}
    assert len({name_of(gate) for gate in gates}) == len(gates)


def test_gates_of_few_octaves_on_hash_grids_and_on_planes_have_a_norm() -> None:
    for gate in ladder(10**9):
        many = gate.encoding.kind == "frequency" and gate.encoding.octaves >= 5
        assert gate.normed == (not many)


def test_gates_on_hash_grids_are_those_of_the_capacity_page_and_below() -> None:
    tables = [gate for gate in ladder(10**9) if gate.encoding.kind == "hash"]
    measured = [candidate.gate for candidate in gates() if candidate.family == "hash"]
    assert [gate.encoding.log2_table for gate in tables] == [6, 7, 8]
    assert tables[-1] == measured[0]


def test_each_can_be_built_and_saved() -> None:
    for gate in ladder(10**9):
        check_sizes(gate)
        assert values_of(gate) == sum(p.numel() for p in Gate(gate).parameters())


def test_every_family_grows() -> None:
    candidates = gates() + grids((64, 32))
    assert {candidate.family for candidate in candidates} == set(NAMES)
    assert len({candidate.key for candidate in candidates}) == len(candidates)
    for family in NAMES:
        sizes = [candidate.bytes for candidate in candidates if candidate.family == family]
        assert sizes == sorted(sizes) and sizes[-1] > 2 * sizes[0]
    assert grids((32,))[0].bytes == 32**3 / 8
    for candidate in gates():
        assert candidate.gate is not None
        check_sizes(candidate.gate)
