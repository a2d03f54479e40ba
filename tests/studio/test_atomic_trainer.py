"""Claims about `leco_plugin.studio.trainer`."""

from __future__ import annotations

import errno
import os
import resource
import signal
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from nerfstudio.engine.trainer import Trainer, TrainerConfig

from leco_plugin.samplers.kernels import VARIABLE
from leco_plugin.scenes.input_error import InputError, TrainingStopped
from leco_plugin.studio import trainer as atomic_trainer
from leco_plugin.studio.checkpoints import damage_of
from leco_plugin.studio.run_folder import checkpoint_of
from leco_plugin.studio.trainer import (
    AtomicTrainer,
    _say_which_kernels_are_off,
    _trackers_in_one_line,
)


@pytest.fixture
def trainer(tmp_path: Path) -> AtomicTrainer:
    """A trainer that has just what saving touches."""
    trainer = object.__new__(AtomicTrainer)
    trainer.checkpoint_dir = tmp_path / "run" / "nerfstudio_models"
    trainer.pipeline = torch.nn.Linear(2, 2)
    trainer.optimizers = SimpleNamespace(optimizers={}, schedulers={})
    trainer.grad_scaler = SimpleNamespace(state_dict=dict)
    trainer.config = SimpleNamespace(
        save_only_latest_checkpoint=True, steps_per_save=500, verbose=True
    )
    trainer.training_state, trainer.step, trainer.world_size = "training", 20, 1
    return trainer


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def previous(trainer: AtomicTrainer) -> Path:
    return trainer.checkpoint_dir.with_name("nerfstudio_models.previous")


def test_the_latest_checkpoint_is_kept_and_the_one_before_beside_it(trainer: AtomicTrainer) -> None:
    for step in (10, 20, 30):
        trainer.save_checkpoint(step)
    assert names(trainer.checkpoint_dir) == ["step-000000030.ckpt"]
    assert names(previous(trainer)) == ["step-000000020.ckpt"]
    assert torch.load(trainer.checkpoint_dir / "step-000000030.ckpt")["step"] == 30


def test_all_checkpoints_are_kept_where_that_is_wanted(trainer: AtomicTrainer) -> None:
    trainer.config.save_only_latest_checkpoint = False
    trainer.save_checkpoint(10)
    trainer.save_checkpoint(20)
    assert names(trainer.checkpoint_dir) == ["step-000000010.ckpt", "step-000000020.ckpt"]


def test_a_run_that_dies_while_it_saves_keeps_the_checkpoint_before(
    trainer: AtomicTrainer, monkeypatch: pytest.MonkeyPatch
) -> None:
    trainer.save_checkpoint(10)

    def dies_half_way(state: Any, path: Path) -> None:
        path.write_bytes(b"half a checkpoint")
        raise KeyboardInterrupt

    with monkeypatch.context() as dying, pytest.raises(KeyboardInterrupt):
        dying.setattr(torch, "save", dies_half_way)
        trainer.save_checkpoint(20)
    assert names(trainer.checkpoint_dir) == ["step-000000010.ckpt"]

    trainer.save_checkpoint(30)
    assert names(trainer.checkpoint_dir) == ["step-000000030.ckpt"]
    assert names(trainer.checkpoint_dir.parent) == [
        "nerfstudio_models",
        "nerfstudio_models.previous",
    ]
    assert torch.load(trainer.checkpoint_dir / "step-000000030.ckpt")["step"] == 30


def full(*_: Any) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_full_disk_costs_one_checkpoint_and_says_which_one_is_left(
    trainer: AtomicTrainer, monkeypatch: pytest.MonkeyPatch, printed: Any
) -> None:
    trainer.save_checkpoint(10)
    with monkeypatch.context() as filling:
        filling.setattr(torch, "save", full)
        trainer.save_checkpoint(20)
        said = printed()
        assert "step 20: no checkpoint could be saved" in said and "No space left" in said
        assert names(trainer.checkpoint_dir) == ["step-000000010.ckpt"]
        trainer.training_state = "completed"
        with pytest.raises(TrainingStopped, match=r"step 30: no .*step-000000010\.ckpt") as caught:
            trainer.save_checkpoint(30)
    assert "\n" not in str(caught.value)
    trainer.save_checkpoint(40)
    assert names(trainer.checkpoint_dir) == ["step-000000040.ckpt"]
    assert names(previous(trainer)) == ["step-000000010.ckpt"]


def test_a_write_that_the_system_cuts_off_costs_one_checkpoint(trainer: AtomicTrainer) -> None:
    """As on a full disk, by the system itself: files may not grow beyond a limit."""
    trainer.save_checkpoint(10)
    trainer.pipeline.weight = torch.nn.Parameter(torch.zeros(1 << 18))
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 16, before[1]))
        trainer.save_checkpoint(20)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, ignored)
    assert names(trainer.checkpoint_dir) == ["step-000000010.ckpt"]
    assert names(trainer.checkpoint_dir.parent) == ["nerfstudio_models"]
    assert damage_of(trainer.checkpoint_dir / "step-000000010.ckpt") is None


def test_weights_that_are_not_finite_are_not_saved(trainer: AtomicTrainer, printed: Any) -> None:
    trainer.save_checkpoint(10)
    with torch.no_grad():
        trainer.pipeline.bias[0] = torch.nan
    trainer.save_checkpoint(20)
    assert "bias is not finite" in printed()
    assert names(trainer.checkpoint_dir) == ["step-000000010.ckpt"]


def test_a_loss_that_is_not_finite_ends_the_run_in_one_line(
    trainer: AtomicTrainer, monkeypatch: pytest.MonkeyPatch
) -> None:
    def diverges(_: Trainer) -> None:
        raise FloatingPointError("rgb_loss is not finite: a reason.")

    monkeypatch.setattr(Trainer, "train", diverges)
    with pytest.raises(TrainingStopped, match=r"step 20: rgb_loss is not .* no checkpoint was"):
        trainer.train()
    trainer.save_checkpoint(10)
    with pytest.raises(
        TrainingStopped, match=r"a reason.*last good checkpoint is .*step-000000010"
    ):
        trainer.train()


def test_checkpoints_are_saved_by_the_clock(
    trainer: AtomicTrainer, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [1000.0]
    monkeypatch.setattr(atomic_trainer.time, "monotonic", lambda: now[0])
    trainer.saved_at = now[0]
    saved: list[int] = []
    monkeypatch.setattr(trainer, "_save_whole", saved.append)
    for step in range(200):
        now[0] += 1.0
        trainer.save_by_the_clock(step)
    assert saved == [60, 121, 182]
    for steps_per_save, only_latest in ((0, True), (500, False)):
        trainer.config.steps_per_save = steps_per_save
        trainer.config.save_only_latest_checkpoint = only_latest
        now[0] += 1e6
        trainer.save_by_the_clock(200)
    assert len(saved) == 3  # none are wanted, or all are kept, as many as the user asked for


def test_slow_saves_are_rare(trainer: AtomicTrainer, monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(atomic_trainer.time, "monotonic", lambda: now[0])

    def slow(step: int) -> None:
        now[0] += 30.0

    monkeypatch.setattr(trainer, "_save_whole", slow)
    trainer.saved_at, seconds = 0.0, 0.0
    while now[0] < 50_000.0:
        now[0] += 1.0
        started = now[0]
        trainer.save_by_the_clock(0)
        seconds += now[0] - started
    assert 0.0 < seconds / now[0] < 0.012


@pytest.mark.parametrize("damage", ["cut", "flip", "text"])
def test_a_damaged_checkpoint_gives_way_to_the_one_before(
    damage: str, trainer: AtomicTrainer, capsys: pytest.CaptureFixture[str]
) -> None:
    trainer.save_checkpoint(10)
    trainer.save_checkpoint(20)
    path = trainer.checkpoint_dir / "step-000000020.ckpt"
    config = TrainerConfig(load_dir=trainer.checkpoint_dir)
    assert checkpoint_of(config) == path

    spoil(path, damage)
    assert checkpoint_of(config) == previous(trainer) / "step-000000010.ckpt"
    said = "".join(capsys.readouterr().out.split())
    assert "step-000000020.ckptisdamaged" in said and "thenewestthatiswhole" in said

    spoil(previous(trainer) / "step-000000010.ckpt", damage)
    with pytest.raises(InputError, match="no checkpoint can be gone on with") as caught:
        checkpoint_of(config)
    assert "\n" not in str(caught.value)


def spoil(path: Path, damage: str) -> None:
    content = bytearray(path.read_bytes())
    if damage == "flip":  # a weight, which torch itself would read without complaint
        state = torch.load(path)["pipeline"]["weight"].numpy().tobytes()
        content[content.index(state)] ^= 1
        path.write_bytes(content)
        torch.load(path)
    else:
        path.write_bytes(content[:500] if damage == "cut" else b"no checkpoint")


MISFIT = "the checkpoint does not fit this method with these options "


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (KeyError("field"), rf"^{MISFIT}\('field'\): go on with the method and options of its run"),
        (RuntimeError("one\nsize"), rf"^{MISFIT}\(one size\): go on"),
        (ValueError("another size"), rf"^{MISFIT}\(another size\): go on"),
        (InputError("fewer photographs"), "^fewer photographs$"),
    ],
)
def test_a_checkpoint_of_another_method_is_refused_in_a_line(
    error: Exception, said: str, trainer: AtomicTrainer, monkeypatch: pytest.MonkeyPatch
) -> None:
    def load(_: Trainer) -> None:
        raise error

    monkeypatch.setattr(Trainer, "_load_checkpoint", load)
    with pytest.raises(InputError, match=said) as caught:
        trainer._load_checkpoint()
    assert "\n" not in str(caught.value)


def test_kernels_that_are_off_are_said_before_training(
    monkeypatch: pytest.MonkeyPatch, printed: Any
) -> None:
    monkeypatch.setenv(VARIABLE, "march, gate")
    _say_which_kernels_are_off()
    said = printed()
    assert "[leco] LECO_KERNELS_OFF: torch answers in place of gate, march" in said
    monkeypatch.setenv(VARIABLE, "marsh")
    with pytest.raises(InputError, match="LECO_KERNELS_OFF names marsh"):
        _say_which_kernels_are_off()
    monkeypatch.delenv(VARIABLE)
    _say_which_kernels_are_off()
    assert printed() == ""


def test_a_tracker_that_cannot_begin_is_one_line_and_other_errors_stay() -> None:
    def setup_event_writer() -> None:
        raise ValueError("no key\nis there")

    with (
        pytest.raises(InputError, match=r"--vis wandb cannot begin \(no key is there\): log in"),
        _trackers_in_one_line("wandb"),
    ):
        setup_event_writer()
    with pytest.raises(ValueError, match="no key"), _trackers_in_one_line("tensorboard"):
        setup_event_writer()
    with pytest.raises(ValueError, match="another"), _trackers_in_one_line("wandb"):
        raise ValueError("another")
