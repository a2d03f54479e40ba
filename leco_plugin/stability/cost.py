"""How long a table takes: before its first run from stored figures, then from its own runs.

The figures are seconds of one core of the server that made the stored table, with one thread.
"""

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
from leco_plugin.stability.sizes import Sizes

START_SECONDS = 14.0
"""For a process to start, to read the scene and to build the host."""
RAY_SECONDS: Mapping[str, float] = {
    LEARNED: 1.8e-4,
    GRID: 5.1e-4,
    PROPOSALS: 8.2e-4,
    DENSE: 13.0e-4,
    DENSE_PROPOSAL: 11.2e-4,
}
"""Of training, a ray of a step, where steps have two hundred."""
STEP_SECONDS = 0.042
"""Of a step of a guided host, however few its rays are: of those that skip least it is lost in the
above."""
RENDERED = 18_500
"""Rays that are looked at when a run in full sizes has ended..."""
RENDERING = 0.45
"""...each for this share of what it takes to train on it."""
LEARNED_RAY_SECONDS = 3.0e-4
"""A ray of a step of learning."""
FREEZE_SECONDS = 5.0
"""To calibrate a gate and to build its cell cache."""
FIRST_CELL_SECONDS = 1.2e-5
"""To ask the field about a cell of an occupancy grid for the first time, with memory to fetch..."""
CELL_SECONDS = 3.3e-6
"""...and later."""
STEPS_PER_UPDATE = 16
"""Of an occupancy grid..."""
FULL_UPDATES = 16
"""...which asks about every cell so many times..."""
LATER_SHARE = 0.3
"""...and then about a quarter of them, and about those that are occupied."""


def core_seconds(runs: Sequence[Run], stored: Sequence[Mapping[str, Any]], sizes: Sizes) -> float:
    """What some runs take of one core, seconds.

    Args:
        runs: to be made.
        stored: records of runs that were made; what they took replaces the stored figures.
    """
    measured: dict[str, list[float]] = {}
    for record in stored:
        measured.setdefault(record["sampler"], []).append(float(record["processor_seconds"]))
    means = {name: sum(seconds) / len(seconds) for name, seconds in measured.items()}
    return sum(means.get(run.job.contender.sampler) or expected_seconds(run, sizes) for run in runs)


def expected_seconds(run: Run, sizes: Sizes) -> float:
    """What a run takes before any like it was made."""
    contender = run.job.contender
    rays = contender.settings["pipeline.datamanager.train_num_rays_per_batch"]
    kind = GRID if contender.sampler.startswith(f"{GRID}-") else contender.sampler
    rendered = RENDERED * sizes.picture**2 * RENDERING
    seconds = START_SECONDS + (sizes.steps * rays + rendered) * RAY_SECONDS[kind]
    if kind == LEARNED:
        learning = contender.changes["occupancy.rays"] * sizes.learn_steps
        seconds += FREEZE_SECONDS + learning * LEARNED_RAY_SECONDS + sizes.steps * STEP_SECONDS
    if kind == GRID:
        options = contender.changes["occupancy.options"]
        cells = options["levels"] * options["resolution"] ** 3
        updates = -(-sizes.steps // STEPS_PER_UPDATE)
        full = min(updates, FULL_UPDATES)
        again = full - 1 + LATER_SHARE * (updates - full)
        seconds += cells * (FIRST_CELL_SECONDS + again * CELL_SECONDS)
    return float(seconds)


def in_words(seconds: float) -> str:
    """A time for people."""
    minutes = seconds / 60.0
    if minutes < 2.0:
        return f"{seconds:.0f} s"
    return f"{minutes:.0f} minutes" if minutes < 120.0 else f"{minutes / 60.0:.1f} hours"
