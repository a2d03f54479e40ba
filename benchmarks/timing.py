"""Interleaved timing: what is compared runs in turn, so that a busy machine slows all alike."""

from __future__ import annotations

import platform
import statistics
import time
from collections.abc import Callable
from typing import Any

import checkout  # noqa: F401
import torch

from leco_plugin.evaluation.report import processor_name

Timings = dict[str, list[float]]


def time_interleaved(functions: dict[str, Callable[[], Any]], rounds: int) -> Timings:
    """Seconds of each function in each round, after one round that warms up."""
    seconds: Timings = {name: [] for name in functions}
    for round_number in range(rounds + 1):
        for name, function in functions.items():
            _wait()
            start = time.perf_counter()
            function()
            _wait()
            if round_number:
                seconds[name].append(time.perf_counter() - start)
    return seconds


def ratio(timings: Timings, name: str, base: str) -> float:
    """Median over rounds of the time of one function over that of another in the same round."""
    pairs = zip(timings[name], timings[base], strict=True)
    return statistics.median(one / other for one, other in pairs)


def milliseconds(timings: Timings) -> dict[str, float]:
    """Median of each function, ms."""
    return {name: round(statistics.median(times) * 1e3, 3) for name, times in timings.items()}


def machine() -> dict[str, Any]:
    """What the figures were measured on."""
    return {
        "processor": processor_name(),
        "threads": torch.get_num_threads(),
        "accelerator": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "amx": bool(torch.cpu._is_amx_tile_supported()),
        "torch": torch.__version__,
        "python": platform.python_version(),
    }


def _wait() -> None:
    if torch.cuda.is_available():
        torch.cuda.synchronize()
