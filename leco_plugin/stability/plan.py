"""Which samplers are compared, each in a host; which runs a table needs; and how long they take.

The sizes, rays and steps are the same for all samplers. A sampler is held against the dense
reference of its own host: Instant-NGP, or Nerfacto for proposal networks.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest
from statistics import fmean
from typing import TYPE_CHECKING, Any, NamedTuple

from leco_plugin.chart.contender import Contender, Job
from leco_plugin.hosts.guided_start import OWN_SAMPLER
from leco_plugin.names import unknown_name
from leco_plugin.scenes.input_error import InputError
from leco_plugin.stability.photographs import STAGES, YARD, Capture
from leco_plugin.stability.scene import Stage

if TYPE_CHECKING:
    from leco_plugin.stability.cases import Case

LEARNED, DENSE, PROPOSALS, GRID = "learned", "dense", "proposal-networks", "grid"
DENSE_PROPOSAL = "dense-proposal"
GRIDS = (128, 256)
DENSE_LEVELS = 5
"""The reference samples in a box 2^4 times as wide as the one that was guessed."""
RAYS = "pipeline.datamanager.train_num_rays_per_batch"


@dataclass(frozen=True)
class Sizes:
    """Of pictures, hosts and runs."""

    steps: int
    """Training steps of each host; learning an occupancy comes before them."""
    rays: int
    """Of a batch."""
    learn_rays: int
    """Of a batch while the occupancy is learned."""
    learn_steps: int
    """Most steps of learning."""
    picture: float = 1.0
    """Multiple of the pictures' width and height."""
    views: float = 1.0
    """Multiple of the number of training pictures, where a case does not fix it."""
    dense_samples: int = 192
    """Of a ray of the dense reference of proposal hosts."""
    table: int = 15
    """Binary logarithm of the entries of the hosts' hash tables."""

    def host(self, in_nerfacto: bool) -> dict[str, Any]:
        """Nerfacto, or Instant-NGP with steps that grow with the distance: its rays end well beyond
        the scene."""
        sizes = {"host.log2_hashmap_size": self.table, "host.max_res": 512, "host.far_plane": 20.0}
        if in_nerfacto:
            return {**sizes, "host.use_appearance_embedding": False}
        return {**sizes, "host.grid_levels": 1, "host.cone_angle": 1 / 32}


FULL = Sizes(steps=720, rays=96, learn_rays=384, learn_steps=200)
"""The stored table takes two cores a few hours in these."""
QUICK = Sizes(
    steps=40, rays=64, learn_rays=64, learn_steps=20, picture=0.5, views=0.4, dense_samples=48
)
"""For a look at whether everything works; its verdicts mean little."""


@dataclass(frozen=True)
class Sampler:
    """One column of the table."""

    name: str
    title: str
    """In the table."""
    reference: str | None
    """The dense reference of its host; None is one."""


SAMPLERS = {
    one.name: one
    for one in (
        Sampler(LEARNED, "learned occupancy", DENSE),
        *(Sampler(f"{GRID}-{n}", f"grid {n}³", DENSE) for n in GRIDS),
        Sampler(PROPOSALS, "proposal networks", DENSE_PROPOSAL),
        Sampler(DENSE, "dense (Instant-NGP)", None),
        Sampler(DENSE_PROPOSAL, "dense (Nerfacto)", None),
    )
}


def samplers_named(names: tuple[str, ...]) -> list[Sampler]:
    """The samplers of these names and the references they are held against, in the table's order;
    an `InputError` for an unknown name."""
    unknown = [name for name in names if name not in SAMPLERS]
    if unknown:
        raise InputError(unknown_name("sampler", unknown[0], SAMPLERS))
    return with_references(set(names or SAMPLERS))


def with_references(names: set[str]) -> list[Sampler]:
    """Samplers and the references they are held against, in the table's order."""
    references = {SAMPLERS[name].reference for name in names}
    return [one for one in SAMPLERS.values() if one.name in names | references]


def contender_of(sampler: Sampler, sizes: Sizes, case: Case) -> Contender:
    """The sampler in its host under the conditions of a case. Changes of the model that are about
    learning are left out where nothing is learned."""
    name = sampler.name
    in_nerfacto = name in (PROPOSALS, DENSE_PROPOSAL)
    if name == LEARNED:
        learning = {"rays": sizes.learn_rays, "learning.schedule.learn_steps": sizes.learn_steps}
        own: dict[str, Any] = {"sampler": "learned-occupancy", **learning}
    elif name == PROPOSALS:
        own = {"sampler": OWN_SAMPLER}
    elif name == DENSE_PROPOSAL:
        own = {"sampler": name, "options": {"samples": sizes.dense_samples}}
    elif name == DENSE:
        own = {"sampler": name, "options": {"levels": DENSE_LEVELS}}
    else:
        cells = {"resolution": int(name.removeprefix(f"{GRID}-")), "levels": case.grid_levels}
        own = {"sampler": "occupancy-grid", "options": cells}
    changes = sizes.host(in_nerfacto) | {f"occupancy.{path}": one for path, one in own.items()}
    left_out = () if name == LEARNED else ("occupancy.",)
    changes |= {path: one for path, one in case.changes.items() if not path.startswith(left_out)}
    host = "leco-nerfacto" if in_nerfacto else "leco-ngp"
    settings = {RAYS: sizes.rays, **case.settings}
    return Contender(sampler.title, host, name, changes, settings=settings)


A_RUN = 120.0
"""Seconds of a run, as long as none was made."""


Key = tuple[str, str]
"""Scene and name of a run."""


class Run(NamedTuple):
    """One run, on the scene of a name."""

    scene: str
    job: Job

    @property
    def key(self) -> Key:
        """The same for what is run once, however many cells share it."""
        return self.scene, self.job.name


@dataclass(frozen=True)
class Entry:
    """One cell of the table before anything is known of it, and the runs that it is made of."""

    case: Case
    sampler: Sampler
    contender: Contender
    seeds: tuple[int, ...]

    @property
    def runs(self) -> list[Run]:
        return [Run(self.case.scene, Job(self.contender, seed)) for seed in self.seeds]


def entries_of(
    cases: Sequence[Case],
    samplers: Sequence[Sampler],
    seeds: Sequence[int],
    sizes: Sizes,
    beside: Sequence[int] = (),
) -> list[Entry]:
    """All cells, case by case, with the references that they are held against.

    Learned occupancy has more than `seeds` where a case is about seeds; what it is compared with
    has those of `beside`, if any. One of them that is none of `seeds` is an InputError: nothing
    would be compared with it.
    """
    if alone := [seed for seed in dict.fromkeys(beside) if seed not in seeds]:
        raise InputError(f"--seeds-beside {alone[0]} is none of --seeds: add it there")
    entries = []
    for case in cases:
        wanted = with_references({one.name for one in samplers if case.is_about(one.name)})
        for sampler in (one for one in samplers if one in wanted):
            chosen = tuple(dict.fromkeys(seeds))
            if sampler.name == LEARNED:
                more = [seed for seed in range(case.seeds) if seed not in chosen]
                chosen += tuple(more[: max(case.seeds - len(chosen), 0)])
            elif beside and sampler.name != DENSE:
                chosen = tuple(dict.fromkeys(beside))
            entries.append(Entry(case, sampler, contender_of(sampler, sizes, case), chosen))
    return entries


def runs_of(entries: Sequence[Entry]) -> list[Run]:
    """All runs, each once: all cells get their first seed before any gets its second."""
    in_turn = zip_longest(*(entry.runs for entry in entries))
    runs = (run for one_of_each in in_turn for run in one_of_each if run is not None)
    return list({run.key: run for run in runs}.values())


def scenes_of(cases: Sequence[Case], sizes: Sizes) -> dict[str, tuple[Stage, Capture]]:
    return {case.scene: (STAGES.get(case.name, YARD), capture_of(case, sizes)) for case in cases}


def capture_of(case: Case, sizes: Sizes) -> Capture:
    capture = case.capture
    views = capture.views
    if views == Capture.views:
        views = round(views * sizes.views)
    return replace(
        capture,
        views=max(4, views),
        test_views=max(2, round(capture.test_views * sizes.views)),
        width=round(capture.width * sizes.picture),
        height=round(capture.height * sizes.picture),
    )


def core_seconds(runs: Sequence[Run], stored: Sequence[Mapping[str, Any]]) -> float:
    """Seconds that runs to be made take of one core: as long as stored ones of their samplers, else
    as the longest of any."""
    measured: defaultdict[str, list[float]] = defaultdict(list)
    for record in stored:
        measured[record["sampler"]].append(float(record["processor_seconds"]))
    means = {name: fmean(seconds) for name, seconds in measured.items()}
    longest = max(map(max, measured.values()), default=A_RUN)
    return sum(means.get(run.job.contender.sampler, longest) for run in runs)
