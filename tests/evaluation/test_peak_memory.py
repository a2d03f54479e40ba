"""Claims about the peak of a process's memory."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import torch

from leco_plugin.evaluation import peak_memory
from leco_plugin.evaluation.peak_memory import peak_allocator_bytes, peak_process_bytes

HELD = 200 * 2**20


def test_what_was_held_and_let_go_is_in_the_peak() -> None:
    held = bytearray(HELD)
    held[::4096] = b"x" * len(held[::4096])
    del held
    assert HELD < peak_process_bytes() < 64 * 2**30


def test_a_small_process_started_by_a_large_one_has_a_small_peak() -> None:
    held = bytearray(HELD)
    held[::4096] = b"x" * len(held[::4096])
    code = (
        "import sys, types; sys.modules['torch'] = types.ModuleType('torch'); "
        "from leco_plugin.evaluation.peak_memory import peak_process_bytes; "
        "print(peak_process_bytes())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    if not peak_memory.STATUS.exists():
        pytest.skip("this system keeps no mark of its own")
    assert int(done.stdout) < HELD / 2


def test_without_the_kernels_mark_the_usage_is_asked(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(peak_memory, "STATUS", tmp_path / "none")
    assert 10 * 2**20 < peak_process_bytes() < 64 * 2**30


def test_the_allocator_has_a_peak_where_there_is_cuda() -> None:
    assert (peak_allocator_bytes() is None) == (not torch.cuda.is_available())
