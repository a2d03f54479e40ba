"""Claims about `leco_plugin.studio.checkpoints`."""

from __future__ import annotations

import os
import pickle
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from nerfstudio.engine.optimizers import AdamOptimizerConfig, Optimizers
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig

from leco_plugin.studio.checkpoints import allow_checkpoint_globals

pytestmark = pytest.mark.skipif(
    torch.__version__ < "2.6", reason="this torch loads nerfstudio's checkpoints as they are"
)


@pytest.fixture(autouse=True)
def _nothing_allowed() -> Iterator[None]:
    """Runs each test with torch's own list of allowed globals, and puts back what stood there."""
    before = torch.serialization.get_safe_globals()
    torch.serialization.clear_safe_globals()
    yield
    torch.serialization.clear_safe_globals()
    torch.serialization.add_safe_globals(before)


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    """What nerfstudio's trainer saves after a few steps, with the scheduler of most methods."""
    weight = torch.nn.Parameter(torch.ones(2))
    scheduler = ExponentialDecaySchedulerConfig(lr_final=1e-4, max_steps=10)
    config = {"optimizer": AdamOptimizerConfig(lr=1e-2), "scheduler": scheduler}
    optimizers = Optimizers({"fields": config}, {"fields": [weight]})
    for step in range(3):
        weight.sum().backward()
        optimizers.optimizer_step_all()
        optimizers.scheduler_step_all(step)
    state = {
        "step": 3,
        "pipeline": {"weight": weight.detach()},
        "optimizers": {name: opt.state_dict() for name, opt in optimizers.optimizers.items()},
        "schedulers": {name: sched.state_dict() for name, sched in optimizers.schedulers.items()},
    }
    path = tmp_path / "step-000000003.ckpt"
    torch.save(state, path)
    return path


def test_a_checkpoint_of_nerfstudio_loads(checkpoint: Path) -> None:
    allow_checkpoint_globals()
    state = torch.load(checkpoint)
    assert state["step"] == 3
    assert 1e-4 < state["schedulers"]["fields"]["_last_lr"][0] < 1e-2


def test_every_entry_of_the_list_is_needed(checkpoint: Path) -> None:
    allow_checkpoint_globals()
    allowed = torch.serialization.get_safe_globals()
    refused = 0
    for left_out in range(len(allowed)):
        torch.serialization.clear_safe_globals()
        torch.serialization.add_safe_globals(allowed[:left_out] + allowed[left_out + 1 :])
        try:
            torch.load(checkpoint)
        except pickle.UnpicklingError:
            refused += 1
    other_numpy = 1  # the address under which the other major release pickles the same function
    assert refused == len(allowed) - other_numpy


def test_a_checkpoint_from_the_other_numpy_loads(checkpoint: Path, tmp_path: Path) -> None:
    """numpy 2 writes numpy._core where numpy 1 writes numpy.core."""
    addresses = [b"numpy.core.multiarray", b"numpy._core.multiarray"]
    here, there = addresses if np.__version__.startswith("1.") else addresses[::-1]
    moved = tmp_path / "moved.ckpt"
    with zipfile.ZipFile(checkpoint) as original, zipfile.ZipFile(moved, "w") as copy:
        for entry in original.infolist():
            copy.writestr(entry.filename, original.read(entry).replace(here, there))
    assert there in moved.read_bytes()
    allow_checkpoint_globals()
    assert torch.load(moved)["schedulers"] == torch.load(checkpoint)["schedulers"]


def test_allowing_twice_changes_nothing() -> None:
    allow_checkpoint_globals()
    once = torch.serialization.get_safe_globals()
    allow_checkpoint_globals()
    assert len(torch.serialization.get_safe_globals()) == len(once)


class _RunsACommand:
    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, (f"touch '{self.marker}'",)


def test_a_checkpoint_that_would_run_a_command_is_refused(tmp_path: Path) -> None:
    allow_checkpoint_globals()
    marker = tmp_path / "it-ran"
    torch.save({"step": 0, "pipeline": _RunsACommand(marker)}, tmp_path / "bad.ckpt")
    with pytest.raises(pickle.UnpicklingError):
        torch.load(tmp_path / "bad.ckpt")
    assert not marker.exists()


@pytest.mark.parametrize(
    "value", [np.int64(1), np.float32(1), np.datetime64("2024-01-01"), np.ones(2)]
)
def test_no_other_numpy_value_is_allowed(value: Any, tmp_path: Path) -> None:
    allow_checkpoint_globals()
    torch.save({"value": value}, tmp_path / "other.ckpt")
    with pytest.raises(pickle.UnpicklingError):
        torch.load(tmp_path / "other.ckpt")
