"""Which runs a table needs, each once however many cells share it, and how long they take.

Before any run is made, the time comes from stored figures: seconds of one core of the server that
made the stored table, with one thread.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from leco_plugin.chart.contender import Contender, Job
from leco_plugin.stability.cases import Case
from leco_plugin.stability.photographs import STAGES, YARD, Capture
from leco_plugin.stability.samplers import (
    DENSE,
    DENSE_PROPOSAL,
    GRID,
    LEARNED,
    PROPOSALS,
    RAYS,
    Sampler,
    Sizes,
    contender_of,
    with_references,
)
from leco_plugin.stability.scene import Stage

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
"""Of a step of a guided host, however few its rays are; in the above for those that skip least."""
RENDERED, RENDERING = 18_500, 0.45
"""Rays that are looked at after a run in full sizes, each for this share of a ray of training."""
LEARNED_RAY_SECONDS, FREEZE_SECONDS = 3.0e-4, 5.0
"""A ray of a step of learning; to calibrate a gate and to build its cell cache."""
FIRST_CELL_SECONDS, CELL_SECONDS = 1.2e-5, 3.3e-6
"""To ask the field about a cell of an occupancy grid for the first time, and later."""
STEPS_PER_UPDATE, FULL_UPDATES, LATER_SHARE = 16, 16, 0.3
"""An occupancy grid asks about every cell so many times, then about so large a share of them."""


Key = tuple[str, str]
"""Scene and name of a run."""


@dataclass(frozen=True)
class Run:
    """One run, on the scene of a name."""

    scene: str
    job: Job

    @property
    def key(self) -> Key:
        """The same for what is run once however many cells share it."""
        return self.scene, self.job.name


@dataclass(frozen=True)
class Entry:
    """One cell of the table before anything is known of it."""

    case: Case
    sampler: Sampler
    contender: Contender
    seeds: tuple[int, ...]

    @property
    def runs(self) -> list[Run]:
        """Those that it is made of."""
        return [Run(self.case.scene, Job(self.contender, seed)) for seed in self.seeds]


def entries_of(
    cases: Sequence[Case],
    samplers: Sequence[Sampler],
    seeds: Sequence[int],
    sizes: Sizes,
    beside: Sequence[int] = (),
) -> list[Entry]:
    """All cells, case by case, with the references that they are held against.

    Args:
        seeds: of each cell. Learned occupancy has more where a case is about seeds.
        beside: seeds of the samplers that learned occupancy is compared with; none is `seeds`.
    """
    entries = []
    for case in cases:
        wanted = with_references({one.name for one in samplers if case.is_about(one.name)})
        for sampler in samplers:
            if sampler in wanted:
                levels = case.grid_levels
                one = contender_of(sampler, sizes, case.changes, case.settings, levels)
                chosen = tuple(dict.fromkeys(seeds))
                if sampler.name == LEARNED:
                    missing = case.seeds - len(chosen)
                    more = (seed for seed in range(case.seeds) if seed not in chosen)
                    chosen += tuple(more)[: max(missing, 0)]
                elif beside and sampler.name != DENSE:
                    chosen = tuple(dict.fromkeys(beside))
                entries.append(Entry(case, sampler, one, chosen))
    return entries


def runs_of(entries: Sequence[Entry]) -> list[Run]:
    """All runs, each once: all cells get their first seed before any gets its second."""
    most = max((len(entry.seeds) for entry in entries), default=0)
    found: dict[Key, Run] = {}
    for number in range(most):
        for entry in entries:
            for run in entry.runs[number : number + 1]:
                found.setdefault(run.key, run)
    return list(found.values())


def scenes_of(cases: Sequence[Case], sizes: Sizes) -> dict[str, tuple[Stage, Capture]]:
    """The scenes of the cases by name."""
    return {case.scene: (STAGES.get(case.name, YARD), capture_of(case, sizes)) for case in cases}


def capture_of(case: Case, sizes: Sizes) -> Capture:
    """A case's capture in pictures of the suite's size."""
    capture = case.capture
    is_fixed = capture.views != Capture.views
    views = capture.views if is_fixed else round(capture.views * sizes.views)
    return replace(
        capture,
        views=max(4, views),
        test_views=max(2, round(capture.test_views * sizes.views)),
        width=round(capture.width * sizes.picture),
        height=round(capture.height * sizes.picture),
    )


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
    kind = GRID if contender.sampler.startswith(f"{GRID}-") else contender.sampler
    rays = sizes.steps * contender.settings[RAYS] + RENDERED * sizes.picture**2 * RENDERING
    seconds = START_SECONDS + rays * RAY_SECONDS[kind]
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
