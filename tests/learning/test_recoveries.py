"""What a run does about a gate that collapses, with the steps that it has."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from small_learner import ARun, small_learner, small_mixture

from leco_plugin.learning import learner as learner_module
from leco_plugin.learning import recoveries
from leco_plugin.learning.calibration import Measured
from leco_plugin.learning.collapse import MOST_RECOVERIES, Collapse, GateCollapsed
from leco_plugin.learning.freezing import FILE_NAME
from leco_plugin.learning.schedule import ScheduleConfig
from leco_plugin.models.objective import GateLossConfig
from leco_plugin.occupancy import Occupancy

SPREAD = torch.tensor([0.5, 0.25, 0.25])
ONE_EXPERT = torch.tensor([[20.0, 0.0, 0.0], [0.0, 20.0, 0.0]] * 50)
OCCUPIED = torch.tensor([[0.0, 20.0, 20.0 - 1e-3]] * 100)


def steps_of(run: SimpleNamespace, count: int) -> Iterator[int]:
    """Takes so many steps, unless who takes them stops."""
    for step in range(count):
        run.learner.before_step(step)
        run.learner.after_step(step, 0.0, 1.0)
        yield step


def go_until_frozen(run: SimpleNamespace, count: int) -> None:
    """Takes steps until the gate is frozen, so many at most."""
    for _ in steps_of(run, count):
        if run.frozen:
            break


@pytest.fixture
def healthy_run() -> Callable[..., SimpleNamespace]:
    """Makes a run that looks at given logits, and freezes at a given price."""

    def make(
        schedule: ScheduleConfig,
        end: float = float("inf"),
        threshold: float = 0.5,
        skipped: float = 0.8,
        careful: float | None = None,
        **options: Any,
    ) -> SimpleNamespace:
        sound = torch.tensor([[20.0, 0.0, 0.0], [0.0, 20.0, 0.0], [0.0, 0.0, 20.0]]).repeat(33, 1)
        empty = torch.tensor([[20.0, 0.0, 0.0]]).expand(100, 3)
        mixture = small_mixture()
        optimizer = torch.optim.Adam(mixture.gate.parameters())
        around = ARun(end, optimizers=[optimizer])
        around.goes_on = False
        learner = small_learner(around, mixture, schedule=schedule, **options)
        mixture.routing = learner.recoveries.routing()
        run = SimpleNamespace(sound=sound, empty=empty, looks=sound, frozen=[], learner=learner)
        run.around, run.mixture, run.progress = around, mixture, learner.progress
        run.optimizer = optimizer
        learner.probes = SimpleNamespace(logits=lambda: run.looks)
        measured, freeze = Measured(threshold, 0.0, 0.0, 0.0, skipped), mixture.freeze
        carefully = measured
        if careful is not None:
            carefully = measured._replace(threshold=threshold / 4, empty_fraction=careful)
        learner.held_out.price = lambda _: (carefully, measured, measured._asdict())

        def noted(threshold: float, report: dict[str, Any]) -> None:
            run.frozen.append(report["step"])
            freeze(threshold, report)

        mixture.freeze = noted
        return run

    return make


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
    looks: list[list[float]], cause: str, starts: int, per_check: int, healthy_run, printed: Any
) -> None:
    run = healthy_run(ScheduleConfig(learn_steps=2000, steps_per_check=per_check))
    for step in range(2000):
        if step == starts:
            run.looks = torch.tensor(looks).repeat(50, 1)
        run.learner.before_step(step)
        run.learner.after_step(step, 0.0, 1.0)
        if run.progress.recoveries:
            break
    assert starts + 95 <= step < starts + 150 and (step + 1) % 25 == 0
    said = printed()
    assert f"step {step}: " in said and cause in said and "(recovery" in said


def test_a_gate_that_recovers_by_itself_is_left_alone(healthy_run) -> None:
    run = healthy_run(ScheduleConfig(learn_steps=2000))
    for step in range(1000):
        gone = 300 <= step < 380
        run.looks = run.empty if gone else run.sound
        run.learner.before_step(step)
        run.learner.after_step(step, 0.0, 1.0)
        assert (run.progress.suspected_since >= 0) == (324 <= step < 399)
    assert run.progress.recoveries == 0


def test_a_gate_that_collapses_again_and_again_ends_the_run_in_one_line(healthy_run) -> None:
    run = healthy_run(ScheduleConfig(learn_steps=400))
    run.looks = run.empty
    with pytest.raises(GateCollapsed, match=r"step \d+: the gate calls .* 3 recoveries") as caught:
        list(steps_of(run, 10_000))
    assert "\n" not in str(caught.value)
    assert run.progress.recoveries == 3


def test_a_gate_that_keeps_everything_is_frozen_after_three_recoveries(healthy_run) -> None:
    run = healthy_run(ScheduleConfig(learn_steps=200))
    run.looks = OCCUPIED
    go_until_frozen(run, 10_000)
    assert run.frozen and run.progress.recoveries == 3


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
    losses: GateLossConfig, skipped: float, recoveries: int, healthy_run, printed: Any
) -> None:
    schedule = ScheduleConfig(learn_steps=200)
    run = healthy_run(schedule, threshold=0.0, skipped=skipped, gate_loss=losses)
    for _ in steps_of(run, 1000):
        open_again = len(run.frozen) <= recoveries
        assert bool(run.mixture.frozen) == (not open_again)
        if not open_again:
            break
    assert run.progress.recoveries == recoveries
    assert run.frozen[-1] - run.frozen[0] <= 100
    said = "taught in logit form from now on" in printed()
    assert said == bool(recoveries)


def test_a_gate_that_skips_carefully_is_judged_by_what_its_bounds_allow(
    healthy_run, printed: Any
) -> None:
    losses, schedule = GateLossConfig(form="paper"), ScheduleConfig(learn_steps=200)
    run = healthy_run(schedule, skipped=0.3, careful=0.01, gate_loss=losses)
    run.mixture.occupancies = lambda mapped: torch.full_like(mapped[:, 0], 0.3)
    go_until_frozen(run, 1000)
    assert run.mixture.is_frozen and run.progress.recoveries == 0
    said = printed()
    assert "hardly anything" not in said and "of little use" not in said


def test_advice_counts_the_steps_since_learning_began(healthy_run, monkeypatch) -> None:
    said: list[int] = []
    monkeypatch.setattr(learner_module, "advice_on", lambda _, steps, __: said.append(steps))
    run = healthy_run(ScheduleConfig(learn_steps=200))
    run.progress.began, run.progress.learn_steps = 50, 250
    go_until_frozen(run, 1000)
    assert said == [run.frozen[0] + 1 - 50]


@pytest.mark.parametrize(("end", "again"), [(274, False), (275, True)])
def test_a_gate_reopens_only_with_steps(end: int, again: bool, healthy_run, tmp_path: Path) -> None:
    schedule, losses = ScheduleConfig(learn_steps=200), GateLossConfig(form="paper")
    run = healthy_run(schedule, end, threshold=0.0, skipped=0.0, gate_loss=losses)
    run.around.folder = tmp_path
    (tmp_path / FILE_NAME).write_text("of a gate before")
    list(steps_of(run, 175))  # by then its decisions have settled
    assert run.frozen == [174] and run.progress.recoveries == int(again)
    assert (tmp_path / FILE_NAME).exists() == (not again)
    assert again or Occupancy.load(tmp_path / FILE_NAME).report["step"] == 174


def test_what_collapses_again_is_learned_anew_and_more_slowly(healthy_run, monkeypatch) -> None:
    run = healthy_run(ScheduleConfig(learn_steps=2000))
    gate, field, optimizer = run.mixture.gate, run.mixture.field, run.optimizer
    gate.hidden[0].weight.grad = torch.ones_like(gate.hidden[0].weight)
    optimizer.step()
    first = copy.deepcopy([gate.hidden[0].weight, field.state_dict()])
    shared: set[int] = set()
    monkeypatch.setattr(recoveries, "share", lambda tensors: shared.update(map(id, tensors)))
    run.looks = run.empty
    found = {}
    for step in steps_of(run, 1500):
        progress = run.progress
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
            assert run.learner.before_step(step + 1).ramped == 0.0
            assert vars(optimizer)["leco_pace"] == progress.pace
        if progress.recoveries == MOST_RECOVERIES:
            break
    # a new last layer is tried first
    assert list(found.values()) == [(True, 1.0), (True, 1.0), (False, 0.25), (False, 0.0625)]


@pytest.mark.parametrize(
    ("end", "learns_to", "dense_to"), [(450, 450, 375), (2000, 500, 400), (380, 500, 400)]
)
def test_what_is_healed_is_frozen_in_its_run_where_that_has_the_steps(
    healthy_run, end: int, learns_to: int, dense_to: int
) -> None:
    run = healthy_run(ScheduleConfig(learn_steps=400), end)
    run.learner.recoveries._heal(Collapse("a cause", "empty"), SPREAD, 299)
    assert (run.progress.learn_steps, run.progress.dense_until) == (learns_to, dense_to)


@pytest.mark.parametrize(("end", "freezes_at"), [(1000, 250), (230, 230), (200, 200)])
def test_points_shared_out_late_are_learned_from(end: int, freezes_at: int, healthy_run) -> None:
    """A quarter of the phase more, or what the run has; in its last step they are left as is."""
    run = healthy_run(ScheduleConfig(learn_steps=200), end)
    run.looks = ONE_EXPERT
    for _ in steps_of(run, end):
        if run.progress.recoveries:
            run.looks = run.sound
        if run.frozen:
            break
    assert run.frozen == [freezes_at - 1]
    assert run.progress.recoveries == int(end > 200)


@pytest.mark.parametrize("form", ["logit", "paper"])
def test_a_gate_that_stays_with_one_expert_is_frozen_all_the_same(form: Any, healthy_run) -> None:
    losses = GateLossConfig(form=form, fall_back=False)
    run = healthy_run(ScheduleConfig(learn_steps=200), gate_loss=losses)
    run.looks = ONE_EXPERT
    go_until_frozen(run, 1000)
    assert run.frozen == [249] and run.progress.recoveries == 1


@pytest.mark.parametrize("kind", ["empty", "occupied"])
def test_without_steps_to_heal_a_gate_is_frozen_as_it_is(kind: str, healthy_run) -> None:
    run = healthy_run(ScheduleConfig(learn_steps=200), end=299, threshold=0.0)
    run.looks = run.empty if kind == "empty" else OCCUPIED
    before = run.mixture.gate.head.weight.clone()
    list(steps_of(run, 200))
    assert run.frozen == [199] and run.progress.recoveries == 0
    assert torch.equal(run.mixture.gate.head.weight, before)
    assert not run.progress.looks_collapsed, "else nothing would be saved"


@pytest.mark.parametrize(("looks", "steps"), [(OCCUPIED, 1900), (ONE_EXPERT, 1650)])
def test_a_gate_left_as_it_is_is_said_once(looks, steps: int, healthy_run, monkeypatch) -> None:
    lines: list[str] = []
    monkeypatch.setattr(recoveries, "say", lines.append)
    run = healthy_run(ScheduleConfig(learn_steps=2000))
    run.progress.recoveries, run.progress.fewest_kept = MOST_RECOVERIES, 0.5
    run.looks = looks
    list(steps_of(run, steps))
    assert len(lines) == 1 and "it is left as it is" in lines[0]
    assert run.progress.suspected_since == -1


OCCUPIED = torch.tensor([[0.0, 20.0, 20.0 - 1e-3]] * 100)


def test_experts_that_were_dropped_stay_so_in_a_field_that_is_learned_anew(healthy_run) -> None:
    run = healthy_run(ScheduleConfig())
    field = run.mixture.field
    field.experts.drop(1)
    before = list(field.parameters())
    run.learner.recoveries.restart_field()
    assert field.experts.left.tolist()[0] is False
    assert all(one is other for one, other in zip(field.parameters(), before, strict=True))
