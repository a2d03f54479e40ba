"""A data-parallel run that loses a process ends in one line."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from torch.multiprocessing import ProcessExitedException, ProcessRaisedException

from leco_plugin.scenes.input_error import TrainingStopped
from leco_plugin.studio.processes import _launching_once


def config_of(checkpoints: Path) -> Any:
    machine = SimpleNamespace(num_devices=2)
    return SimpleNamespace(machine=machine, get_checkpoint_dir=lambda: checkpoints)


def launching(error: Exception) -> Any:
    def launch(config: Any) -> None:
        raise error

    script = SimpleNamespace(launch=launch, _distributed_worker=None)
    return _launching_once(script, launch)


def raised(line: str) -> ProcessRaisedException:
    return ProcessRaisedException(f"\n\nTraceback (most recent call last):\n{line}\n", 0, 7)


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (
            ProcessExitedException("it died", 1, 7, -9, "SIGKILL"),
            r"number 1 of .* lost \(SIGKILL\)",
        ),
        (ProcessExitedException("it died", 0, 7, 3), r"number 0 of 2 .* lost \(exit code 3\)"),
        (raised("RuntimeError: [..] Connection closed by peer [::1]:7"), "one of 2 processes"),
    ],
)
def test_a_lost_process_is_named(error: Exception, message: str, tmp_path: Path) -> None:
    with pytest.raises(TrainingStopped, match=f"{message}.*; no checkpoint was saved yet"):
        launching(error)(config=config_of(tmp_path))
    folder = tmp_path / "a run"
    folder.mkdir()
    (folder / "step-000000007.ckpt").touch()
    with pytest.raises(TrainingStopped, match=f"{message}.*--load-dir '{folder}'$") as caught:
        launching(error)(config=config_of(folder))
    assert "\n" not in str(caught.value)


def test_the_line_of_a_process_that_stopped_itself_is_the_line_of_the_run() -> None:
    error = raised("leco_plugin.scenes.input_error.TrainingStopped: step 3: a reason: another")
    with pytest.raises(TrainingStopped, match=r"^step 3: a reason: another$"):
        launching(error)(config=config_of(Path()))


def test_an_error_of_another_kind_stays_what_it_is() -> None:
    with pytest.raises(ProcessRaisedException):
        launching(raised("KeyError: 3"))(config=config_of(Path()))
