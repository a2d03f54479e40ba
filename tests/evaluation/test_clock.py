"""Claims about the clock of a run and about when a run is over."""

from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path
from time import sleep
from typing import Any

import pytest
import torch

from leco_plugin.evaluation import clock as clock_module
from leco_plugin.evaluation.clock import (
    Budget,
    Clock,
    forget_peaks,
    peak_allocator_bytes,
    peak_process_bytes,
)


class Time:
    """Stands for the clocks of module `time`."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 100.0
        for clock in ("perf_counter", "process_time"):
            monkeypatch.setattr(clock_module.time, clock, lambda: self.now)


@pytest.fixture
def time(monkeypatch: pytest.MonkeyPatch) -> Time:
    return Time(monkeypatch)


def test_the_clock_stands_still_between_steps(time: Time) -> None:
    clock = Clock()
    for step in (2.0, 3.0):
        clock.start()
        time.now += step
        assert clock.stop() == step
        time.now += 50.0
    assert clock.seconds == clock.now() == 5.0


def test_a_look_at_a_running_clock_does_not_stop_it(time: Time) -> None:
    clock = Clock()
    clock.start()
    time.now += 2.0
    assert clock.now() == 2.0 and clock.seconds == 0.0
    time.now += 2.0
    clock.stop()
    assert clock.seconds == 4.0


@pytest.mark.skipif(torch.cuda.is_available(), reason="a GPU works outside of the process")
@pytest.mark.parametrize("threads", [1, 2])
def test_one_thread_counts_its_own_time(threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    clock = Clock()
    with clock.running():
        sleep(0.05)  # as when another process has the core
    assert (clock.seconds > 0.04) == (threads == 2)


def test_what_fails_is_counted_too(time: Time) -> None:
    clock = Clock()
    with pytest.raises(RuntimeError), clock.running():
        time.now += 3.0
        raise RuntimeError
    assert clock.seconds == 3.0


@pytest.mark.parametrize(
    ("budget", "seconds", "steps", "share"),
    [
        (Budget(10.0), 5.0, 999, 0.5),
        (Budget(None, 100), 1e9, 25, 0.25),
        (Budget(10.0, 100), 2.0, 50, 0.5),
        (Budget(10.0, 100), 9.0, 50, 0.9),
        (Budget(10.0, 100), 20.0, 0, 1.0),
    ],
)
def test_a_run_is_over_with_the_first_of_time_and_steps(
    budget: Budget, seconds: float, steps: int, share: float
) -> None:
    assert budget.share(seconds, steps) == share


@pytest.mark.parametrize("wrong", [0.0, -1.0, math.nan, math.inf])
def test_what_is_no_time_is_refused(wrong: float) -> None:
    with pytest.raises(ValueError, match="positive number"):
        Budget(wrong)
    with pytest.raises(ValueError, match="learn seconds"):
        Budget(1.0, learn_seconds=wrong)
    with pytest.raises(ValueError, match="--seconds or --steps"):
        Budget()


HELD = 200 * 2**20


def hold() -> bytearray:
    """Memory that is really there: every page is written."""
    held = bytearray(HELD)
    held[::4096] = b"x" * len(held[::4096])
    return held


def test_what_was_held_and_let_go_is_in_the_peak() -> None:
    hold()
    assert HELD < peak_process_bytes() < 64 * 2**30


def test_earlier_memory_is_in_no_later_peak(tmp_path: Path, monkeypatch: Any) -> None:
    if not forget_peaks():
        pytest.skip("this system keeps its mark")
    hold()
    with_it = peak_process_bytes()
    assert forget_peaks()
    assert peak_process_bytes() < with_it - HELD / 2
    monkeypatch.setattr(clock_module, "MARKS", tmp_path)  # a folder cannot be written
    assert not forget_peaks()


def test_memory_that_is_kept_for_later_is_in_no_later_peak() -> None:
    """Models on a CPU tell glibc to keep what is let go."""
    code = (
        "import torch; from leco_plugin.evaluation.clock import forget_peaks, peak_process_bytes; "
        "from leco_plugin.models.compute.device import keep_freed_memory; keep_freed_memory(); "
        f"before = peak_process_bytes(); held = [bytearray(b'x' * {HELD // 8}) for _ in range(8)]; "
        "last = bytearray(b'x'); del held; "
        "print(before, forget_peaks(), peak_process_bytes())"
    )
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", code], capture_output=True)
    before, can_forget, after = done.stdout.decode().split()
    if can_forget == "False":
        pytest.skip("this system keeps its mark")
    assert int(after) < int(before) + HELD / 2


def test_a_small_process_started_by_a_large_one_has_a_small_peak() -> None:
    held = hold()
    code = (
        "import sys, types; sys.modules['torch'] = types.ModuleType('torch'); "
        "from leco_plugin.evaluation.clock import peak_process_bytes; "
        "print(peak_process_bytes())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    if not clock_module.STATUS.exists():
        pytest.skip("this system keeps no mark of its own")
    assert int(done.stdout) < HELD / 2 < len(held)


def test_without_a_mark_the_usage_is_asked(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(clock_module, "STATUS", tmp_path / "none")
    assert 10 * 2**20 < peak_process_bytes() < 64 * 2**30


def test_the_allocator_has_a_peak_where_there_is_cuda() -> None:
    assert (peak_allocator_bytes() is None) == (not torch.cuda.is_available())
