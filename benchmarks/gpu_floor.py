"""What a gate's decisions must cost at least on a card: bytes against bandwidth, operations against
the rate of bf16 matrix products; both ceilings are measured on the card itself."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch

from leco_plugin.models.gate import GateConfig

BYTES_PER_POSITION = 3 * 4 + 1
"""Three float32 in, one byte out."""


@dataclass(frozen=True)
class Ceilings:
    """What the card does at best."""

    bytes_per_second: float
    operations_per_second: float


def operations_per_position(config: GateConfig) -> int:
    """Multiplications and additions of the matrix products of a gate on frequencies, unpadded."""
    inputs = 3 + 6 * config.encoding.octaves
    hidden = inputs * config.width + (config.layers - 1) * config.width**2
    return 2 * (hidden + config.width * (1 + config.scene_experts))


def floor_seconds(config: GateConfig, positions: int, ceilings: Ceilings) -> dict[str, float]:
    """Both terms of the roofline for so many positions; the larger is the floor."""
    by_bytes = positions * BYTES_PER_POSITION / ceilings.bytes_per_second
    operations = positions * operations_per_position(config)
    by_operations = operations / ceilings.operations_per_second
    return {
        "bytes": by_bytes,
        "operations": by_operations,
        "floor": max(by_bytes, by_operations),
    }


def seconds(function: Callable[[], Any], device: torch.device, rounds: int) -> float:
    """Median time of a call, by device events on CUDA, after three calls that warm up."""
    for _ in range(3):
        function()
    times = []
    for _ in range(rounds):
        if device.type == "cuda":
            times.append(by_events(function))  # CUDA only
        else:
            started = time.perf_counter()
            function()
            times.append(time.perf_counter() - started)
    return statistics.median(times)


def by_events(function: Callable[[], Any]) -> float:
    """Seconds between two events of the device around a call."""
    begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))  # CUDA only
    begin.record()  # CUDA only
    function()  # CUDA only
    end.record()  # CUDA only
    end.synchronize()  # CUDA only
    return begin.elapsed_time(end) / 1e3  # CUDA only


def measure_ceilings(
    device: torch.device,
    size: int,
    rounds: int,
    dtype: torch.dtype = torch.bfloat16,
    values: int | None = None,
) -> Ceilings:
    """Copy bandwidth (read and written bytes) and rate of a square matrix product.

    Args:
        size: side of the matrices.
        dtype: of the matrices.
        values: float32 that are copied, more than caches hold; as many as a matrix has by default.
    """
    source = torch.zeros(values or size**2, device=device)
    target = torch.empty_like(source)
    copied = seconds(lambda: target.copy_(source), device, rounds)
    left = torch.randn(size, size, device=device).to(dtype)
    multiplied = seconds(lambda: left @ left, device, rounds)
    return Ceilings(2.0 * source.numel() * 4 / copied, 2.0 * size**3 / multiplied)
