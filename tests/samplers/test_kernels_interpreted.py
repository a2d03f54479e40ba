"""The tests of the kernels, in Triton's interpreter: on a machine without a GPU, every time.

Triton decides when it is imported whether it interprets, so they run in a process of their own.
"""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
NAMES = ["test_gate_kernel", "test_march_kernel"]


def run(*arguments: str, **variables: str) -> str:
    """What pytest says in a process of its own, with these variables alone on interpreting."""
    without = {name: value for name, value in os.environ.items() if name != "TRITON_INTERPRET"}
    finished = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *arguments],
        env={**without, **variables},
        cwd=HERE.parent.parent,
        capture_output=True,
        text=True,
        timeout=280,
    )
    assert finished.returncode == 0, finished.stdout[-4000:] + finished.stderr[-1000:]
    return finished.stdout


def test_kernels_agree_with_their_twins() -> None:
    pytest.importorskip("triton")
    files = [str(HERE / f"{name}.py") for name in NAMES]
    said = run(*files, TRITON_INTERPRET="1", OMP_NUM_THREADS="1")
    assert int(said.splitlines()[-1].split(" passed")[0]) > 50 and "skipped" not in said


@pytest.mark.parametrize("name", NAMES)
def test_they_are_those_that_a_gpu_is_asked_for(name: str) -> None:
    """Without the interpreter they have the mark `gpu`, and are skipped where there is none."""
    tests = importlib.import_module(f"samplers.{name}")
    assert tests.pytestmark == pytest.mark.gpu
    assert tests.DEVICE == "cuda"
