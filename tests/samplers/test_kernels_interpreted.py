"""The tests of the kernels, in Triton's interpreter: on a machine without a GPU, every time.

Triton decides when it is imported whether it interprets, so they run in a process of their own.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

HERE = Path(__file__).parent
NAMES = ["test_gate_kernel.py", "test_march_kernel.py"]


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
    files = [str(HERE / name) for name in NAMES]
    said = run(*files, TRITON_INTERPRET="1", OMP_NUM_THREADS="1")
    assert " passed" in said and "skipped" not in said


@pytest.mark.skipif(torch.cuda.is_available(), reason="they run, compiled")
def test_they_are_those_that_a_gpu_is_asked_for() -> None:
    said = run("-m", "gpu", "-rs", *(str(HERE / name) for name in NAMES)).splitlines()
    assert int(said[-1].split(" skipped")[0]) > 60 and "passed" not in said[-1]
    assert any("there is no CUDA device" in line for line in said)
