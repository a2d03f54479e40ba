"""A collapse is found within 200 steps, healed by the stated rule, three times at most."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from leco_plugin.learning.collapse import (
    EASED,
    MOST_RECOVERIES,
    Collapse,
    action_on,
    annealed,
    find_collapse,
    form_of,
    heal,
    is_dense,
    is_restart_due,
    look,
    reset_gate_head,
    spread_scene_experts,
)
from leco_plugin.learning.run import Progress
from leco_plugin.models.gate import occupancy_from_logits
from leco_plugin.models.losses import expert_shares
from leco_plugin.models.objective import GateLossConfig

SPREAD = torch.tensor([0.5, 0.25, 0.25])
ONE = torch.tensor([0.5, 0.5, 0.0])


LOSSES, PAPER = GateLossConfig(), GateLossConfig(form="paper")


def head_of(bias: list[float]) -> torch.nn.Linear:
    head = torch.nn.Linear(4, 3)
    with torch.no_grad():
        head.bias.copy_(torch.tensor(bias))
    return head


def healed(
    kind: Any,
    progress: Progress,
    step: int,
    losses: GateLossConfig = LOSSES,
    shares: torch.Tensor = SPREAD,
    head: torch.nn.Linear | None = None,
) -> str:
    """What is said once a collapse of that kind, found at that step, is healed."""
    head = head_of([0.0] * 3) if head is None else head
    return heal(head, progress, Collapse("a cause", kind), shares, step, losses)


def test_a_collapse_must_last_unless_the_first_phase_is_over() -> None:
    progress = Progress()
    assert look(progress, 98, 0.0, SPREAD, last=True) is None  # too early to tell
    assert look(Progress(), 99, 0.0, SPREAD, last=True) is not None
    for step, known in ((398, False), (399, True)):  # of a gate that began anew
        found = look(Progress(began=300), step, 0.0, SPREAD, last=True)
        assert (found is not None) == known
    for fewest, has_learned in ((0.89, True), (0.9, False)):
        progress = Progress(fewest_kept=fewest)
        look(progress, 199, 1.0, SPREAD, last=False)
        assert progress.suspected_since == (199 if has_learned else -1)
    progress = Progress()
    for step in (199, 298):
        assert look(progress, step, 0.0, SPREAD, last=False) is None
    assert look(progress, 299, 0.0, SPREAD, last=False) is not None
    assert look(Progress(), 299, 1.0, SPREAD, last=True) is not None
    assert look(progress, 324, 0.3, SPREAD, last=False) is None
    assert progress.suspected_since == -1


@pytest.mark.parametrize(("kind", "pull"), [("empty", 1.0 / EASED), ("occupied", EASED)])
def test_a_healed_gate_learns_on_dense_samples_first_and_under_less_pressure(kind, pull) -> None:
    progress = Progress(learn_steps=200, configured=200, suspected_since=90)
    head = head_of([30.0, 0.0, 0.0])
    said = healed(kind, progress, 199, head=head)
    assert not bool(head.bias.any()) and "dense samples to step 250" in said
    assert (progress.recoveries, progress.suspected_since) == (1, -1)
    assert (progress.learn_steps, progress.dense_until) == (300, 250)
    assert is_dense(progress, 249) and not is_dense(progress, 250)

    begins, half, ends = (annealed(LOSSES, progress, step) for step in (199, 224, 250))
    assert begins.contribution == begins.imbalance == begins.density == begins.agreement == 0.0
    for name in ("contribution", "agreement", "density"):
        assert getattr(half, name) == pytest.approx(25 / 51 * getattr(LOSSES, name))
        assert getattr(ends, name) == getattr(LOSSES, name)
    assert half.imbalance == pytest.approx(25 / 51 * pull * LOSSES.imbalance)
    assert half.balance == LOSSES.balance  # which nothing is wrong with
    assert ends.imbalance == pytest.approx(pull * LOSSES.imbalance)
    assert ends.emphasis == pytest.approx(LOSSES.emphasis / pull)
    assert ends.balance == LOSSES.balance


@pytest.mark.parametrize("last", [False, True])
def test_after_all_recoveries_only_a_gate_that_keeps_nothing_ends_the_run(last: bool) -> None:
    progress = Progress(learn_steps=200, recoveries=MOST_RECOVERIES)
    actions = {"empty": "give up", "occupied": "leave for good", "one expert": "leave for good"}
    for kind, action in actions.items():
        assert action_on(Collapse("a cause", kind), progress, last, room=1000.0) == action  # type: ignore[arg-type]


def test_a_form_that_was_given_up_stays_given_up() -> None:
    progress = Progress(learn_steps=200)
    healed("useless", progress, 199, PAPER)
    assert form_of(PAPER, progress) == "logit"
    healed("occupied", progress, 299, PAPER)
    assert form_of(PAPER, progress) == "logit" and progress.pace == 0.25
    kept_to = annealed(replace(PAPER, fall_back=False), Progress(pull=4.0, paper_given_up=True), 0)
    assert kept_to.imbalance == 4.0 * PAPER.imbalance  # what its own recoveries have earned


@pytest.mark.parametrize(("step", "learn_to"), [(150, 201), (120, 200)])
def test_points_of_one_expert_are_shared_out_and_the_balance_counts_more(
    step: int, learn_to: int
) -> None:
    progress, head = Progress(learn_steps=200, configured=200), head_of([0.0, 30.0, 0.0])
    healed("one expert", progress, step, shares=ONE, head=head)
    assert (head.bias[1] - head.bias[2]).abs() < 1e-6
    assert progress.learn_steps == learn_to and not is_dense(progress, step + 1)
    assert annealed(LOSSES, progress, step + 1).balance == EASED * LOSSES.balance
    assert not is_restart_due(Collapse("a cause", "empty"), LOSSES, progress)  # no new last layer


def test_a_gate_in_the_papers_form_that_less_force_does_not_heal_is_taught_in_logit_form() -> None:
    progress, head = Progress(learn_steps=200), head_of([0.0] * 3)
    for number in range(2):
        assert form_of(PAPER, progress) == "paper"
        said = healed("occupied", progress, 199 + number, PAPER, head=head)
        assert ("logit form" in said) == (number == 1)
    taught = annealed(PAPER, progress, 10_000)
    assert taught == replace(PAPER, form="logit")  # nothing of what was wrong is eased or pressed
    again = Progress.from_dict(progress.to_dict())
    assert form_of(PAPER, again) == "logit" and form_of(LOSSES, Progress()) == "logit"
    assert form_of(replace(PAPER, fall_back=False), again) == "paper"
    said = healed("occupied", progress, 299, PAPER, head=head)
    assert "gate and field start anew" in said  # what is left for one that collapses in logit form


def test_a_recovery_adds_to_those_before_and_is_as_long_as_the_phase_was() -> None:
    """200 steps are configured, of which a short run has 120."""
    progress = Progress(learn_steps=120, configured=200, phase=120, pull=2.0, balance=2.0)
    healed("empty", progress, 99)
    assert (progress.learn_steps, progress.dense_until) == (160, 130)
    healed("one expert", progress, 149, shares=ONE)
    assert progress.learn_steps == 180
    assert (progress.pull, progress.balance) == (2.0 / EASED, 2.0 * EASED)


def test_a_new_or_healed_gate_has_until_the_end_to_call_something_empty() -> None:
    progress = Progress()
    for step in range(49, 999, 50):
        assert look(progress, step, 1.0, SPREAD, last=False) is None
    assert look(progress, 999, 1.0, SPREAD, last=True) is not None
    progress = Progress(learn_steps=200, configured=200)
    assert look(progress, 99, 0.3, SPREAD, last=False) is None  # it has called much empty
    healed("empty", progress, 149)
    for step in range(199, 999, 50):
        assert look(progress, step, 1.0, SPREAD, last=False) is None


def test_a_second_recovery_counts_whatever_it_is_from() -> None:
    progress = Progress(learn_steps=200)
    for kind in ("empty", "one expert"):
        said = healed(kind, progress, 199, PAPER, ONE)
    assert form_of(PAPER, progress) == "logit" and "logit form" in said


def test_a_comparison_and_a_run_that_was_never_healed_keep_what_is_configured() -> None:
    losses, progress = replace(PAPER, fall_back=False), Progress(learn_steps=200)
    for number in range(MOST_RECOVERIES):
        healed("occupied", progress, number, losses)
    assert form_of(losses, progress) == "paper"
    assert annealed(LOSSES, Progress(), 0) == LOSSES


@pytest.mark.parametrize(
    ("learned", "healed_at", "step", "then"),
    [(20_000, None, 19_000, (19_101, 19_051)), (200, 50, 199, (400, 250))],
    ids=["as quickly as an early one", "anew, a quarter on dense samples"],
)
def test_a_gate_that_was_opened_late_or_begins_anew_is_healed(learned, healed_at, step, then):
    progress = Progress(learn_steps=learned, configured=200)
    if healed_at is not None:
        progress.healed_at = healed_at
    healed("empty", progress, step)
    assert (progress.learn_steps, progress.dense_until) == then


@pytest.mark.parametrize(
    ("kept", "shares", "has_learned", "cause"),
    [
        (0.0, [1.0, 0.0, 0.0], False, "all space empty"),
        (1.0, [0.0, 0.5, 0.5], True, "all space occupied"),
        (0.3, [0.7, 0.0, 0.3], False, "scene expert 2 takes all points"),
        (0.3, [0.7, 0.2, 0.1], True, None),
        (1.0, [0.0, 0.5, 0.5], False, None),  # it has not learned enough yet
        (0.3, [0.7, 0.3], True, None),  # there is only one scene expert
        (1.9e-4, [1.0, 0.0, 0.0], False, "all space empty"),
        (2.1e-4, [1.0, 0.0, 0.0], False, None),
        (0.9996, [0.0, 0.5, 0.5], True, "all space occupied"),
        (0.9994, [0.0, 0.5, 0.5], True, None),
        (0.3, [0.5, 0.4996, 0.0004], True, "scene expert 1 takes all points"),
        (0.3, [0.5, 0.4994, 0.0006], True, None),
        (0.3, [0.989, 0.0, 0.011], True, "scene expert 2 takes all points"),
        (0.3, [0.991, 0.0, 0.009], True, None),  # too few to say so
    ],
)
def test_a_collapse_is_named(kept: float, shares: list[float], has_learned: bool, cause) -> None:
    found = find_collapse(kept, torch.tensor(shares), has_learned)
    assert (found is None) == (cause is None)
    assert found is None or (cause in found.cause and "\n" not in found.cause)


def test_a_reset_gate_is_undecided_again() -> None:
    torch.manual_seed(0)
    head = torch.nn.Linear(64, 5)
    torch.nn.init.constant_(head.bias, 40.0)
    reset_gate_head(head)
    features = torch.nn.functional.layer_norm(torch.randn(1000, 64), (64,))
    probabilities = head(features).detach().softmax(dim=-1)
    assert not bool(head.bias.any())
    assert float(probabilities.mean(dim=0).min()) > 0.05
    assert float(head(features).detach().std()) == pytest.approx(0.05 * 64**0.5, rel=0.2)
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
