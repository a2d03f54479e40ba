"""Two runs never share a folder, and a new one never takes an old one's."""

from __future__ import annotations

import copy
import functools
import os
import signal
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from forked_commands import ForkedCommands

from leco_plugin.host_configs import leco_ngp
from leco_plugin.method_configs import leco_occupancy
from leco_plugin.scenes import whole_files
from leco_plugin.scenes.input_error import InputError
from leco_plugin.studio.run_folder import TrainerRun, claim, release

HOLD = """
import sys
from pathlib import Path
from leco_plugin.studio.run_folder import claim
folder = Path(sys.argv[1])
print(claim(folder, folder / "checkpoints", None), flush=True)
"""
"""Claims a folder, says what came of it, and ends."""
KEEP = HOLD + "import signal\nsignal.pause()\n"
"""The same, and keeps it until it dies."""

IN_FORKS = pytest.mark.xdist_group("commands")


@pytest.fixture
def folder(tmp_path: Path):
    yield tmp_path / "run"
    release(tmp_path / "run")


@IN_FORKS
def test_a_folder_in_which_a_run_goes_on_is_refused_until_that_run_is_dead(
    command: ForkedCommands, folder: Path, tmp_path: Path
) -> None:
    (tmp_path / "keep.py").write_text(KEEP)
    other = command.start("python", tmp_path / "keep.py", folder)
    try:
        other.until(lambda: other.log.read_text().endswith("None\n"))
        assert "another run is going on" in (claim(folder, folder / "checkpoints", None) or "")
    finally:
        os.kill(other.process, signal.SIGKILL)  # the system lets go of the lock
        assert other.wait() == -signal.SIGKILL
    assert claim(folder, folder / "checkpoints", None) is None
    assert claim(folder, folder / "checkpoints", None) is None  # this run's already


@IN_FORKS
def test_a_run_that_ends_by_itself_leaves_no_lock_and_one_that_has_it_keeps_it(
    command: ForkedCommands, folder: Path, tmp_path: Path
) -> None:
    (tmp_path / "hold.py").write_text(HOLD)
    assert command("python", tmp_path / "hold.py", folder).endswith("None\n")
    assert list(folder.iterdir()) == []
    assert claim(folder, folder / "checkpoints", None) is None
    refused = command("python", tmp_path / "hold.py", folder)
    assert "another run is going on" in refused
    assert [path.name for path in folder.iterdir()] == [whole_files.LOCK]
    release(folder)
    assert list(folder.iterdir()) == []


def test_a_lock_that_goes_away_is_made_anew(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder.mkdir()
    flock, opened = whole_files.fcntl.flock, []

    def late(held: int, how: int) -> None:
        opened.append(held)
        if len(opened) == 1:  # who held it ends between this one's opening and locking
            (folder / whole_files.LOCK).unlink()
        flock(held, how)

    monkeypatch.setattr(whole_files.fcntl, "flock", late)
    held = whole_files.lock(folder)
    assert len(opened) == 2 and held is not None
    assert os.path.samestat(os.stat(folder / whole_files.LOCK), os.fstat(held))
    assert whole_files.lock(folder) is None
    os.close(held)


def test_a_lock_holds_on_odd_file_systems(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder.mkdir()
    monkeypatch.setattr(whole_files, "_lies_in", lambda *_: False)
    held = whole_files.lock(folder)
    assert held is not None and whole_files.lock(folder) is None
    os.close(held)


def test_a_folder_in_which_nothing_can_be_written_is_said_in_one_line(folder: Path) -> None:
    folder.parent.joinpath("file").touch()
    beneath = folder.parent / "file" / "run"
    with pytest.raises(InputError, match=r"nothing can be written into .*name another folder with"):
        claim(beneath, beneath / "checkpoints", None)


def test_a_full_disk_is_said_before_the_run(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> int:
        raise OSError(28, "No space left on device")

    config = copy.deepcopy(leco_occupancy.config)
    config.output_dir, config.experiment_name, config.timestamp = folder, "one", "now"
    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(InputError, match=r"nothing can be written into .*No space left.*another"):
        config.save_config()


def test_a_new_run_does_not_take_a_folder_with_checkpoints(folder: Path) -> None:
    checkpoints = folder / "checkpoints"
    checkpoints.mkdir(parents=True)
    assert claim(folder, checkpoints, None) is None
    left = checkpoints / "step-000000010.ckpt"
    left.touch()
    assert "holds an earlier run" in (claim(folder, checkpoints, None) or "")
    assert "holds an earlier run" in (claim(folder, checkpoints, folder / "others") or "")
    assert claim(folder, checkpoints, checkpoints) is None
    assert claim(folder, checkpoints, left) is None


def test_a_new_run_does_not_take_the_occupancy_of_one_that_saved_nothing(folder: Path) -> None:
    folder.mkdir()
    (folder / "occupancy.safetensors").touch()
    assert "holds an earlier run" in (claim(folder, folder / "checkpoints", None) or "")
    assert claim(folder, folder / "checkpoints", folder / "checkpoints") is None


def test_a_config_goes_to_a_folder_of_its_own_and_says_so(tmp_path: Path, printed: Any) -> None:
    def config():
        made = copy.deepcopy(leco_occupancy.config)
        made.output_dir, made.experiment_name, made.timestamp = tmp_path, "tiny", "run"
        made.save_config()
        return made

    first = config()
    assert first.timestamp == "run"
    first.get_checkpoint_dir().mkdir()
    (first.get_checkpoint_dir() / "step-000000003.ckpt").touch()
    before = (first.get_base_dir() / "config.yml").read_text()
    second = config()
    assert second.timestamp == "run-2" and (second.get_base_dir() / "config.yml").exists()
    assert (first.get_base_dir() / "config.yml").read_text() == before
    assert "this run goes to" in printed()
    for made in (first, second):
        release(made.get_base_dir())


def test_of_a_folder_and_a_checkpoint_the_folder_is_gone_on_with(tmp_path: Path) -> None:
    """As nerfstudio has it: the files of the other run are of another gate."""
    made = copy.deepcopy(leco_occupancy.config)
    made.output_dir, made.experiment_name, made.timestamp = tmp_path, "tiny", "run"
    made.load_dir, made.load_checkpoint = made.get_checkpoint_dir(), tmp_path / "other.ckpt"
    made.load_dir.mkdir(parents=True)
    (made.load_dir / "step-000000003.ckpt").touch()
    made.save_config()
    assert made.timestamp == "run"
    trainer = SimpleNamespace(config=made, base_dir=made.get_base_dir(), _start_step=4)
    assert TrainerRun(trainer).resumed_from == made.load_dir
    release(made.get_base_dir())


@pytest.mark.parametrize(
    ("method", "option"),
    [
        (leco_occupancy, "pipeline.datamanager.train-num-rays-per-batch"),
        (leco_occupancy, "pipeline.model.eval-num-rays-per-chunk"),
        (leco_ngp, "pipeline.fewest-rays"),
        (leco_ngp, "pipeline.most-rays"),
    ],
)
def test_a_batch_without_rays_is_refused_before_the_run(method: Any, option: str) -> None:
    config: Any = copy.deepcopy(method.config)
    *parts, name = option.replace("-", "_").split(".")
    setattr(functools.reduce(getattr, parts, config), name, 0)
    with pytest.raises(InputError, match=f"--{option} is 0; it must be at least 1"):
        config.set_timestamp()
    setattr(functools.reduce(getattr, parts, config), name, 1)
    config.set_timestamp()
