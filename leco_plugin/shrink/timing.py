"""How much sooner a smaller gate answers than the original, in interleaved pairs."""

from __future__ import annotations

import statistics
import time

import torch

from leco_plugin.evaluation.clock import synchronize
from leco_plugin.evaluation.inspection import whole_box
from leco_plugin.occupancy import Occupancy

TIMED_POSITIONS, ROUNDS = 1 << 16, 15


def compare_queries(original: Occupancy, smaller: Occupancy) -> tuple[float, list[float]]:
    """How many times faster the smaller gate answers: median of interleaved pairs.

    Returns:
        the median of the pairs' ratios, and the median milliseconds of each.
    """
    box = whole_box(original)
    unit = torch.rand(TIMED_POSITIONS, 3, generator=torch.Generator().manual_seed(0))
    device = original.threshold_value.device
    positions = torch.lerp(box.low, box.high, unit).to(device)
    pairs = [
        tuple(_seconds(occupancy, positions) for occupancy in (original, smaller))
        for _ in range(ROUNDS)
    ][2:]
    ratio = statistics.median(before / after for before, after in pairs)
    return round(ratio, 2), [round(1e3 * statistics.median(times), 3) for times in zip(*pairs)]


def _seconds(occupancy: Occupancy, positions: torch.Tensor) -> float:
    synchronize()
    started = time.perf_counter()
    occupancy.occupied(positions)
    synchronize()
    return time.perf_counter() - started
