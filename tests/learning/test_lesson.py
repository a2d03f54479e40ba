"""Claims about teaching a gate alone."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from ball_occupancy import ENCODINGS

from leco_plugin.learning.sharpening import Lesson, lesson_from_weights, round_weights, teach
from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.gate import Gate, GateConfig, occupancy_logit
from leco_plugin.models.losses import contribution_loss
from leco_plugin.models.objective import GateLossConfig


def ball_lesson(count: int = 40_000) -> Lesson:
    mapped = 2.0 * torch.rand(count, 3, generator=torch.Generator().manual_seed(0)) - 1.0
    inside = (mapped.norm(dim=-1) < 0.6).float()
    return Lesson(mapped, inside, 1.0 - inside)


@pytest.mark.parametrize("kind", ENCODINGS)
def test_every_kind_of_gate_learns_a_ball(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("leco_plugin.learning.sharpening.BATCH", 2048)
    lesson = ball_lesson()
    shares: list[float] = []
    config = GateConfig(ENCODINGS[kind], 16, 1, 1)
    gate = teach(config, lesson, 120, "float32", on_progress=shares.append)
    kept = occupancy_logit(gate(lesson.mapped)) >= 0.0
    assert float((kept == (lesson.keep > 0)).float().mean()) > 0.96
    assert len(shares) == 120 and shares[-1] == 1.0
    assert not any(parameter.requires_grad for parameter in gate.parameters())


def test_the_seed_decides_the_gate_and_other_dice_are_left_alone() -> None:
    config, lesson = GateConfig(EncodingConfig(octaves=2), 8, 1, 1), ball_lesson(1000)
    before = torch.random.manual_seed(3).get_state()
    first, again, other = (teach(config, lesson, 3, "float32", seed) for seed in (0, 0, 1))
    assert torch.equal(torch.get_rng_state(), before)
    assert all(map(torch.equal, first.parameters(), again.parameters()))
    assert not torch.equal(first.head.weight, other.head.weight)
    begun = (teach(config, ball_lesson(1), 1, "float32", seed).head.weight for seed in (0, 1))
    assert not torch.equal(*begun)


@pytest.mark.parametrize(("kind", "first"), [("frequency", [0.01]), ("hash", [0.01, 0.02])])
def test_rates_fall_by_a_half_cosine_to_a_twentieth(
    kind: str, first: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Tables have twice the rate of networks."""
    rates: list[list[float]] = []

    class Adam(torch.optim.Adam):
        def step(self, *_: Any) -> None:
            rates.append([group["lr"] for group in self.param_groups])

    monkeypatch.setattr(torch.optim, "Adam", Adam)
    teach(GateConfig(ENCODINGS[kind], 8, 1, 1), ball_lesson(10), 4, "float32")
    cosines = [1.0, 0.5**0.5, 0.0, -(0.5**0.5)]
    expected = [0.05 + 0.95 * 0.5 * (1.0 + cosine) for cosine in cosines]
    for share, found in zip(expected, rates, strict=True):
        assert found == pytest.approx([share * rate for rate in first])


def test_rounded_weights_are_held_by_bfloat16() -> None:
    gate = Gate(GateConfig()).requires_grad_(False)
    round_weights(gate)
    assert all(torch.equal(p, p.bfloat16().float()) for p in gate.parameters())


def test_the_targets_of_a_lesson_are_those_of_the_contribution_loss() -> None:
    """Of two rays, whose neighbours share the larger weight and whose ends do not."""
    losses = GateLossConfig(weight_at_full=0.2, emphasis=6.0)
    weights = torch.tensor([0.0, 0.04, 0.01, 0.0, 0.3, 0.1])
    of_rays = torch.tensor([0, 0, 0, 1, 1, 1])
    wide = torch.tensor([0.04, 0.04, 0.04, 0.3, 0.3, 0.3])
    lesson = lesson_from_weights(torch.zeros(6, 3), weights, of_rays, losses)
    target = torch.tensor([0.2, 0.2, 0.2, 1.0, 1.0, 1.0])
    torch.testing.assert_close(lesson.keep, 6.0 * target)
    torch.testing.assert_close(lesson.skip, 1.0 - target)
    logits = torch.randn(6, 3)
    occupied, softplus = occupancy_logit(logits), torch.nn.functional.softplus
    found = (lesson.keep * softplus(-occupied) + lesson.skip * softplus(occupied)).mean()
    torch.testing.assert_close(found, contribution_loss(logits, wide, 0.2, 6.0))
