"""The picture of the package is the same each time that it is drawn."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import house
import pytest


def test_drawing_twice_gives_the_same_bytes(tmp_path: Path) -> None:
    """Here, and in a process in which sets of strings have another order."""
    files = [tmp_path / "a.svg", tmp_path / "b.svg"]
    house.main(["--out", str(files[0])])
    command = [sys.executable, house.__file__, "--out", str(files[1])]
    seed = "1" if os.environ.get("PYTHONHASHSEED") != "1" else "2"
    done = subprocess.run(command, env=os.environ | {"PYTHONHASHSEED": seed}, check=False)
    assert done.returncode == 0
    first, second = (file.read_bytes() for file in files)
    assert first == second and b"<svg" in first and b"dc:date" not in first


def test_another_format_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        house.main(["--out", str(tmp_path / "a.png")])
    assert "must end in .svg" in capsys.readouterr().err
