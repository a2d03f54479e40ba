"""Training time and peak memory: a clock that stops during evaluation, and the end of a run."""

from __future__ import annotations

import ctypes
import gc
import math
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import torch

STATUS, MARKS = Path("/proc/self/status"), Path("/proc/self/clear_refs")
RESET_PEAK = "5"
"""Written to `MARKS`, it lowers the kernel's mark of the peak to what is held now: see proc(5)."""


def seconds_now() -> float:
    """Seconds of the process if it works on a CPU in one thread: other processes do not lengthen
    them. Elsewhere seconds of the wall's clock. Only differences mean something."""
    alone = not torch.cuda.is_available() and torch.get_num_threads() == 1
    return time.process_time() if alone else time.perf_counter()


class Clock:
    """Counts `seconds_now` between `start` and `stop`; waits for the device at both."""

    def __init__(self) -> None:
        self.seconds = 0.0
        self._started: float | None = None

    def start(self) -> None:
        synchronize()
        self._started = seconds_now()

    def stop(self) -> float:
        """Stops; returns the seconds since the start."""
        passed = self.now() - self.seconds
        self.seconds += passed
        self._started = None
        return passed

    @contextmanager
    def running(self) -> Iterator[None]:
        """Counts what is done meanwhile, also if it fails."""
        self.start()
        try:
            yield
        finally:
            self.stop()

    def now(self) -> float:
        """Seconds so far, the step under way included."""
        if self._started is None:
            return self.seconds
        synchronize()
        return self.seconds + seconds_now() - self._started


def synchronize() -> None:
    """Waits for the device, so that a time belongs to what was timed."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def warm_up(device: torch.device | str) -> None:
    """Keeps the device busy for a moment, so that the first step does not pay for its start-up."""
    weights = torch.zeros(64, 64, device=device, requires_grad=True)
    end = time.perf_counter() + 0.2
    while time.perf_counter() < end:
        product = torch.ones(4096, 64, device=device) @ weights
        product.relu().sum().backward()
        synchronize()


@dataclass(frozen=True)
class Budget:
    """When a run is over: after so much time or so many steps, whichever comes first."""

    seconds: float | None = None
    steps: int | None = None
    learn_seconds: float | None = None
    """Limit, about, for learning an occupancy; None leaves it to the method."""

    def __post_init__(self) -> None:
        if self.seconds is None and self.steps is None:
            raise ValueError("a run needs an end: give --seconds or --steps")
        limits = {"seconds": self.seconds, "steps": self.steps, "learn seconds": self.learn_seconds}
        for name, limit in limits.items():
            if limit is not None and not 0.0 < limit < math.inf:
                raise ValueError(f"the training {name} are a positive number, not {limit}")

    def share(self, seconds: float, steps: int) -> float:
        """How much of the budget is used, in [0, 1]; at 1 the run is over."""
        of = ((seconds, self.seconds), (steps, self.steps))
        return min(1.0, max(used / limit for used, limit in of if limit is not None))


def peak_process_bytes() -> int:
    """Highest resident memory of this process so far.

    The kernel's own mark where there is one: `getrusage` starts with the peak of the process that
    started this one.
    """
    try:
        for line in STATUS.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass
    import resource

    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def forget_peaks() -> bool:
    """Makes later peaks those of what follows; what is in use now counts. Returns whether the
    system can do so."""
    gc.collect()
    with suppress(OSError, AttributeError):  # no glibc
        ctypes.CDLL("libc.so.6").malloc_trim(0)  # our models on a CPU keep memory that is free
    if torch.cuda.is_available():
        torch.cuda.reset_peak_memory_stats()
    try:
        MARKS.write_text(RESET_PEAK)
    except OSError:
        return False
    return True


def peak_allocator_bytes() -> int | None:
    """Highest memory that tensors on CUDA have held; None without CUDA."""
    return int(torch.cuda.max_memory_allocated()) if torch.cuda.is_available() else None
