"""Makes the runs of a chart that are missing, and writes what all of them say."""

from __future__ import annotations

import copy
import datetime
import shutil
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from leco_plugin.chart import contender, page, picture
from leco_plugin.chart.contender import Contender, Job, Protocol
from leco_plugin.chart.runner import (
    DAMAGED,
    RESULTS,
    RUNS,
    SETTINGS,
    RunFailed,
    RunFolder,
    Runner,
    difference,
    make_jobs,
    stored_in,
)
from leco_plugin.chart.table import table
from leco_plugin.chart.theme import DARK, LIGHT
from leco_plugin.evaluation.report import describe_code, describe_machine, read_object
from leco_plugin.learning.schedule import HELD
from leco_plugin.log import counted
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.photographs import describe_held_out, describe_scene, megapixels_of
from leco_plugin.scenes.whole_files import alone_in, write_json, write_whole

Say = Callable[[str], None]
NOTHING_SKIPPED = "; no occupancy was learned in this time, so that nothing was skipped"


def jobs_of(contenders: Sequence[Contender], seeds: Sequence[int]) -> list[Job]:
    """All runs. Contenders take turns within a seed, and each seed begins with another one, so
    that a machine whose speed drifts treats them alike."""
    jobs = []
    for turn, seed in enumerate(dict.fromkeys(seeds)):
        first = turn % len(contenders)
        jobs += [Job(one, seed) for one in (*contenders[first:], *contenders[:first])]
    return jobs


class Chart:
    """One chart: its folder, its runs, and its results so far.

    Args:
        suite: name and question of the comparison, if it has one.
        reuse: folders of charts, from which runs that are missing here are taken over.
    Raises:
        ValueError, OSError: nothing to compare, no such scene, a folder of something else.
    """

    def __init__(
        self,
        data: Path,
        out: Path,
        contenders: Sequence[Contender],
        seeds: Sequence[int],
        protocol: Protocol,
        suite: tuple[str | None, str | None] = (None, None),
        command: str = "leco chart",
        reuse: Sequence[Path] = (),
    ) -> None:
        if not contenders or not seeds:
            raise ValueError("a chart needs at least one method and one seed")
        contender.require_seeds(seeds)
        self.data, self.scene, self.machine = data, describe_scene(data), describe_machine()
        self.held_out = describe_held_out(data, protocol.held_out)
        self.machine["threads"] = protocol.threads(self.machine["threads"])
        self.protocol, self.command, self.reuse = protocol, command, list(reuse)
        self.suite, self.question = suite
        self.stop = threading.Event()
        self.contenders = list(contenders)
        self.jobs = jobs_of(contenders, seeds)
        self.settings = contender.settings_of(self.scene, protocol, self.suite, self.machine)
        for source in reuse:
            if other := why_not_shared(source, self.settings):
                raise InputError(f"--reuse {source}: {other}")
        self.folder = RunFolder(out, self.settings)

    def missing(self) -> list[Job]:
        """Runs that are not stored. One that failed is missing."""
        stored = self.folder.stored()
        return [job for job in self.jobs if job.name not in stored]

    def make(self, runner: Runner, say: Say = print, show: Callable[[float], None] = print) -> None:
        """Makes what is missing; whenever it is stopped, what was finished is kept.

        Args:
            runner: called in several threads where there are several runs at once. It ends what is
                under way when `stop` is set.
            say, show: as of `make_jobs`.
        Raises:
            InputError: another process makes runs in the same folder.
        """

        def note(line: str) -> None:
            say(line)
            self.write()

        with alone_in(self.folder.path, "chart"):
            self.folder.clear()
            taken = take_over(self.folder, self.missing(), self.reuse)
            if taken:
                say(f"{counted(len(taken), 'run')} taken over from other charts")
            if todo := self.missing():
                say(self.forecast(todo))
            self.write()
            make_one, done = partial(self._make_one, runner), len(self.jobs) - len(todo)
            at_once = self.protocol.at_once
            make_jobs(todo, make_one, note, show, stop=self.stop, at_once=at_once, done=done)

    def _make_one(self, runner: Runner, job: Job, show: Callable[[float], None]) -> str:
        """Makes a run and keeps it, or why there is none; returns a line about it."""
        title = f"seed {job.seed}, {job.contender.name}"
        try:
            run = runner(job, show)
        except RunFailed as failure:
            self.folder.fail(job, str(failure))
            return f"{title}: failed: {failure}"
        code = run.pop("code", None) or describe_code()
        self.folder.store(job, run, made={**self._made(), **code})
        learns = job.contender.sampler.startswith(contender.LEARNED)
        late = learns and run["freeze_seconds"] is None
        return (
            f"{title}: {run['psnr']:.2f} dB after {run['train_seconds']:.0f} s, "
            f"{run['render_seconds_per_image']:.2f} s an image" + (NOTHING_SKIPPED if late else "")
        )

    def forecast(self, todo: Sequence[Job]) -> str:
        """How many runs are to be made, and about how long that takes."""
        megapixels = megapixels_of(self.data) or contender.SMALL
        about = contender.forecast((job.contender for job in todo), self.protocol, megapixels)
        runs = f"{counted(len(todo), 'run')} of {self.protocol.describe()}"
        beside = f", {self.protocol.at_once} at a time" if self.protocol.at_once > 1 else ""
        stored = len(self.jobs) - len(todo)
        more = counted(stored, "more is there already", "more are there already")
        there = f" ({more})" if stored else ""
        return f"{runs}{beside}, {about}{there}"

    def _name_of(self, made: Contender) -> str | None:
        """How a stored contender is called here. None for settings of an earlier version under a
        name of this call: a mean of both says nothing."""
        names = {one.key: one.name for one in self.contenders}
        return names.get(made.key, None if made.name in names.values() else made.name)

    def failures(self) -> list[dict[str, Any]]:
        """Runs that ended without a result, by seed, and whether this call asked for them."""
        asked, found = {job.name for job in self.jobs}, []
        for one in self.folder.failures():
            made = Contender.from_dict(one["contender"])
            if (name := self._name_of(made)) is not None:
                row = {"name": name, "method": made.method, "sampler": made.sampler}
                row |= {"seed": one["seed"], "reason": one["reason"]}
                found.append({**row, "asked": Job(made, one["seed"]).name in asked})
        return sorted(found, key=lambda one: (one["seed"], one["name"]))

    def results(self) -> dict[str, Any]:
        """All finished runs in the folder, the contenders of this call first."""
        places = {one.key: place for place, one in enumerate(self.contenders)}
        stored, runs = {}, []
        for file, record in self.folder.stored().items():
            made = Contender.from_dict(record["contender"])
            if (name := self._name_of(made)) is None:
                continue
            stored[file] = record
            code = record["made"].get("sources") or record["made"].get("commit")
            run = {**record["run"], "name": name, "code": code}
            runs.append(((places.get(made.key, len(places)), made.key, run["seed"]), run))
        in_order = [run for _, run in sorted(runs, key=lambda one: one[0])]
        failures = self.failures()
        failed = {(one["name"], one["seed"]) for one in failures}
        todo = [job for job in self.jobs if job.name not in stored]
        occupancies = [run["occupancy"] for run in in_order if run.get("occupancy")]
        return {
            "format": 1,
            "machine": self.machine,
            "scene": self.scene,
            "held_out": self.held_out,
            "protocol": asdict(self.protocol),
            "rates_held": HELD,
            "suite": self.suite,
            "question": self.question,
            "made": self._made_of(stored),
            "occupancy": occupancies[0] if occupancies else None,
            "runs": in_order,
            "failures": failures,
            "missing": sum((job.contender.name, job.seed) not in failed for job in todo),
        }

    def _made(self) -> dict[str, Any]:
        """When, how and by which code something is made now."""
        today = datetime.date.today().isoformat()
        return {"date": today, "command": self.command, **describe_code()}

    def _made_of(self, stored: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
        """The same of all stored runs: the commands that made them, this call's last, and the
        commits of all."""
        asked = {job.name for job in self.jobs}
        others = [one["made"]["command"] for name, one in stored.items() if name not in asked]
        commits = {one["made"]["commit"] for one in stored.values()} - {None}
        now = self._made()
        command = " && ".join(dict.fromkeys([*others, self.command]))
        return {**now, "command": command, "commit": ", ".join(sorted(commits)) or now["commit"]}

    def write(self) -> dict[str, Any]:
        """Writes `results.json` and `table.md`, as far as there are runs; returns the results."""
        results = self.results()
        write_json(self.folder.path / RESULTS, results)
        write_whole(self.folder.path / "table.md", table(results).encode())
        return results

    def draw(self) -> dict[str, Any]:
        """The same, and where a run has succeeded `chart.png`, light and dark, and `chart.html`."""
        results, place = self.write(), self.folder.path
        if results["runs"]:
            picture.draw(results, place / "chart.png", LIGHT)
            picture.draw(results, place / "chart-dark.png", DARK)
            page.write_page(results, place / "chart.html")
        return results


def why_not_shared(source: Path, settings: Mapping[str, Any]) -> str | None:
    """Why a chart with these settings cannot use the runs of another folder; None if it can. Only
    the suite that they were made for may differ. A damaged folder is an `InputError`."""
    file = source / SETTINGS
    if not file.is_file():
        return "there is no chart in it"
    shared = {name: value for name, value in settings.items() if name != "suite"}
    other = difference(read_object(file, DAMAGED), shared)
    return other and f"its runs have another {other}"


def take_over(folder: RunFolder, missing: Sequence[Job], sources: Sequence[Path]) -> list[Job]:
    """Copies missing runs from the folders of other charts, each from the first that has it;
    returns their jobs."""
    left, taken = list(missing), []
    for source in sources:
        for name, record in stored_in(source).items():
            for job in [job for job in left if is_run_of(record, job)]:
                for ending in (".safetensors", ".png"):
                    if (file := source / RUNS / f"{name}{ending}").exists():
                        shutil.copyfile(file, folder.path / RUNS / f"{job.name}{ending}")
                run = {**run_for(record, job), "reused": True}
                folder.store(job, run, made=record["made"])
                left.remove(job)
                taken.append(job)
    return taken


def is_run_of(record: Mapping[str, Any], job: Job) -> bool:
    """Whether a stored run is that of a job. One with more grids and taught gates serves too: these
    are made from its field afterwards."""
    made = Contender.from_dict(record["contender"])
    alike = made.alone().key == job.contender.alone().key
    has_all = set(job.contender.grids) <= set(made.grids) and job.contender.taught <= made.taught
    return alike and record["run"]["seed"] == job.seed and has_all


def run_for(record: Mapping[str, Any], job: Job) -> dict[str, Any]:
    """The run of a record, with only those grids and gates that the job asks for."""
    run: dict[str, Any] = copy.deepcopy(record["run"])
    facts = (run.get("occupancy") or {}).get("at_equal_loss")
    if facts:
        asked = job.contender.grids
        facts["grids"] = [grid for grid in facts["grids"] if grid["resolution"] in asked]
        facts["left_out"] = [size for size in facts["left_out"] if size in asked]
        if not job.contender.taught:
            facts.pop("taught", None)
            facts.pop("others", None)
    return run
