"""A collapse is found within 200 steps, healed by the stated rule, three times at most."""

from __future__ import annotations

import copy
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.failures import GateCollapsed
from leco_plugin.models.field import FieldConfig, HMoEField
from leco_plugin.models.gate import Gate, GateConfig
from leco_plugin.models.learning import lifecycle
from leco_plugin.models.learning.healing import (
    EASED,
    MOST_RECOVERIES,
    annealed,
    form_of,
    heal,
    is_collapsed,
    is_dense,
    starts_anew,
)
from leco_plugin.models.learning.lifecycle import Lifecycle
from leco_plugin.models.learning.phases import Collapse, ScheduleConfig
from leco_plugin.models.learning.progress import Progress
from leco_plugin.models.objective import GateLossConfig

SPREAD = torch.tensor([0.5, 0.25, 0.25])
ONE = torch.tensor([0.5, 0.5, 0.0])


@pytest.mark.parametrize("per_check", [25, 500])
@pytest.mark.parametrize("starts", [130, 149, 1000, 1399])
@pytest.mark.parametrize(
    ("looks", "cause"),
    [
        ([[20.0, 0.0, 0.0]], "calls all space empty"),
        ([[20.0, 0.0, 0.0], [0.0, 20.0, 0.0]], "scene expert 1 takes all"),
        ([[0.0, 20.0, 0.0], [0.0, 0.0, 20.0]], "calls all space occupied"),
    ],
)
def test_a_collapse_is_found_within_200_steps_of_its_start(
    looks: list[list[float]], cause: str, starts: int, per_check: int, healthy_run, capsys
) -> None:
    run = healthy_run(ScheduleConfig(learn_steps=2000, steps_per_check=per_check))
    for step in range(2000):
        if step == starts:
            run.looks = torch.tensor(looks).repeat(50, 1)
        run.lifecycle.before_step(step)
        run.lifecycle.after_step(step)
        if run.lifecycle.progress.recoveries:
            break
    assert starts + 95 <= step < starts + 200
    said = " ".join(capsys.readouterr().out.split())
    assert f"step {step}: " in said and cause in said and "(recovery" in said


def test_a_gate_that_recovers_by_itself_is_left_alone(healthy_run) -> None:
    run = healthy_run(ScheduleConfig(learn_steps=2000))
    for step in range(1000):
        gone = 300 <= step < 380
        run.looks = run.empty if gone else run.sound
        run.lifecycle.before_step(step)
        run.lifecycle.after_step(step)
        assert (run.lifecycle.progress.suspected_since >= 0) == (324 <= step < 399)
    assert run.lifecycle.progress.recoveries == 0


def test_a_gate_that_collapses_again_and_again_ends_the_run_in_one_line(healthy_run) -> None:
    run = healthy_run(ScheduleConfig(learn_steps=400))
    run.looks = run.empty
    with pytest.raises(GateCollapsed, match=r"step \d+: the gate calls .* 3 recoveries") as caught:
        for step in range(10_000):
            run.lifecycle.before_step(step)
            run.lifecycle.after_step(step)
    assert "\n" not in str(caught.value)
    assert run.lifecycle.progress.recoveries == 3


def test_a_gate_that_keeps_everything_after_three_recoveries_is_frozen_all_the_same(
    healthy_run, monkeypatch: pytest.MonkeyPatch
) -> None:
    frozen: list[int] = []
    monkeypatch.setattr(lifecycle, "freeze", freezing_at(frozen, 0.5))
    run = healthy_run(ScheduleConfig(learn_steps=200))
    run.looks = torch.tensor([[0.0, 20.0, 20.0 - 1e-3]]).expand(100, 3)
    for step in range(10_000):
        run.lifecycle.before_step(step)
        run.lifecycle.after_step(step)
        if frozen:
            break
    assert run.lifecycle.progress.recoveries == 3


@pytest.mark.parametrize(
    ("losses", "skipped", "recoveries"),
    [
        (GateLossConfig(form="paper"), 0.0, 1),
        (GateLossConfig(form="paper"), 0.04, 1),
        (GateLossConfig(form="paper"), 0.3, 0),
        (GateLossConfig(form="paper", fall_back=False), 0.0, 0),
        (GateLossConfig(), 0.0, 0),
    ],
)
def test_a_gate_in_the_papers_form_by_which_hardly_anything_is_skipped_is_taught_otherwise(
    losses: GateLossConfig, skipped: float, recoveries: int, healthy_run, monkeypatch, capsys
) -> None:
    frozen: list[int] = []
    monkeypatch.setattr(lifecycle, "freeze", freezing_at(frozen, 0.0, skipped))
    run = healthy_run(ScheduleConfig(learn_steps=200))
    run.lifecycle.model.config.gate_loss = losses
    reopened: list[bool] = []
    run.lifecycle.model.reopen = lambda: reopened.append(True)
    for step in range(1000):
        run.lifecycle.before_step(step)
        run.lifecycle.after_step(step)
        if len(frozen) > recoveries:
            break
    assert len(reopened) == run.lifecycle.progress.recoveries == recoveries
    assert frozen[-1] - frozen[0] <= 100
    said = "taught in logit form from now on" in " ".join(capsys.readouterr().out.split())
    assert said == bool(recoveries)


def freezing_at(steps: list[int], threshold: float, skipped: float = 0.8):
    """In place of `freeze`: notes the step, and finds this threshold, which skips so much."""

    def freeze(*arguments: object) -> SimpleNamespace:
        steps.append(arguments[4])
        return SimpleNamespace(threshold=threshold, empty_fraction=skipped)

    return freeze


@pytest.fixture
def healthy_run(monkeypatch: pytest.MonkeyPatch):
    """A lifecycle that looks at given logits, and nothing else of a run."""

    def make(schedule: ScheduleConfig) -> SimpleNamespace:
        gate = Gate(GateConfig(EncodingConfig(octaves=1), width=8, layers=1, scene_experts=2))
        sound = torch.tensor([[20.0, 0.0, 0.0], [0.0, 20.0, 0.0], [0.0, 0.0, 20.0]]).repeat(33, 1)
        run = SimpleNamespace(
            sound=sound, empty=torch.tensor([[20.0, 0.0, 0.0]]).expand(100, 3), looks=sound
        )
        run.lifecycle = object.__new__(Lifecycle)
        run.lifecycle.trainer, run.lifecycle.survey = None, None
        run.lifecycle.optimizers = [torch.optim.Adam(gate.parameters())]
        field = HMoEField(FieldConfig(EncodingConfig("hash", levels=1, log2_table=4)), 2)
        run.lifecycle.batches = SimpleNamespace(prepare=lambda learning: None)
        run.lifecycle.pipeline = SimpleNamespace(datamanager=SimpleNamespace(train_dataset=None))
        run.lifecycle.model = SimpleNamespace(
            config=SimpleNamespace(
                schedule=schedule,
                homogeneous=False,
                gate_loss=GateLossConfig(),
                termination=0.0,
                prior=SimpleNamespace(steps=0),
                sizes=SimpleNamespace(guided_batch=1.0),
            ),
            device=torch.device("cpu"),
            frozen=torch.tensor(False),
            learning_kept=1.0,
            gate=gate,
            field=field,
            num_train_data=2,
            routing=SimpleNamespace(empty_below=0.2),
            progress=Progress(learn_steps=schedule.learn_steps, configured=schedule.learn_steps),
        )
        return run

    def look(self: Lifecycle) -> torch.Tensor:
        return current[-1].looks

    current: list[SimpleNamespace] = []

    def making(schedule: ScheduleConfig) -> SimpleNamespace:
        current.append(make(schedule))
        return current[-1]

    monkeypatch.setattr(Lifecycle, "_probe", look)
    return making


def head_of(bias: list[float]) -> torch.nn.Linear:
    head = torch.nn.Linear(4, 3)
    with torch.no_grad():
        head.bias.copy_(torch.tensor(bias))
    return head


def test_a_collapse_must_last_unless_the_first_phase_is_over() -> None:
    progress = Progress()
    assert is_collapsed(progress, 98, 0.0, SPREAD, last=True) is None  # too early to tell
    assert is_collapsed(progress, 199, 0.0, SPREAD, last=False) is None
    assert is_collapsed(progress, 298, 0.0, SPREAD, last=False) is None
    assert is_collapsed(progress, 299, 0.0, SPREAD, last=False) is not None
    assert is_collapsed(Progress(), 299, 1.0, SPREAD, last=True) is not None
    assert is_collapsed(progress, 324, 0.3, SPREAD, last=False) is None
    assert progress.suspected_since == -1


@pytest.mark.parametrize(("kind", "pull"), [("empty", 1.0 / EASED), ("occupied", EASED)])
def test_a_healed_gate_learns_on_dense_samples_first_and_under_less_pressure(kind, pull) -> None:
    progress = Progress(learn_steps=200, configured=200, suspected_since=90)
    head, losses = head_of([30.0, 0.0, 0.0]), GateLossConfig()
    said = heal(head, progress, Collapse("a cause", kind), SPREAD, 199, losses)
    assert not bool(head.bias.any()) and "dense samples to step 250" in said
    assert (progress.recoveries, progress.suspected_since) == (1, -1)
    assert (progress.learn_steps, progress.dense_until) == (300, 250)
    assert is_dense(progress, 249) and not is_dense(progress, 250)

    begins, half, ends = (annealed(losses, progress, step) for step in (199, 224, 250))
    assert begins.contribution == begins.imbalance == begins.density == begins.agreement == 0.0
    assert half.contribution == pytest.approx(25 / 51 * losses.contribution)
    assert ends.contribution == losses.contribution and ends.density == losses.density
    assert ends.imbalance == pytest.approx(pull * losses.imbalance)
    assert ends.emphasis == pytest.approx(losses.emphasis / pull)
    assert ends.balance == losses.balance


def test_what_collapses_again_in_logit_form_is_learned_anew_and_more_slowly(
    healthy_run, monkeypatch
) -> None:
    run = healthy_run(ScheduleConfig(learn_steps=2000))
    gate, field = run.lifecycle.model.gate, run.lifecycle.model.field
    (optimizer,) = run.lifecycle.optimizers
    gate.hidden[0].weight.grad = torch.ones_like(gate.hidden[0].weight)
    optimizer.step()
    first = copy.deepcopy([gate.hidden[0].weight, field.state_dict()])
    shared: set[int] = set()
    note = shared.update
    monkeypatch.setattr(lifecycle, "share", lambda tensors: note(map(id, tensors)))
    run.looks = run.empty
    found = {}
    for step in range(1500):
        run.lifecycle.before_step(step)
        run.lifecycle.after_step(step)
        progress = run.lifecycle.progress
        if progress.recoveries in found:
            continue
        same = torch.equal(gate.hidden[0].weight, first[0])
        as_it_was = zip(field.state_dict().values(), first[1].values(), strict=True)
        assert all(torch.equal(a, b) for a, b in as_it_was) == bool(optimizer.state) == same
        found[progress.recoveries] = same, progress.pace
        if not same:
            assert {id(p) for p in (*gate.parameters(), *field.parameters())} <= shared
            assert progress.learn_steps == step + 1 + 2000  # all of it again
            assert progress.pull == 1.0 and progress.began == step + 1
            run.lifecycle.before_step(step + 1)
            assert run.lifecycle.model.ramped == 0.0
            assert vars(optimizer)["leco_pace"] == progress.pace
        if progress.recoveries == MOST_RECOVERIES:
            break
    # a new last layer is tried first
    assert list(found.values()) == [(True, 1.0), (True, 1.0), (False, 0.25), (False, 0.0625)]


@pytest.mark.parametrize(("end", "learns_to"), [(450, 450), (2000, 500), (380, 500)])
def test_what_is_healed_is_frozen_in_its_run_where_that_has_the_steps(
    healthy_run, end: int, learns_to: int
) -> None:
    run = healthy_run(ScheduleConfig(learn_steps=400))
    run.lifecycle.trainer = SimpleNamespace(
        _start_step=0,
        config=SimpleNamespace(max_num_iterations=end),
        optimizers=SimpleNamespace(optimizers={}),
    )
    run.lifecycle.healed(Collapse("a cause", "empty"), SPREAD, 299)
    assert run.lifecycle.progress.learn_steps == learns_to


def test_experts_that_were_dropped_stay_so_in_a_field_that_is_learned_anew(healthy_run) -> None:
    field = healthy_run(ScheduleConfig()).lifecycle.model.field
    made = object.__new__(Lifecycle)
    made.trainer, made.optimizers = None, []
    made.model = SimpleNamespace(field=field, num_train_data=2)
    field.experts.drop(1)
    before = list(field.parameters())
    made._restart_field()
    assert field.experts.left.tolist()[0] is False
    assert all(one is other for one, other in zip(field.parameters(), before, strict=True))


def test_a_form_that_was_given_up_stays_given_up() -> None:
    paper, progress = GateLossConfig(form="paper"), Progress(learn_steps=200)
    heal(head_of([0] * 3), progress, Collapse("a cause", "useless"), SPREAD, 199, paper)
    assert form_of(paper, progress) == "logit"
    heal(head_of([0] * 3), progress, Collapse("a cause", "occupied"), SPREAD, 299, paper)
    assert form_of(paper, progress) == "logit" and progress.pace == 0.25
    kept_to = annealed(replace(paper, fall_back=False), Progress(pull=4.0, paper_given_up=True), 0)
    assert kept_to.imbalance == 4.0 * paper.imbalance  # what its own recoveries have earned


def test_points_that_are_shared_out_are_no_new_last_layer() -> None:
    progress = Progress(learn_steps=200)
    heal(
        head_of([0, 9, 0]), progress, Collapse("a cause", "one expert"), ONE, 150, GateLossConfig()
    )
    assert not starts_anew(Collapse("a cause", "empty"), GateLossConfig(), progress)


def test_points_of_one_expert_are_shared_out_and_the_balance_counts_more() -> None:
    progress, head = Progress(learn_steps=200), head_of([0.0, 30.0, 0.0])
    heal(head, progress, Collapse("a cause", "one expert"), ONE, 150, GateLossConfig())
    assert (head.bias[1] - head.bias[2]).abs() < 1e-6
    assert progress.learn_steps == 200 and not is_dense(progress, 151)
    assert annealed(GateLossConfig(), progress, 151).balance == EASED * GateLossConfig().balance


def test_a_gate_in_the_papers_form_that_less_force_does_not_heal_is_taught_in_logit_form() -> None:
    paper, progress, head = (
        GateLossConfig(form="paper"),
        Progress(learn_steps=200),
        head_of([0] * 3),
    )
    for number in range(2):
        assert form_of(paper, progress) == "paper"
        said = heal(head, progress, Collapse("a cause", "occupied"), SPREAD, 199 + number, paper)
        assert ("logit form" in said) == (number == 1)
    taught = annealed(paper, progress, 10_000)
    assert taught == replace(paper, form="logit")  # nothing of what was wrong is eased or pressed
    again = Progress.from_dict(progress.to_dict())
    assert form_of(paper, again) == "logit" and form_of(GateLossConfig(), Progress()) == "logit"
    assert form_of(replace(paper, fall_back=False), again) == "paper"
    said = heal(head, progress, Collapse("a cause", "occupied"), SPREAD, 299, paper)
    assert "gate and field start anew" in said  # what is left for one that collapses in logit form


def test_a_gate_that_has_called_nothing_empty_yet_has_until_the_end_to_learn_it() -> None:
    progress = Progress()
    for step in range(49, 999, 50):
        assert is_collapsed(progress, step, 1.0, SPREAD, last=False) is None
    assert is_collapsed(progress, 999, 1.0, SPREAD, last=True) is not None


def test_a_second_recovery_counts_whatever_it_is_from() -> None:
    paper, progress = GateLossConfig(form="paper"), Progress(learn_steps=200)
    for kind in ("empty", "one expert"):
        said = heal(head_of([0] * 3), progress, Collapse("a cause", kind), ONE, 199, paper)
    assert form_of(paper, progress) == "logit" and "logit form" in said


def test_what_is_a_comparison_stays_in_the_form_that_is_asked_for() -> None:
    losses, progress = GateLossConfig(form="paper", fall_back=False), Progress(learn_steps=200)
    for number in range(MOST_RECOVERIES):
        heal(head_of([0] * 3), progress, Collapse("a cause", "occupied"), SPREAD, number, losses)
    assert form_of(losses, progress) == "paper"


def test_a_run_that_was_never_healed_is_taught_as_configured() -> None:
    assert annealed(GateLossConfig(), Progress(), 0) == GateLossConfig()


def test_a_gate_that_was_opened_again_late_is_healed_as_quickly_as_an_early_one() -> None:
    progress, head = Progress(learn_steps=20_000, configured=200), head_of([0.0, 0.0, 0.0])
    heal(
        head,
        progress,
        Collapse("the gate calls all space empty"),
        torch.ones(3) / 3,
        19_000,
        GateLossConfig(),
    )
    assert (progress.learn_steps, progress.dense_until) == (19_101, 19_051)
