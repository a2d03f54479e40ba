"""Claims about looking at the gate while it learns."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from small_learner import ARun, small_learner

from leco_plugin.learning import history
from leco_plugin.learning import learner as learner_module
from leco_plugin.learning.history import GateHistory
from leco_plugin.learning.learner import Learner
from leco_plugin.learning.run import Progress
from leco_plugin.learning.schedule import ScheduleConfig

PROBES = 500


@pytest.fixture
def learner(monkeypatch: pytest.MonkeyPatch) -> Learner:
    monkeypatch.setattr(history, "PROBES", PROBES)
    return small_learner(ARun())


def test_looks_are_at_the_same_positions_on_rays_within_the_bounds(learner: Learner) -> None:
    probes = learner.probes
    positions = learner.mixture.region.space.unmap(probes.positions)
    assert positions.shape == (PROBES, 3)
    assert float(positions[:, 0].min()) >= 0.499 and float(positions[:, 0].max()) <= 2.001
    assert set(positions[:, 1].round(decimals=3).tolist()) == {float(ray) for ray in range(9)}
    first, again = probes.logits(), learner.probes.logits()
    assert torch.equal(first, again) and first.shape == (PROBES, 3)
    assert learner.probes is probes and not first.requires_grad
    with torch.no_grad():
        learner.mixture.gate.head.bias += 1.0
    torch.testing.assert_close(learner.probes.logits(), first + 1.0)


def test_a_field_that_starts_anew_keeps_its_parameters(learner: Learner) -> None:
    field = learner.mixture.field
    optimizer = torch.optim.Adam(field.parameters(), lr=1.0)
    learner.run = learner.recoveries.run = ARun(optimizers=[optimizer])
    sum(parameter.sum() for parameter in field.parameters()).backward()
    optimizer.step()
    before = list(field.parameters())
    learned = [parameter.detach().clone() for parameter in before]
    learner.recoveries.restart_field()
    assert all(one is other for one, other in zip(field.parameters(), before, strict=True))
    assert not any(torch.equal(one, other) for one, other in zip(field.parameters(), learned))
    assert not optimizer.state
    sum(parameter.sum() for parameter in field.parameters()).backward()
    optimizer.step()


def test_a_full_disk_costs_the_history_and_not_the_run(
    learner: Learner, monkeypatch: pytest.MonkeyPatch, printed: Any
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    learner.run.folder = Path("run")
    learner.config.schedule = ScheduleConfig(steps_per_record=3)
    learner.begin()
    monkeypatch.setattr(GateHistory, "save", full)
    learner.after_step(3, 0.0, 1.0)
    assert learner.history.steps == [3]
    assert "could not be written" in printed()


def test_a_short_run_says_once_that_half_is_learning(printed: Any) -> None:
    short, progress = ARun(end=125), Progress()
    small_learner(short, progress=progress).begin()
    said = printed()
    assert "of 125 steps" in said and "until step 62," in said
    small_learner(short, progress=progress).begin()  # resumed
    few = ScheduleConfig(learn_steps=50)
    small_learner(short, progress=Progress(), schedule=few).begin()  # all of them fit
    assert printed() == ""


@pytest.mark.parametrize(("end", "learns"), [(3, 2), (7, 3)])
def test_a_run_of_a_few_steps_learns_for_two_at_least(end: int, learns: int) -> None:
    progress = Progress()
    small_learner(ARun(end=end), progress=progress).begin()
    assert progress.learn_steps == learns


def test_a_long_run_learns_for_its_share_however_seldom_its_gate_is_checked() -> None:
    schedule, progress = ScheduleConfig(learn_steps=20, learn_share=0.1), Progress()
    small_learner(ARun(end=500), progress=progress, schedule=schedule).begin()
    assert (progress.learn_steps, progress.phase, progress.configured) == (50, 50, 20)
    small_learner(ARun(end=800, start=50), progress=progress, schedule=schedule).begin()
    assert progress.learn_steps == 50, "a gate that is never frozen is past learning then"


def test_a_resumed_run_of_another_schedule_learns_for_half_of_the_steps_that_are_left() -> None:
    progress, longer = Progress(learn_steps=50, configured=50), ScheduleConfig(learn_steps=500)
    small_learner(ARun(start=100, end=300), progress=progress, schedule=longer).begin()
    assert progress.learn_steps == 100 + 100


def test_before_there_is_a_threshold_a_tenth_is_kept(learner: Learner) -> None:
    o = torch.tensor([0.09, 0.11, 0.5, 0.9])
    logits = torch.stack([torch.zeros(4), o.logit(), torch.full((4,), -30.0)], dim=1)
    learner.probes = SimpleNamespace(logits=lambda: logits)  # type: ignore[assignment]
    for step, seconds in ((23, 2.0), (24, 3.0)):
        learner.after_step(step, seconds, 1.0)
    assert learner.progress.decisions.tolist() == [False, True, True, True]
    assert learner.progress.learn_seconds == 5.0


@pytest.mark.parametrize(("kept", "settled"), [(95, True), (96, False)])
def test_a_gate_that_keeps_nearly_all_has_not_settled(
    kept: int, settled: bool, learner: Learner
) -> None:
    learner.progress.decisions = decisions = torch.arange(100) < kept
    assert learner._has_settled(174, decisions, last=False) == settled


def test_of_half_a_sample_a_ray_a_batch_may_keep_none(learner: Learner) -> None:
    kept_any: list[float] = []
    learner.watch.after_step = lambda *given: kept_any.append(given[2])  # type: ignore
    for expected, kept in ((0.51, 0.0), (0.49, 0.0), (0.51, 0.1)):
        candidates = learner.mixture.sizes.candidates
        learner.mixture.freeze(0.5, {"empty_fraction": 1.0 - expected / candidates, "step": 0})
        learner.after_step(300, 1.0, kept)
    assert kept_any == [0.0, 1.0, 1.0]


def test_what_began_anew_ramps_from_there() -> None:
    """From 30 to 70 of its 100 steps."""
    progress = Progress(learn_steps=1100, configured=100, began=1000)
    learner = small_learner(progress=progress, schedule=ScheduleConfig(learn_steps=100))
    plans = [learner.before_step(1000 + step) for step in (20, 40, 50, 80)]
    assert [plan.ramped for plan in plans] == pytest.approx([0.0, 0.25, 0.5, 1.0])
    assert [plan.following is None for plan in plans] == [True, False, False, False]
    learner.mixture.freeze(0.0, {"empty_fraction": 0.0})
    assert [learner.before_step(step).coarse for step in (1050, 1080)] == [True, False]


def test_a_resumed_run_has_the_earlier_history_in_its_own_folder(
    learner: Learner, tmp_path: Path
) -> None:
    before, after = tmp_path / "before", tmp_path / "after"
    (before / "checkpoints").mkdir(parents=True)
    after.mkdir()
    learner.run.folder = before
    learner._record(3)
    run = ARun(start=4)
    run.folder, run.resumed_from = after, before / "checkpoints"
    small_learner(run).begin()
    assert GateHistory.load(after / history.FILE_NAME, learner.mixture.gate).steps == [3]


def test_learning_on_takes_a_quarter_more_and_is_said(
    learner: Learner, capsys: pytest.CaptureFixture[str]
) -> None:
    learner.progress.learn_steps = 173
    assert learner._extends(172, 0.86)
    assert learner.progress.learn_steps == 223 and learner.progress.extensions == 1
    said = capsys.readouterr().out
    assert "it learns" in said and "until step 223" in said


@pytest.mark.parametrize(
    ("step", "learns_to"), [(299, 375), (560, 600), (599, None)], ids=["fits", "cut", "no room"]
)
def test_learning_on_is_as_long_as_a_short_run_has_room(step: int, learns_to: int | None) -> None:
    """2000 steps are configured, of which a run of 600 has 300."""
    learner = small_learner(
        ARun(end=600), progress=Progress(), schedule=ScheduleConfig(learn_steps=2000)
    )
    learner.begin()
    assert learner.progress.learn_steps == 300
    learner.progress.learn_steps = step + 1
    assert learner._extends(step, 0.86) == (learns_to is not None)
    assert learner.progress.learn_steps == (learns_to or step + 1)
    assert learner.progress.extensions == (learns_to is not None)


@pytest.mark.parametrize(
    ("last", "freezes", "said"), [(12, True, True), (12, False, False), (11, True, False)]
)
def test_a_run_that_ends_before_it_has_frozen_anything_says_so(
    monkeypatch: pytest.MonkeyPatch, last: int, freezes: bool, said: bool
) -> None:
    schedule = ScheduleConfig(freeze=freezes, learn_steps=30)
    learner = small_learner(ARun(start=3, end=13), schedule=schedule)  # resumed at step 3
    lines: list[str] = []
    monkeypatch.setattr(learner_module, "say", lines.append)
    learner.after_step(last, 0.0, 1.0)
    assert len(lines) == said and all("to step 30, and nothing is frozen" in s for s in lines)
