"""Claims about `leco_plugin.compat.atomic_trainer`."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from leco_plugin.compat.atomic_trainer import AtomicTrainer


@pytest.fixture
def trainer(tmp_path: Path) -> AtomicTrainer:
    """A trainer that has just what saving touches."""
    trainer = object.__new__(AtomicTrainer)
    trainer.checkpoint_dir = tmp_path / "run" / "nerfstudio_models"
    trainer.pipeline = torch.nn.Linear(2, 2)
    trainer.optimizers = SimpleNamespace(optimizers={}, schedulers={})
    trainer.grad_scaler = SimpleNamespace(state_dict=dict)
    trainer.config = SimpleNamespace(save_only_latest_checkpoint=True)
    return trainer


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_only_the_latest_checkpoint_is_kept_and_it_is_whole(trainer: AtomicTrainer) -> None:
    trainer.save_checkpoint(10)
    trainer.save_checkpoint(20)
    assert names(trainer.checkpoint_dir) == ["step-000000020.ckpt"]
    assert torch.load(trainer.checkpoint_dir / "step-000000020.ckpt")["step"] == 20


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
    assert names(trainer.checkpoint_dir.parent) == ["nerfstudio_models"]
    assert torch.load(trainer.checkpoint_dir / "step-000000030.ckpt")["step"] == 30
