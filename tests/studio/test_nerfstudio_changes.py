"""Claims about `leco_plugin.studio.run_folder`, by stubs of what has changed."""

from __future__ import annotations

import math
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest
from nerfstudio.engine.trainer import Trainer, TrainerConfig

from leco_plugin.scenes.input_error import InputError, TrainingStopped
from leco_plugin.studio import run_folder as nerfstudio_changes
from leco_plugin.studio import trainer as atomic_trainer
from leco_plugin.studio.run_folder import (
    counts_from_zero,
    end_of,
    iterations_until,
    keeps_all_images,
)
from leco_plugin.studio.trainer import AtomicTrainer


class Released(Trainer):
    def train(self) -> None:
        num_iterations = self.config.max_num_iterations
        for step in range(self._start_step, self._start_step + num_iterations):
            self.step = step


class Main(Trainer):
    def train(self) -> None:
        num_iterations = self.config.max_num_iterations - self._start_step
        for step in range(self._start_step, self._start_step + num_iterations):
            self.step = step


class Simpler(Trainer):
    def train(self) -> None:
        for step in range(self._start_step, self.config.max_num_iterations):
            self.step = step


BOTH = pytest.mark.parametrize(
    ("theirs", "from_zero"), [(Released, False), (Main, True), (Simpler, True)]
)


@pytest.fixture
def installed(theirs: type[Trainer], monkeypatch: pytest.MonkeyPatch) -> Iterator[type[Trainer]]:
    """A nerfstudio whose trainer is this one."""
    counts_from_zero.cache_clear()
    monkeypatch.setattr(nerfstudio_changes, "Trainer", theirs)
    yield theirs
    counts_from_zero.cache_clear()


def resumed(kind: type[Trainer], asked: int, start: int = 30) -> Any:
    trainer = object.__new__(kind)
    trainer.config = TrainerConfig(max_num_iterations=asked)
    trainer.config.logging.local_writer.enable = False
    trainer._start_step = start
    return trainer


@BOTH
def test_a_run_ends_where_its_trainer_stops(installed: type[Trainer], from_zero: bool) -> None:
    assert counts_from_zero() is from_zero
    for start in (0, 30):
        trainer = resumed(installed, 50, start)
        trainer.train()
        assert end_of(trainer.config, start) == trainer.step + 1
        again = resumed(installed, iterations_until(90, done=start), start)
        again.train()
        assert end_of(again.config, start) == again.step + 1 == 90


def test_without_its_source_it_is_the_release(monkeypatch: pytest.MonkeyPatch) -> None:
    counts_from_zero.cache_clear()
    monkeypatch.setattr(nerfstudio_changes, "Trainer", SimpleNamespace(train=len))
    assert not counts_from_zero()
    counts_from_zero.cache_clear()


@BOTH
@pytest.mark.usefixtures("installed")
def test_ctrl_c_asks_for_the_steps_that_are_left(
    from_zero: bool, tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    trainer = resumed(AtomicTrainer, 90 if from_zero else 60)
    trainer.config.steps_per_save = 0
    trainer.checkpoint_dir = folder = tmp_path / "a run"
    folder.mkdir()
    trainer.asked_to_stop = SimpleNamespace(is_set=lambda: True)
    (folder / "step-000000049.ckpt").touch()
    monkeypatch.setattr("sys.argv", ["ns-train", "leco-occupancy"])
    goes_on = f"--load-dir '{folder}' --max-num-iterations {90 if from_zero else 40} goes on$"
    with pytest.raises(TrainingStopped, match=goes_on):
        trainer.stop_if_asked(49)
    again = ["--load-dir", "before", "--max_num_iterations=60"]
    monkeypatch.setattr("sys.argv", ["ns-train", "leco-occupancy", *again])
    own = "goes on, in place of its own --load-dir and --max-num-iterations$"
    with pytest.raises(TrainingStopped, match=own):
        trainer.stop_if_asked(49)
    (folder / "step-000000089.ckpt").touch()
    with pytest.raises(TrainingStopped) as stopped:
        trainer.stop_if_asked(89)
    assert "goes on" not in str(stopped.value)


@BOTH
@pytest.mark.usefixtures("installed")
def test_a_run_without_steps_is_refused(from_zero: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """nerfstudio would save its checkpoint as that of step 0."""
    trainer = resumed(AtomicTrainer, 30)
    trainer.callbacks, trainer.pipeline = [], SimpleNamespace(model=None)
    for name in ("with_sizes_of", "keep_sizes"):
        monkeypatch.setattr(atomic_trainer, name, lambda config, *_: config)
    monkeypatch.setattr(Trainer, "setup", lambda self: None)
    if not from_zero:
        trainer.setup()
        return
    with pytest.raises(
        InputError, match=r"30 steps already: .* in --max-num-iterations 30"
    ) as line:
        trainer.setup()
    assert "\n" not in str(line.value)


@pytest.mark.parametrize(
    ("some", "everything"), [(-1, True), (math.inf, True), (9, True), (8, False), (3, False)]
)
def test_all_images_are_asked_for_in_the_words_of_either(some: float, everything: bool) -> None:
    assert keeps_all_images(SimpleNamespace(train_num_images_to_sample_from=some), 9) is everything
