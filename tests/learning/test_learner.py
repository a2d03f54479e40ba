"""Claims about looking at the gate while it learns."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch

from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.field import FieldConfig, HMoEField
from leco_plugin.models.gate import Gate, GateConfig
from leco_plugin.learning import learner
from leco_plugin.learning.history import GateHistory
from leco_plugin.learning.learner import Lifecycle
from leco_plugin.learning.schedule import ScheduleConfig
from leco_plugin.learning.progress import Progress
from leco_plugin.models.rendering import Rays, Routing
from leco_plugin.space import Space

PROBES = 500


class CountingSurvey:
    """Rays along x from the origin, which says how often it was asked for them."""

    asked = 0

    def probe_rays(self, *arguments: object) -> Rays:
        self.asked += 1
        directions = torch.tensor([[1.0, 0.0, 0.0]]).expand(9, 3)
        origins = torch.stack([torch.zeros(9), torch.arange(9.0), torch.zeros(9)], dim=-1)
        return Rays(origins, directions, torch.full((9,), 0.5), torch.full((9,), 2.0), None)


@pytest.fixture
def looking(monkeypatch: pytest.MonkeyPatch) -> Lifecycle:
    """A lifecycle that has just what looking at the gate touches."""
    monkeypatch.setattr(lifecycle, "PROBES", PROBES)
    space = Space()
    space.set("contraction", torch.zeros(3), 4.0)
    made = object.__new__(Lifecycle)
    made.survey = CountingSurvey()  # type: ignore[assignment]
    made.model = SimpleNamespace(  # type: ignore[assignment]
        device=torch.device("cpu"),
        precision="float32",
        aabb=torch.zeros(6),
        march_range=torch.zeros(6),
        space=space,
        gate=Gate(GateConfig(EncodingConfig(octaves=1), width=8, layers=1, scene_experts=2)),
    )
    return made


def test_the_probe_positions_lie_on_their_rays_within_the_bounds(looking: Lifecycle) -> None:
    positions = looking.model.space.unmap(looking.probe_positions)
    assert positions.shape == (PROBES, 3)
    assert float(positions[:, 0].min()) >= 0.499 and float(positions[:, 0].max()) <= 2.001
    assert set(positions[:, 1].round(decimals=3).tolist()) == {float(ray) for ray in range(9)}


def test_every_look_is_at_the_same_positions_found_once(looking: Lifecycle) -> None:
    first, again = looking._probe(), looking._probe()
    assert torch.equal(first, again) and first.shape == (PROBES, 3)
    assert looking.survey.asked == 1  # type: ignore[attr-defined]
    assert not first.requires_grad


def test_a_look_sees_what_the_gate_has_learned_since(looking: Lifecycle) -> None:
    before = looking._probe()
    with torch.no_grad():
        looking.model.gate.head.bias += 1.0
    torch.testing.assert_close(looking._probe(), before + 1.0)


def test_a_field_that_starts_anew_keeps_its_parameters_and_forgets_what_they_were() -> None:
    config = FieldConfig(EncodingConfig("hash", levels=1, log2_table=4), appearance_dim=2)
    field = HMoEField(config, 3)
    optimizer = torch.optim.Adam(field.parameters(), lr=1.0)
    sum(parameter.sum() for parameter in field.parameters()).backward()
    optimizer.step()
    made = object.__new__(Lifecycle)
    made.model = SimpleNamespace(field=field, num_train_data=3)  # type: ignore[assignment]
    made.trainer = SimpleNamespace(optimizers=SimpleNamespace(optimizers={"field": optimizer}))
    before = list(field.parameters())
    learned = [parameter.detach().clone() for parameter in before]
    made.restart_field()
    assert all(one is other for one, other in zip(field.parameters(), before, strict=True))
    assert not any(torch.equal(one, other) for one, other in zip(field.parameters(), learned))
    assert not optimizer.state
    sum(parameter.sum() for parameter in field.parameters()).backward()
    optimizer.step()


def test_a_full_disk_costs_the_history_and_not_the_run(
    looking: Lifecycle, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    config = FieldConfig(EncodingConfig(kind="hash", log2_table=8))
    looking.model.field = HMoEField(config, num_images=2)
    looking.model.routing = Routing(None, False)
    looking.model.progress = Progress()
    looking.history = GateHistory()
    looking.trainer = SimpleNamespace(base_dir="run")
    monkeypatch.setattr(GateHistory, "save", full)
    looking._record(3)
    assert looking.history.steps == [3]
    assert "could not be written" in " ".join(capsys.readouterr().out.split())


def test_a_short_run_says_once_that_half_of_it_is_for_learning(
    looking: Lifecycle, capsys: pytest.CaptureFixture[str]
) -> None:
    looking.model.progress = Progress()  # type: ignore[assignment]
    looking._say_if_short(200, 62, 125)
    said = " ".join(capsys.readouterr().out.split())
    assert "of 125 steps" in said and "until step 62," in said
    looking._say_if_short(50, 62, 125)  # all of them fit
    looking.model.progress.begin(200, 62)
    looking._say_if_short(200, 62, 125)  # resumed
    assert capsys.readouterr().out == ""


def test_learning_on_takes_a_quarter_more_and_is_said(
    looking: Lifecycle, capsys: pytest.CaptureFixture[str]
) -> None:
    looking.trainer = None
    looking.model.progress = Progress(learn_steps=173, configured=200)  # type: ignore[assignment]
    assert looking._learns_on(172, 0.86)
    assert looking.progress.learn_steps == 223 and looking.progress.extensions == 1
    said = capsys.readouterr().out
    assert "it learns" in said and "until step 223" in said


@pytest.mark.parametrize(
    ("step", "learns_to"), [(299, 375), (560, 600), (599, None)], ids=["fits", "cut", "no room"]
)
def test_learning_on_is_as_long_as_a_short_run_has_room(
    looking: Lifecycle, step: int, learns_to: int | None
) -> None:
    """2000 steps are configured, of which a run of 600 has 300."""
    looking.trainer = SimpleNamespace(_start_step=0, config=SimpleNamespace(max_num_iterations=600))
    looking.model.progress = Progress()  # type: ignore[assignment]
    looking.progress.begin(2000, 300)
    looking.progress.learn_steps = step + 1
    assert looking._learns_on(step, 0.86) == (learns_to is not None)
    assert looking.progress.learn_steps == (learns_to or step + 1)
    assert looking.progress.extensions == (learns_to is not None)


@pytest.mark.parametrize(
    ("last", "freezes", "said"), [(12, True, True), (12, False, False), (11, True, False)]
)
def test_a_run_that_ends_before_it_has_frozen_anything_says_so(
    looking: Lifecycle,
    monkeypatch: pytest.MonkeyPatch,
    last: int,
    freezes: bool,
    said: bool,
) -> None:
    model: Any = looking.model
    model.config = SimpleNamespace(schedule=ScheduleConfig(freeze=freezes), homogeneous=False)
    model.progress, model.frozen, model.learned = (
        Progress(learn_steps=30),
        torch.tensor(False),
        False,
    )
    looking.trainer = SimpleNamespace(  # resumed at step 3
        _start_step=3, config=SimpleNamespace(max_num_iterations=10)
    )
    looking.step_started = 0.0
    lines: list[str] = []
    monkeypatch.setattr(lifecycle, "say", lines.append)
    looking.after_step(last)
    assert len(lines) == said and all("to step 30, and nothing is frozen" in s for s in lines)
