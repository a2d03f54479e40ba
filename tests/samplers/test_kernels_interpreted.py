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


@pytest.mark.parametrize("name", NAMES)
def test_kernels_agree_with_their_twins(name: str) -> None:
    pytest.importorskip("triton")
    finished = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(HERE / name)],
        env={**os.environ, "TRITON_INTERPRET": "1", "OMP_NUM_THREADS": "1"},
        cwd=HERE.parent.parent,
        capture_output=True,
        text=True,
        timeout=280,
    )
    assert finished.returncode == 0, finished.stdout[-4000:] + finished.stderr[-1000:]
    assert " passed" in finished.stdout and "skipped" not in finished.stdout


@pytest.mark.skipif(torch.cuda.is_available(), reason="they run, compiled")
def test_they_are_those_that_a_gpu_is_asked_for() -> None:
    finished = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-m", "gpu", "-rs"]
        + [str(HERE / name) for name in NAMES],
        env={name: value for name, value in os.environ.items() if name != "TRITON_INTERPRET"},
        cwd=HERE.parent.parent,
        capture_output=True,
        text=True,
        timeout=280,
    )
    assert finished.returncode == 0, finished.stdout[-4000:] + finished.stderr[-1000:]
    said = finished.stdout.splitlines()
    assert int(said[-1].split(" skipped")[0]) > 80 and "passed" not in said[-1]
    assert any("there is no CUDA device" in line for line in said)
