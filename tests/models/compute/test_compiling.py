"""The routines in C are compiled once for a machine, and anew after a change that matters."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from leco_plugin.models.compute import compiling
from leco_plugin.models.compute.compiling import compiled

COMPILER = shutil.which("cc")

pytestmark = pytest.mark.skipif(COMPILER is None, reason="no C compiler")


class Compiler:
    """The machine's own, and how often it was started."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
        self.command = ["cc", "-shared", "-fPIC"]
        self.source = folder / "three.c"
        self.source.write_text("int three(void) { return 3; }\n")
        self.started = 0
        run = subprocess.run

        def counted(*arguments: Any, **options: Any) -> Any:
            self.started += 1
            return run(*arguments, **options)

        monkeypatch.setattr(compiling.subprocess, "run", counted)

    def __call__(self) -> int:
        """What the routine answers."""
        answer: int = compiled(self.command, [self.source]).three()
        return answer


@pytest.fixture
def compiler(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Compiler:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return Compiler(monkeypatch, tmp_path)


def kept(tmp_path: Path) -> list[Path]:
    return list((tmp_path / "cache" / "leco_plugin").iterdir())


def test_the_library_is_compiled_once(compiler: Compiler, tmp_path: Path) -> None:
    assert [compiler(), compiler()] == [3, 3]
    assert compiler.started == 1
    (file,) = kept(tmp_path)
    assert file.name.startswith("native-") and file.suffix == ".so"


def test_it_is_compiled_anew_for_other_sources_flags_headers_and_processors(
    compiler: Compiler, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiler()
    compiler.source.write_text("int three(void) { return 1 + 2; }\n")
    compiler()
    (tmp_path / "three.h").write_text("/* a header */")
    compiler()
    compiler.command.append("-O1")
    compiler()
    monkeypatch.setattr(compiling, "processor", lambda: ["another"])
    assert compiler() == 3
    assert compiler.started == len(kept(tmp_path)) == 5


def test_it_is_compiled_anew_by_a_compiler_that_has_been_updated(
    compiler: Compiler, tmp_path: Path
) -> None:
    wrapper = tmp_path / "a-compiler"
    wrapper.write_text(f'#!/bin/sh\nexec {COMPILER} "$@"\n')
    wrapper.chmod(0o755)
    compiler.command[0] = str(wrapper)
    compiler()
    os.utime(wrapper, (1e9, 1e9))
    assert [compiler(), compiler()] == [3, 3]
    assert compiler.started == 2


def test_a_damaged_library_is_made_anew(compiler: Compiler, tmp_path: Path) -> None:
    compiler()
    (file,) = kept(tmp_path)
    whole = file.read_bytes()
    for count, damaged in enumerate((b"", b"no library", whole[: len(whole) // 2], whole[:-1])):
        file.unlink()  # what is loaded keeps the old one
        file.write_bytes(damaged)
        file.chmod(0o600)
        assert compiler() == 3 and compiler.started == 2 + count
        assert kept(tmp_path) == [file] and len(file.read_bytes()) == len(whole)


def test_a_library_that_another_user_may_have_written_is_not_loaded(
    compiler: Compiler, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiler()
    (file,) = kept(tmp_path)
    assert file.stat().st_mode & 0o777 == 0o600 and file.parent.stat().st_mode & 0o777 == 0o700
    file.chmod(0o620)
    assert compiler() == 3 and compiler.started == 2
    file.unlink()
    file.symlink_to(tmp_path / "elsewhere.so")
    assert compiler() == 3 and compiler.started == 3 and not file.is_symlink()
    file.parent.chmod(0o777)
    assert compiler() == 3 and compiler.started == 4
    file.parent.chmod(0o700)
    assert compiler() == 3 and compiler.started == 4
    monkeypatch.setattr(compiling.os, "geteuid", lambda: -1)
    assert compiler() == 3 and compiler.started == 5


def test_without_a_folder_to_keep_it_each_process_compiles_it(
    compiler: Compiler, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "cache").touch()  # nothing can be written below a file
    assert [compiler(), compiler()] == [3, 3] and compiler.started == 2
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(compiling.os.path, "expanduser", lambda path: path)  # a user without a home
    assert compiling.cache_folder() is None
    assert compiler() == 3 and compiler.started == 3


def test_the_processor_is_described_alike_each_time() -> None:
    assert compiling.processor() == compiling.processor()
