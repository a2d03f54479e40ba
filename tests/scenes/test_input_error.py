"""An error of the user ends commands in one line, and can be caught like any other."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from leco_plugin.scenes.input_error import InputError


def test_a_notebook_survives_it() -> None:
    assert issubclass(InputError, ValueError) and not issubclass(InputError, SystemExit)


@pytest.mark.parametrize(
    ("program", "error", "said"),
    [
        ("ns-train", "InputError('a line')", "a line\n"),
        ("ns-train", "ValueError('a line')", "Traceback"),
        ("notebook", "InputError('a line')", "Traceback"),
    ],
)
def test_ns_commands_end_in_its_line(program: str, error: str, said: str, tmp_path: Path) -> None:
    script = tmp_path / program
    script.write_text(f"from leco_plugin.scenes.input_error import InputError\nraise {error}\n")
    done = subprocess.run([sys.executable, script], capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr == said if said != "Traceback" else done.stderr.startswith(said)
