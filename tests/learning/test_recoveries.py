"""What a run does about a gate that collapses, with the steps that it has."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.failures import GateCollapsed
from leco_plugin.models.field import FieldConfig, HMoEField
from leco_plugin.learning.freezing import FILE_NAME
from leco_plugin.models.gate import Gate, GateConfig
from leco_plugin.learning import learner, recoveries
from leco_plugin.learning.collapse import (
    MOST_RECOVERIES,
)
from leco_plugin.learning.learner import Lifecycle
from leco_plugin.learning.schedule import Collapse, ScheduleConfig
from leco_plugin.learning.progress import Progress
from leco_plugin.models.objective import GateLossConfig

SPREAD = torch.tensor([0.5, 0.25, 0.25])


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
        list(steps_of(run, 10_000))
    assert "\n" not in str(caught.value)
    assert run.lifecycle.progress.recoveries == 3


def test_a_gate_that_keeps_everything_after_three_recoveries_is_frozen_all_the_same(
    healthy_run, monkeypatch: pytest.MonkeyPatch
) -> None:
    frozen: list[int] = []
    monkeypatch.setattr(lifecycle, "freeze", freezing_at(frozen, 0.5))
    run = healthy_run(ScheduleConfig(learn_steps=200))
    run.looks = torch.tensor([[0.0, 20.0, 20.0 - 1e-3]]).expand(100, 3)
    for _ in steps_of(run, 10_000):
        if frozen:
            break
    assert frozen and run.lifecycle.progress.recoveries == 3


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
    for _ in steps_of(run, 1000):
        if len(frozen) > recoveries:
            break
    assert len(reopened) == run.lifecycle.progress.recoveries == recoveries
    assert frozen[-1] - frozen[0] <= 100
    said = "taught in logit form from now on" in " ".join(capsys.readouterr().out.split())
    assert said == bool(recoveries)


@pytest.mark.parametrize(("end", "again"), [(274, False), (275, True)])
def test_a_gate_is_opened_again_only_with_steps_to_learn_in_and_its_file_goes(
    end: int, again: bool, healthy_run, monkeypatch, tmp_path: Path
) -> None:
    frozen: list[int] = []
    monkeypatch.setattr(lifecycle, "freeze", freezing_at(frozen, 0.0, 0.0))
    leave_nothing(monkeypatch)
    left: list[object] = []
    monkeypatch.setattr(lifecycle, "write_occupancy", lambda *_: left.append(0))
    run = healthy_run(ScheduleConfig(learn_steps=200))
    run.lifecycle.trainer = of_a_run_of(end)
    run.lifecycle.trainer.base_dir = tmp_path
    run.lifecycle.model.config.gate_loss = GateLossConfig(form="paper")
    run.lifecycle.model.get_param_groups = dict
    run.lifecycle.model.reopen = lambda: None
    (tmp_path / FILE_NAME).write_text("of a gate before")
    list(steps_of(run, 175))  # by then its decisions have settled
    assert frozen == [174] and run.lifecycle.progress.recoveries == int(again)
    assert (tmp_path / FILE_NAME).exists() == bool(left) == (not again)


def steps_of(run: SimpleNamespace, count: int) -> Iterator[int]:
    """Takes so many steps, unless who takes them stops."""
    for step in range(count):
        run.lifecycle.before_step(step)
        run.lifecycle.after_step(step)
        yield step


def leave_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Has a gate that is frozen leave no files, and its field as it is."""
    for name in ("write_occupancy", "leave_field", "merge", "forget_the_gone"):
        monkeypatch.setattr(lifecycle, name, lambda *_: None)


def freezing_at(steps: list[int], threshold: float, skipped: float = 0.8):
    """In place of `freeze`: notes the step, and finds this threshold, which skips so much."""

    def freeze(*arguments: object) -> SimpleNamespace:
        steps.append(arguments[3])
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
                sizes=SimpleNamespace(guided_batch=1.0),
            ),
            device=torch.device("cpu"),
            frozen=torch.tensor(False),
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
    for module in (lifecycle, recoveries):
        monkeypatch.setattr(module, "share", lambda tensors: note(map(id, tensors)))
    run.looks = run.empty
    found = {}
    for step in steps_of(run, 1500):
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


def of_a_run_of(steps: int) -> SimpleNamespace:
    """A trainer."""
    return SimpleNamespace(
        _start_step=0,
        config=SimpleNamespace(max_num_iterations=steps, steps_per_save=0),
        optimizers=SimpleNamespace(optimizers={}),
        base_dir="run",
    )


@pytest.mark.parametrize(
    ("end", "learns_to", "dense_to"), [(450, 450, 375), (2000, 500, 400), (380, 500, 400)]
)
def test_what_is_healed_is_frozen_in_its_run_where_that_has_the_steps(
    healthy_run, end: int, learns_to: int, dense_to: int
) -> None:
    run = healthy_run(ScheduleConfig(learn_steps=400))
    run.lifecycle.trainer = of_a_run_of(end)
    run.lifecycle.recoveries.heal(Collapse("a cause", "empty"), SPREAD, 299)
    progress = run.lifecycle.progress
    assert (progress.learn_steps, progress.dense_until) == (learns_to, dense_to)


@pytest.mark.parametrize(("end", "freezes_at"), [(1000, 250), (230, 230), (200, 200)])
def test_points_that_are_shared_out_at_the_end_of_the_phase_are_learned_from(
    end: int, freezes_at: int, healthy_run, monkeypatch
) -> None:
    """A quarter of the phase more, or what the run has; in its last step they are left as is."""
    frozen: list[int] = []
    monkeypatch.setattr(lifecycle, "freeze", freezing_at(frozen, 0.5))
    leave_nothing(monkeypatch)
    run = healthy_run(ScheduleConfig(learn_steps=200))
    run.lifecycle.trainer = of_a_run_of(end)
    run.lifecycle.model.get_param_groups = dict
    run.looks = torch.tensor([[20.0, 0.0, 0.0], [0.0, 20.0, 0.0]]).repeat(50, 1)
    for _ in steps_of(run, end):
        if run.lifecycle.progress.recoveries:
            run.looks = run.sound
        if frozen:
            break
    assert frozen == [freezes_at - 1]
    assert run.lifecycle.progress.recoveries == int(end > 200)


@pytest.mark.parametrize("form", ["logit", "paper"])
def test_a_gate_that_stays_with_one_expert_is_frozen_all_the_same(
    form: Any, healthy_run, monkeypatch
) -> None:
    frozen: list[int] = []
    monkeypatch.setattr(lifecycle, "freeze", freezing_at(frozen, 0.5))
    run = healthy_run(ScheduleConfig(learn_steps=200))
    run.lifecycle.model.config.gate_loss = GateLossConfig(form=form, fall_back=False)
    run.looks = torch.tensor([[20.0, 0.0, 0.0], [0.0, 20.0, 0.0]]).repeat(50, 1)
    for _ in steps_of(run, 1000):
        if frozen:
            break
    assert frozen == [249] and run.lifecycle.progress.recoveries == 1


@pytest.mark.parametrize("kind", ["empty", "occupied"])
def test_without_steps_to_heal_it_in_a_gate_is_frozen_with_what_it_has_learned(
    kind: str, healthy_run, monkeypatch
) -> None:
    frozen: list[int] = []
    monkeypatch.setattr(lifecycle, "freeze", freezing_at(frozen, 0.0))
    leave_nothing(monkeypatch)
    run = healthy_run(ScheduleConfig(learn_steps=200))
    run.lifecycle.trainer = of_a_run_of(299)
    run.lifecycle.model.get_param_groups = dict
    occupied = torch.tensor([[0.0, 20.0, 20.0 - 1e-3]]).expand(100, 3)
    run.looks = run.empty if kind == "empty" else occupied
    before = run.lifecycle.model.gate.head.weight.clone()
    list(steps_of(run, 200))
    assert frozen == [199] and run.lifecycle.progress.recoveries == 0
    assert torch.equal(run.lifecycle.model.gate.head.weight, before)


def test_a_gate_that_is_left_as_it_is_is_said_so_once_and_is_no_longer_suspected(
    healthy_run, monkeypatch
) -> None:
    lines: list[str] = []
    monkeypatch.setattr(recoveries, "say", lines.append)
    run = healthy_run(ScheduleConfig(learn_steps=2000))
    run.lifecycle.progress.recoveries, run.lifecycle.progress.fewest_kept = MOST_RECOVERIES, 0.5
    run.looks = torch.tensor([[0.0, 20.0, 20.0 - 1e-3]]).expand(100, 3)
    list(steps_of(run, 1900))
    assert len(lines) == 1 and "so be it" in lines[0]
    assert run.lifecycle.progress.suspected_since == -1


def test_experts_that_were_dropped_stay_so_in_a_field_that_is_learned_anew(healthy_run) -> None:
    field = healthy_run(ScheduleConfig()).lifecycle.model.field
    made = object.__new__(Lifecycle)
    made.trainer, made.optimizers = None, []
    made.model = SimpleNamespace(field=field, num_train_data=2)
    field.experts.drop(1)
    before = list(field.parameters())
    made.restart_field()
    assert field.experts.left.tolist()[0] is False
    assert all(one is other for one, other in zip(field.parameters(), before, strict=True))
