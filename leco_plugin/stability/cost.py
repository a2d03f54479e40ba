"""How long a table takes: before its first run from stored figures, then from its own runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from leco_plugin.stability.contenders import (
    DENSE,
    DENSE_PROPOSAL,
    GRID,
    LEARNED,
    PROPOSALS,
)
from leco_plugin.stability.plan import Run

START_SECONDS = 12.0
"""Of a core, for a process to start, to read the scene and to build the host."""
CORE_SECONDS: Mapping[str, float] = {
    LEARNED: 60.0,
    f"{GRID}-128": 60.0,
    f"{GRID}-256": 240.0,
    PROPOSALS: 60.0,
    DENSE: 75.0,
    DENSE_PROPOSAL: 75.0,
}
"""Of a core, for a run of the full size after its start."""


def core_seconds(
    runs: Sequence[Run], stored: Sequence[Mapping[str, Any]], share: float = 1.0
) -> float:
    """What some runs take of one core, seconds.

    Args:
        runs: to be made.
        stored: records of runs that were made; what they took replaces the stored figure of their
            sampler.
        share: of the work of a run of full size.
    """
    measured: dict[str, list[float]] = {}
    for record in stored:
        measured.setdefault(record["sampler"], []).append(float(record["processor_seconds"]))
    total = 0.0
    for run in runs:
        known = measured.get(run.job.contender.sampler)
        if known:
            total += START_SECONDS + sum(known) / len(known)
        else:
            total += START_SECONDS + share * CORE_SECONDS[run.job.contender.sampler]
    return total


def in_words(seconds: float) -> str:
    """A time for people."""
    minutes = seconds / 60.0
    if minutes < 2.0:
        return f"{seconds:.0f} s"
    return f"{minutes:.0f} minutes" if minutes < 120.0 else f"{minutes / 60.0:.1f} hours"
