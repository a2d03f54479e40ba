"""`leco stability`: makes the runs of a table that are missing, and stores and draws it."""

from __future__ import annotations

import datetime
import json
import math
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from leco_plugin.chart.contender import Protocol, require_seeds, settings_of
from leco_plugin.chart.runner import (
    RUNS,
    ProcessRunner,
    RunFailed,
    RunFolder,
    Runner,
    make_jobs,
    take_folder,
)
from leco_plugin.chart.theme import DARK, LIGHT
from leco_plugin.evaluation.report import describe_code, describe_machine, usable_cores
from leco_plugin.log import bar, by_number, counted, put, resumable, spell
from leco_plugin.occupancy import CALIBRATED_AT
from leco_plugin.scenes.city.folder import TRANSFORMS
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.photographs import describe_scene
from leco_plugin.scenes.whole_files import alone_in, write_json, write_whole
from leco_plugin.stability import plan
from leco_plugin.stability.cases import Case, cases_named
from leco_plugin.stability.photographs import digest_of, write_scene
from leco_plugin.stability.plan import FULL, Entry, Key, Run, Sampler, Sizes
from leco_plugin.stability.table import draw, draw_side_by_side, table
from leco_plugin.stability.verdict import judge

WORKER = (sys.executable, "-W", "ignore", "-m", "leco_plugin.stability.worker")
SIZES = "sizes.json"
"""File whose presence says that a folder is a table's, with the sizes of all runs there."""
DAMAGED = "is damaged, or not of a table; delete it, or name a new folder with --out"
SCENES, FAILURES = "scenes", "failures"
PER_PORTION = {"cores", "threads"}
"""Facts of the machine that say how many runs are made at once, and change no run."""
OF_OCCUPANCY = (
    *("threshold", "lost_surface_mass", "image_price_db", "empty_fraction", "recoveries"),
    CALIBRATED_AT,
)  # what is kept of a learned occupancy
Say = Callable[[str], None]


def make_table(
    out: Path,
    cases: Sequence[str],
    samplers: Sequence[str],
    seeds: Sequence[int],
    seeds_beside: Sequence[int],
    quick: bool,
    minutes: float | None,
) -> dict[str, Any]:
    """Makes what is missing of a table and draws it, by the options of `leco stability`; returns
    the results, as in `stability.json`. For a wrong name or folder ValueError or OSError, before
    anything is started."""
    if minutes is not None and not 0.0 < minutes < math.inf:
        raise InputError(f"a table is made in a positive number of minutes, not {minutes}")
    chosen, compared = cases_named(tuple(cases)), plan.samplers_named(tuple(samplers))
    named = {"cases": cases, "samplers": samplers, "seeds": seeds, "seeds-beside": seeds_beside}
    words = [word for name, given in named.items() if given for word in (f"--{name}", *given)]
    words = ["leco stability --out DIR", *words, *(["--quick"] if quick else [])]
    command = " ".join(map(str, words))  # without this machine's paths
    with alone_in(out, "table"):
        sizes = plan.QUICK if quick else FULL
        suite = Suite(out, chosen, compared, seeds, sizes, command, seeds_beside)
        put(suite.estimate())
        with resumable(), bar(counted(len(chosen), "case")) as show:
            suite.make(put, show, math.inf if minutes is None else 60.0 * minutes)
        if left := len(suite.missing()):
            some = counted(left, "run is left or has failed", "runs are left or have failed")
            put(f"{some}; the same command goes on with {by_number(left, 'it', 'them')}")
        return suite.draw()


class Suite:
    """One table: its scenes, its runs, and its results so far.

    In its folder `scenes` holds what is photographed, `runs` what was run, by scene. ValueError or
    OSError where there is nothing to run or no seed, or the folder is of something else, of other
    sizes or versions. Arguments are as of `entries_of`.
    """

    def __init__(
        self,
        out: Path,
        cases: Sequence[Case],
        samplers: Sequence[Sampler],
        seeds: Sequence[int],
        sizes: Sizes,
        command: str = "leco stability",
        beside: Sequence[int] = (),
    ) -> None:
        if not cases or not samplers or not seeds:
            raise ValueError("a table needs at least one case, one sampler and one seed")
        require_seeds([*seeds, *beside])
        self.entries = plan.entries_of(cases, samplers, seeds, sizes, beside)
        other_sizes = "a table of other sizes, with --quick or without:"
        take_folder(out / SIZES, asdict(sizes), other_sizes, DAMAGED)
        for name in (SCENES, RUNS, FAILURES):
            (out / name).mkdir(exist_ok=True)
        self.out, self.cases, self.sizes, self.command = out, list(cases), sizes, command
        self.machine = describe_machine()
        self.made = {"cpu": self.machine["cpu"], **describe_code()}
        shown = {entry.sampler.name for entry in self.entries}
        self.samplers = [one for one in samplers if one.name in shown]
        self.protocol = Protocol(steps=sizes.steps)
        self.stop = threading.Event()
        # small tensors gain more by another run than by another thread
        self.workers = usable_cores() if self.machine["device"] == "cpu" else 1
        scenes = plan.scenes_of(cases, sizes)
        self.digests = {name: digest_of(*scene) for name, scene in scenes.items()}
        self.data, self.folders = {}, {}
        machine = {key: fact for key, fact in self.machine.items() if key not in PER_PORTION}
        for name, scene in scenes.items():
            self.data[name] = write_scene(*scene, out / SCENES / name)
            scene_facts = describe_scene(self.data[name]) | {"digest": self.digests[name]}
            settings = settings_of(scene_facts, self.protocol, None, machine)
            self.folders[name] = RunFolder(out / RUNS / name, settings | {"sizes": asdict(sizes)})

    def runner(self, scene: str) -> Runner:
        """Makes the runs of a scene in processes, with one thread each if there are several."""
        threads = 1 if self.workers > 1 else None
        place = self.data[scene], self.protocol, self.folders[scene]
        return ProcessRunner(*place, WORKER, threads, self.stop)

    def stored(self) -> dict[Key, dict[str, Any]]:
        return {
            (scene, name): record["run"]
            for scene, folder in self.folders.items()
            for name, record in folder.stored().items()
        }

    def failures(self) -> dict[Key, str]:
        """Why runs have ended without a result: until they are made with one."""
        return {
            (scene, one["job"]): one["reason"]
            for scene, folder in self.folders.items()
            for one in folder.failures()
        }

    def missing(self) -> list[Run]:
        """Runs that are not stored: first those that were never tried, then those that failed."""
        stored, failures = self.stored(), self.failures()
        runs = [run for run in plan.runs_of(self.entries) if run.key not in stored]
        return sorted(runs, key=lambda run: run.key in failures)

    def estimate(self) -> str:
        todo, stored = self.missing(), list(self.stored().values())
        at_once = max(1, min(self.workers, len(todo)))
        runs = counted(len(plan.runs_of(self.entries)), "run")
        some = f"{len(todo)} of {runs} {by_number(len(todo), 'is', 'are')} to be made"
        return (
            f"{some}, {at_once} at a time: about {spell(plan.core_seconds(todo, stored) / at_once)}"
        )

    def make(self, say: Say, show: Callable[[float], None], seconds: float = math.inf) -> None:
        """Makes what is missing; whenever this is stopped, what was finished is kept.

        A run that would end later than in so many seconds is left for another time, but for those
        that start at once. `say` and `show` are as of `make_jobs`.
        """
        todo, ends = self.missing(), time.monotonic() + seconds

        def is_in_time(run: Run) -> bool:
            if seconds == math.inf or run in todo[: self.workers]:
                return True
            expected = plan.core_seconds([run], list(self.stored().values()))
            return time.monotonic() + expected <= ends

        def note(line: str) -> None:
            say(line)
            self.write()

        for folder in self.folders.values():
            folder.clear()
        self.write()
        threads: Any = {"stop": self.stop, "at_once": self.workers, "is_wanted": is_in_time}
        done = len(plan.runs_of(self.entries)) - len(todo)
        make_jobs(todo, self._make_one, note, show, done=done, **threads)

    def _make_one(self, run: Run, show: Callable[[float], None]) -> str:
        """Makes a run and keeps it, or why there is none; returns a line about it."""
        title = f"{run.scene}, {run.job.contender.name}, seed {run.job.seed}"
        folder = self.folders[run.scene]
        try:
            record = self.runner(run.scene)(run.job, show)
        except RunFailed as error:
            folder.fail(run.job, str(error))
            return f"{title}: failed: {error}"
        made = self.made | record.pop("code", {})  # as its own process has loaded it
        folder.store(run.job, record | {"made": made})
        psnr = "no PSNR" if record["psnr"] is None else f"{record['psnr']:.2f} dB"
        return f"{title}: {psnr} after {record['processor_seconds']:.0f} s"

    def results(self) -> dict[str, Any]:
        """The table, as in `stability.json`: every cell with its verdict and its runs' figures."""
        stored, failures = self.stored(), self.failures()
        rows = []
        for case in self.cases:
            facts = {name: getattr(case, name) for name in ("name", "title", "why", "must_fail")}
            scene = {"name": case.scene, "digest": self.digests[case.scene]}
            entries = [entry for entry in self.entries if entry.case is case]
            cells = {one.sampler.name: self._cell(one, stored, failures) for one in entries}
            rows.append({**facts, "scene": scene, "cells": cells})
        made = {"date": datetime.date.today().isoformat(), "command": self.command, **self.made}
        return {
            "format": 1,
            "machine": self.machine,
            "sizes": asdict(self.sizes),
            "made": made,
            "samplers": [asdict(one) for one in self.samplers],
            "cases": rows,
        }

    def _cell(
        self, entry: Entry, stored: Mapping[Key, dict[str, Any]], failures: Mapping[Key, str]
    ) -> dict[str, Any]:
        failed = failures.keys() - stored.keys()
        runs = [stored[run.key] for run in entry.runs if run.key in stored]
        reasons = [failures[run.key] for run in entry.runs if run.key in failed]
        reference = None
        if entry.sampler.reference is not None:
            others = self.reference_of(entry).runs
            reference = [stored[run.key] for run in others if run.key in stored]
        cell = judge(runs, reference, reasons, len(entry.runs) - len(runs) - len(reasons))
        names = {run.job.seed: run.job.name for run in entry.runs}
        return {**cell.to_dict(), "runs": [_figures(run, names[run["seed"]]) for run in runs]}

    def reference_of(self, entry: Entry) -> Entry:
        of_case = {other.sampler.name: other for other in self.entries if other.case is entry.case}
        return of_case[entry.sampler.reference or entry.sampler.name]

    def write(self) -> dict[str, Any]:
        """`stability.json` and `table.md`, as far as there are runs."""
        results = self.results()
        write_json(self.out / "stability.json", results)
        write_whole(self.out / "table.md", table(results).encode())
        return results

    def draw(self) -> dict[str, Any]:
        """The results, and from them the pictures of the table and of every failure."""
        results = self.write()
        draw(results, self.out / "stability.png", LIGHT)
        draw(results, self.out / "stability-dark.png", DARK)
        for old in (self.out / FAILURES).glob("*.png"):
            old.unlink()
        rows = {row["name"]: row["cells"] for row in results["cases"]}
        for entry in self.entries:
            cell = rows[entry.case.name][entry.sampler.name]
            if cell["verdict"] in ("fail", "degraded") and entry.sampler.reference is not None:
                self._draw_failure(entry, cell)
        return results

    def _draw_failure(self, entry: Entry, cell: Mapping[str, Any]) -> None:
        """What is there, and what the reference and the sampler show, in the worst seed if any."""
        data, shown = self.data[entry.case.scene], self._views(entry)
        if not shown:
            return
        first = json.loads((data / TRANSFORMS).read_text())["test_filenames"][0]
        pictures = {"what is there": data / first}
        dense = self._views(self.reference_of(entry))
        for name, views in (("dense", dense), (entry.sampler.title, shown)):
            if views:
                seed = cell["worst_seed"] if cell["worst_seed"] in views else next(iter(views))
                pictures[f"{name}, seed {seed}"] = views[seed]
        path = self.out / FAILURES / f"{entry.case.name}--{entry.sampler.name}.png"
        draw_side_by_side(pictures, f"{entry.case.title}: {cell['reason']}", path)

    def _views(self, entry: Entry) -> dict[int, Path]:
        """The held-out picture that each run of a cell has rendered, by its seed."""
        folder = self.folders[entry.case.scene].path / RUNS
        places = {run.job.seed: folder / f"{run.job.name}.png" for run in entry.runs}
        return {seed: place for seed, place in places.items() if place.exists()}


def _figures(run: Mapping[str, Any], name: str) -> dict[str, Any]:
    """What a verdict needs of a run, and what says where it comes from."""
    kept = {key: run[key] for key in ("seed", "psnr", "processor_seconds", "measured", "made")}
    if facts := run.get("occupancy"):
        kept["occupancy"] = {key: facts.get(key) for key in OF_OCCUPANCY}
    return {"name": name, "sampler": run["sampler"], **kept}
