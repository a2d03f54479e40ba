"""Which runs a table needs: cases by samplers by seeds, each once however many cells share it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from leco_plugin.chart.contender import Contender, Job
from leco_plugin.stability.capture import Capture
from leco_plugin.stability.cases import Case
from leco_plugin.stability.contenders import OURS, SAMPLERS, Sampler, contender_of
from leco_plugin.stability.sizes import Sizes
from leco_plugin.stability.stage import Stage
from leco_plugin.stability.stages import STAGES


@dataclass(frozen=True)
class Run:
    """One run, on the scene of a name."""

    scene: str
    job: Job

    @property
    def key(self) -> tuple[str, str]:
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
    """All cells, case by case; a case that is about some samplers only has cells for those, and for
    the references that they are held against.

    Args:
        beside: seeds of the samplers that learned occupancy is compared with, also where a case
            is about seeds, of which only learned occupancy is run with more than were asked for;
            none is as for learned occupancy.
    """
    ours, asked = (OURS, SAMPLERS[OURS].reference), dict.fromkeys(seeds)
    entries = []
    for case in cases:
        wanted = {one.name for one in samplers if case.is_about(one.name)}
        wanted |= {one.reference for one in samplers if one.name in wanted and one.reference}
        for sampler in samplers:
            if sampler.name in wanted:
                contender = contender_of(
                    sampler, sizes, case.changes, case.settings, case.grid_levels
                )
                chosen = seeds_of(case, seeds) if sampler.name == OURS else tuple(asked)
                if beside and sampler.name not in ours:
                    chosen = tuple(dict.fromkeys(beside))
                entries.append(Entry(case, sampler, contender, chosen))
    return entries


def seeds_of(case: Case, seeds: Sequence[int]) -> tuple[int, ...]:
    """The seeds asked for, and more where a case is about them."""
    chosen = list(dict.fromkeys(seeds))
    more = (seed for seed in range(case.seeds + len(chosen)) if seed not in chosen)
    while len(chosen) < case.seeds:
        chosen.append(next(more))
    return tuple(chosen)


def runs_of(entries: Sequence[Entry]) -> list[Run]:
    """All runs, each once: all cells get their first seed before any gets its second."""
    most = max((len(entry.seeds) for entry in entries), default=0)
    found: dict[tuple[str, str], Run] = {}
    for number in range(most):
        for entry in entries:
            for run in entry.runs[number : number + 1]:
                found.setdefault(run.key, run)
    return list(found.values())


def scenes_of(cases: Sequence[Case], sizes: Sizes) -> dict[str, tuple[Stage, Capture]]:
    """The scenes of the cases by name."""
    return {case.scene: (STAGES[case.stage], capture_of(case, sizes)) for case in cases}


def capture_of(case: Case, sizes: Sizes) -> Capture:
    """A case's capture in pictures of the suite's size."""
    capture = case.capture
    views = capture.views if case.fixed_views else round(capture.views * sizes.views)
    return replace(
        capture,
        views=max(4, views),
        test_views=max(2, round(capture.test_views * sizes.views)),
        width=round(capture.width * sizes.picture),
        height=round(capture.height * sizes.picture),
    )
