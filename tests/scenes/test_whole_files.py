"""A file under its name is whole, whatever happens to the process that writes it."""

import os
from collections.abc import Callable
from io import FileIO
from pathlib import Path
from threading import Thread
from typing import Any, BinaryIO

import numpy as np
import pytest
import torch
from scene_files import refused

from leco_plugin.models.gate import Gate, GateConfig
from leco_plugin.occupancy import Occupancy
from leco_plugin.scenes.coloured_points import read_cloud
from leco_plugin.scenes.input_error import one_line
from leco_plugin.scenes.photograph_files import header_of
from leco_plugin.scenes.pt_file import read_pt
from leco_plugin.scenes.whole_files import PART, alone_in, check_place, remove_parts, write_whole
from leco_plugin.space import Space


def test_a_file_replaces_the_old_one_and_makes_its_folder(tmp_path: Path) -> None:
    path = tmp_path / "new" / "file"
    for text in (b"one", b"two"):
        write_whole(path, text)
        assert path.read_bytes() == text
    assert [p.name for p in path.parent.iterdir()] == ["file"]


def test_a_file_may_have_the_longest_name_that_there_is(tmp_path: Path) -> None:
    path = tmp_path / ("\u6d77" * 83 + ".jpg")  # 253 bytes of 255
    write_whole(path, b"whole")
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_a_failure_leaves_the_old_file_and_no_part(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"old")

    def fail(file: BinaryIO) -> None:
        file.write(b"half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_whole(path, fail)
    assert [(p.name, p.read_bytes()) for p in tmp_path.iterdir()] == [("file", b"old")]


def test_a_file_takes_the_place_of_no_folder_no_device_and_no_pipe(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OSError, match=f"^{tmp_path / 'pipe'} is a device or a pipe; give a file$"):
        write_whole(tmp_path / "pipe", b"")
    with pytest.raises(OSError, match=f"^{tmp_path} is a folder; give a file$"):
        Occupancy(Gate(GateConfig()), Space(), 0.5).save(tmp_path)
    assert (tmp_path / "pipe").is_fifo()
    for path in (Path("/dev/stdout"), tmp_path / "pipe"):
        with refused(f"^--json {path} is a device or a pipe; give a file$"):
            check_place("--json", path)


@pytest.mark.parametrize("save", [np.save, lambda file, values: torch.save(values, file)])
def test_a_disk_that_is_full_is_said_with_the_file(
    save: Callable[[Any, Any], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Full(FileIO):
        def write(self, _: Any) -> int:
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "open", lambda path, _: Full(path, "w"))
    with pytest.raises(OSError) as caught:
        write_whole(tmp_path / "file", lambda file: save(file, torch.zeros(9)))
    assert one_line(caught.value) == f"No space left on device: {tmp_path / 'file'}"
    assert not [*tmp_path.iterdir()]


def test_parts_of_killed_processes_are_found_at_any_depth(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / f".picture.png.12-34{PART}").write_bytes(b"")
    (tmp_path / "a" / "picture.png").write_bytes(b"")
    remove_parts(tmp_path)
    assert [p.name for p in tmp_path.rglob("*") if p.is_file()] == ["picture.png"]


@pytest.mark.parametrize("read", [header_of, read_cloud, read_pt])
def test_what_git_lfs_has_not_fetched_is_named(
    read: Callable[[Path], object], tmp_path: Path
) -> None:
    path = tmp_path / "0.jpg"
    path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n")
    with refused(r"0\.jpg .*is a pointer of Git LFS: `git lfs pull` fetches the file$"):
        read(path)


def test_two_threads_may_save_one_occupancy_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    occupancy, path = Occupancy(Gate(GateConfig()), Space(), 0.5), tmp_path / "o.safetensors"
    replace = Path.replace

    def after_another_thread(part: Path, whole: Path) -> Path:
        monkeypatch.undo()
        other = Thread(target=occupancy.save, args=(path,))
        other.start()
        other.join()
        return replace(part, whole)

    monkeypatch.setattr(Path, "replace", after_another_thread)
    occupancy.save(path)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    assert Occupancy.load(path).threshold == 0.5


def test_a_folder_that_cannot_be_written_is_named_with_the_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path, *_: int) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    def not_written(name: str, why: str) -> None:
        line = rf"into .*{name} \({why}\): name another folder with --out$"
        with refused(line), alone_in(tmp_path / name, "scene"):
            raise AssertionError

    (tmp_path / "file").touch()
    not_written("file", "File exists")
    not_written("file/scene", "Not a directory")
    monkeypatch.setattr(os, "open", refuse)
    not_written("read_only", "Permission denied")
