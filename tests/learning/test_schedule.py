"""When the first phase ends, and what counts as a collapse."""

from __future__ import annotations

from itertools import pairwise

import pytest
import torch

from leco_plugin.models.gate import occupancy_from_logits
from leco_plugin.learning.schedule import (
    ScheduleConfig,
    converged,
    decisions_agree,
    find_collapse,
    is_unsettled,
    ramp,
    reset_gate_head,
    spread_scene_experts,
)
from leco_plugin.models.losses import expert_shares

SCHEDULE = ScheduleConfig(learn_steps=1000, earliest=0.5, ramp_from=0.2, ramp_to=0.6)


def test_the_ramp_rises_from_zero_to_one_between_its_ends() -> None:
    values = [ramp(step, SCHEDULE) for step in range(1000)]
    assert values[:201] == [0.0] * 201 and values[600:] == [1.0] * 400
    assert all(before < after for before, after in pairwise(values[200:601]))


@pytest.mark.parametrize("learn_steps", [1, 2, 10])
def test_the_ramp_of_a_short_run_stays_between_zero_and_one(learn_steps: int) -> None:
    values = [ramp(step, ScheduleConfig(learn_steps=learn_steps)) for step in range(20)]
    assert values == sorted(values) and values[-1] == 1.0 and min(values) >= 0.0


def test_a_gate_is_frozen_when_its_decisions_have_settled_but_not_too_early() -> None:
    assert not converged(498, 1.0, SCHEDULE)
    assert converged(499, 1.0, SCHEDULE)
    assert not converged(499, SCHEDULE.agreement - 1e-3, SCHEDULE)


def test_a_gate_is_frozen_at_the_step_limit_whatever_it_decides() -> None:
    assert converged(999, 0.0, SCHEDULE)


def test_a_gate_that_changes_its_mind_at_the_step_limit_learns_on_twice() -> None:
    below = SCHEDULE.settled - 1e-3
    assert [is_unsettled(999, below, SCHEDULE, times) for times in range(4)] == [
        *(True, True, False, False)
    ]
    assert not is_unsettled(999, SCHEDULE.settled, SCHEDULE, 0)
    assert not is_unsettled(4 * SCHEDULE.steps_per_check - 2, below, SCHEDULE, 0)  # a short run


def test_agreement_is_the_share_of_equal_decisions() -> None:
    before = torch.tensor([True, True, False, False])
    assert decisions_agree(before, torch.tensor([True, False, False, False])) == 0.75
    assert decisions_agree(before, before) == 1.0
    assert decisions_agree(torch.zeros(0, dtype=torch.bool), before) == 0.0


@pytest.mark.parametrize(
    ("kept", "shares", "has_learned", "cause"),
    [
        (0.0, [1.0, 0.0, 0.0], False, "all space empty"),
        (1.0, [0.0, 0.5, 0.5], True, "all space occupied"),
        (0.3, [0.7, 0.0, 0.3], False, "scene expert 2 takes all points"),
    ],
)
def test_a_collapse_is_named(kept: float, shares: list[float], has_learned: bool, cause) -> None:
    collapse = find_collapse(kept, torch.tensor(shares), has_learned)
    assert collapse is not None and cause in collapse.cause and "\n" not in collapse.cause


@pytest.mark.parametrize(
    ("kept", "shares", "has_learned"),
    [
        (0.3, [0.7, 0.2, 0.1], True),
        (1.0, [0.0, 0.5, 0.5], False),  # it has not learned enough yet
        (0.3, [0.7, 0.3], True),  # there is only one scene expert
    ],
)
def test_a_gate_that_decides_has_not_collapsed(kept: float, shares, has_learned: bool) -> None:
    assert find_collapse(kept, torch.tensor(shares), has_learned) is None


def test_a_reset_gate_is_undecided_again() -> None:
    torch.manual_seed(0)
    head = torch.nn.Linear(64, 5)
    torch.nn.init.constant_(head.bias, 40.0)
    reset_gate_head(head)
    features = torch.nn.functional.layer_norm(torch.randn(1000, 64), (64,))
    probabilities = head(features).detach().softmax(dim=-1)
    assert not bool(head.bias.any())
    assert float(probabilities.mean(dim=0).min()) > 0.05
    assert head.weight.requires_grad


def test_sharing_out_one_experts_points_leaves_the_occupancy_as_it_was() -> None:
    torch.manual_seed(0)
    head = torch.nn.Linear(16, 5)
    with torch.no_grad():
        head.bias[3] = head.bias[0] = 20.0
    features = torch.randn(500, 16)
    before = occupancy_from_logits(head(features))
    spread_scene_experts(head, 3)
    after = head(features)
    assert (occupancy_from_logits(after) - before).abs().mean() < 0.03
    shares = expert_shares(after[:, 1:].argmax(dim=-1), 4)
    assert float(shares.max()) < 0.8
