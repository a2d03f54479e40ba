"""Makes the runs of a table that are missing, as many at once as there are cores."""

from __future__ import annotations

import datetime
import json
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import asdict
from pathlib import Path
from typing import Any

from leco_plugin.chart.folder import RUNS, ChartFolder, Job
from leco_plugin.chart.processes import ProcessRunner, RunFailed
from leco_plugin.chart.protocol import Protocol, describe_scene, settings_of
from leco_plugin.evaluation.json_file import write_json
from leco_plugin.evaluation.machine import describe_code, describe_machine, usable_cores
from leco_plugin.scenes.city_layouts import TRANSFORMS
from leco_plugin.stability.cases import Case
from leco_plugin.stability.contenders import Sampler
from leco_plugin.stability.cost import core_seconds, in_words
from leco_plugin.stability.plan import Entry, Run, entries_of, runs_of, scenes_of
from leco_plugin.stability.scene_folder import write_scene
from leco_plugin.stability.sizes import Sizes
from leco_plugin.stability.verdict import judge

WORKER = (sys.executable, "-W", "ignore", "-m", "leco_plugin.stability.worker")
RESULTS = "stability.json"
Runner = Callable[[Job, Callable[[float], None]], dict[str, Any]]
Say = Callable[[str], None]


class Suite:
    """One table: its scenes, its runs, and its results so far.

    Args:
        out: its folder; `scenes` holds what is photographed, `runs` what was run, by scene.
        cases, samplers, seeds: what is compared.
        sizes: of everything.
        command: what made it, for the results.

    Raises:
        ValueError, OSError: nothing to run, or a folder with runs of other sizes or versions.
    """

    def __init__(
        self,
        out: Path,
        cases: Sequence[Case],
        samplers: Sequence[Sampler],
        seeds: Sequence[int],
        sizes: Sizes,
        command: str = "leco stability",
    ) -> None:
        if not cases or not samplers or not seeds:
            raise ValueError("a table needs at least one case, one sampler and one seed")
        self.out, self.cases, self.sizes, self.command = out, list(cases), sizes, command
        self.machine = describe_machine()
        self.entries = entries_of(cases, samplers, seeds, sizes)
        shown = {entry.sampler.name for entry in self.entries}
        self.samplers = [one for one in samplers if one.name in shown]
        self.protocol = Protocol(steps=sizes.steps, images=1, curve_points=1)
        self.failures: dict[tuple[str, str], str] = {}
        self.stop = threading.Event()
        self._writing = threading.Lock()
        self.data = {
            name: write_scene(stage, capture, _made(out / "scenes") / name)
            for name, (stage, capture) in scenes_of(cases, sizes).items()
        }
        self.folders = {name: self._folder(name) for name in self.data}

    def _folder(self, scene: str) -> ChartFolder:
        described = describe_scene(self.data[scene])
        settings = settings_of(described, self.protocol, None, self.machine)
        return ChartFolder(
            _made(self.out / "runs") / scene, settings | {"sizes": asdict(self.sizes)}
        )

    def runner(self, scene: str) -> Runner:
        """What makes the runs of a scene, in processes with one thread each."""
        return ProcessRunner(
            self.data[scene],
            self.protocol,
            self.folders[scene],
            WORKER,
            {"OMP_NUM_THREADS": "1"} if self.workers > 1 else None,
            self.stop,
        )

    @property
    def workers(self) -> int:
        """Runs at once: small tensors gain more by another run than by another thread."""
        return usable_cores() if self.machine["device"] == "cpu" else 1

    def stored(self) -> dict[tuple[str, str], dict[str, Any]]:
        """Records of finished runs by scene and name."""
        return {
            (scene, name): record["run"]
            for scene, folder in self.folders.items()
            for name, record in folder.stored().items()
        }

    def missing(self) -> list[Run]:
        """Runs that are not stored. One that failed is missing."""
        stored = self.stored()
        return [run for run in runs_of(self.entries) if (run.scene, run.job.name) not in stored]

    def estimate(self) -> str:
        """How long what is missing takes, in words."""
        todo, stored = self.missing(), list(self.stored().values())
        seconds = core_seconds(todo, stored, self.sizes) / self.workers
        return (
            f"{len(todo)} of {len(runs_of(self.entries))} runs are to be made, {self.workers} at a "
            f"time: about {in_words(seconds)}"
        )

    def make(
        self,
        say: Say,
        show: Callable[[float], None],
        runner_for: Callable[[str], Runner] | None = None,
    ) -> None:
        """Makes what is missing; whenever this is stopped, what was finished is kept.

        Args:
            say: called with a line for each run.
            show: called with the share of all runs that is done.
            runner_for: gives what makes the runs of a scene, instead of processes.
        """
        todo, total = self.missing(), len(runs_of(self.entries))
        make_one = runner_for or self.runner
        self.write()
        with ThreadPoolExecutor(self.workers) as pool:
            under_way: set[Future[str]] = set()
            try:
                for number, run in enumerate(todo):
                    show((total - len(todo) + number - len(under_way)) / total)
                    under_way.add(pool.submit(self._run, run, make_one(run.scene)))
                    if len(under_way) >= self.workers:
                        under_way = self._collect(under_way, say)
                while under_way:
                    show((total - len(under_way)) / total)
                    under_way = self._collect(under_way, say)
            except BaseException:
                self.stop.set()
                raise
        show(1.0)

    def _collect(self, under_way: set[Future[str]], say: Say) -> set[Future[str]]:
        """Waits for one run; returns those that go on."""
        done, rest = wait(under_way, return_when=FIRST_COMPLETED)
        for future in done:
            say(future.result())
        self.write()
        return rest

    def _run(self, run: Run, runner: Runner) -> str:
        """Makes a run and keeps it; returns a line about it."""
        title = f"{run.scene}, {run.job.contender.name}, seed {run.job.seed}"
        try:
            record = runner(run.job, lambda share: None)
        except RunFailed as failure:
            with self._writing:
                self.failures[run.scene, run.job.name] = str(failure)
            return f"{title}: failed: {failure}"
        self.folders[run.scene].store(run.job, record)
        return f"{title}: {record['psnr']:.2f} dB after {record['processor_seconds']:.0f} s"

    def results(self) -> dict[str, Any]:
        """The table, as in `stability.json`."""
        stored = self.stored()
        rows = []
        for case in self.cases:
            cells = {
                entry.sampler.name: self._cell(entry, stored)
                for entry in self.entries
                if entry.case is case
            }
            facts = {"name": case.name, "title": case.title, "why": case.why}
            rows.append({**facts, "must_fail": case.must_fail, "cells": cells})
        return {
            "format": 1,
            "machine": self.machine,
            "sizes": asdict(self.sizes),
            "made": {
                "date": datetime.date.today().isoformat(),
                "command": self.command,
                **describe_code(),
            },
            "samplers": [
                {"name": one.name, "title": one.title, "reference": one.reference}
                for one in self.samplers
            ],
            "cases": rows,
        }

    def _cell(self, entry: Entry, stored: dict[tuple[str, str], dict[str, Any]]) -> dict[str, Any]:
        runs, failures = self._runs(entry, stored)
        reference = None
        if entry.sampler.reference is not None:
            reference = self._runs(self.reference_of(entry), stored)[0]
        cell = judge(runs, reference, failures)
        figures = [
            {"seed": run["seed"], "psnr": run["psnr"], **run["measured"], **_learned(run)}
            for run in runs
        ]
        return {**cell.to_dict(), "runs": figures}

    def reference_of(self, entry: Entry) -> Entry:
        """The cell that a cell is held against."""
        return next(
            other
            for other in self.entries
            if other.case is entry.case and other.sampler.name == entry.sampler.reference
        )

    def view_of(self, entry: Entry, seed: int | None) -> Path | None:
        """The held-out picture as a run of a cell renders it: of this seed, or of another."""
        places = {
            run.job.seed: self.folders[run.scene].path / RUNS / f"{run.job.name}.png"
            for run in entry.runs
        }
        there = {number: place for number, place in places.items() if place.exists()}
        return there.get(-1 if seed is None else seed, next(iter(there.values()), None))

    def true_view(self, case: Case) -> Path:
        """The same picture as it is."""
        data = self.data[case.scene]
        names = json.loads((data / TRANSFORMS).read_text())["test_filenames"]
        return data / str(names[0])

    def _runs(
        self, entry: Entry, stored: dict[tuple[str, str], dict[str, Any]]
    ) -> tuple[list[dict[str, Any]], list[str]]:
        """Finished runs of a cell, and why others ended."""
        keys = [(run.scene, run.job.name) for run in entry.runs]
        failed = [self.failures[key] for key in keys if key in self.failures]
        return [stored[key] for key in keys if key in stored], failed

    def write(self) -> dict[str, Any]:
        """`stability.json` and `table.md`, as far as there are runs."""
        from leco_plugin.stability.table import table

        results = self.results()
        write_json(self.out / RESULTS, results)
        (self.out / "table.md").write_text(table(results))
        return results

    def draw(self) -> dict[str, Any]:
        """The results, and from them the pictures of the table and of every failure."""
        from leco_plugin.chart.theme import DARK, LIGHT
        from leco_plugin.stability.failure_images import draw_failures
        from leco_plugin.stability.picture import draw

        results = self.write()
        draw(results, self.out / "stability.png", LIGHT)
        draw(results, self.out / "stability-dark.png", DARK)
        draw_failures(self, results)
        return results


def _made(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def _learned(run: dict[str, Any]) -> dict[str, Any]:
    """What the calibration of a learned occupancy says, of a run that has one."""
    facts = run.get("occupancy")
    if not facts:
        return {}
    names = ("threshold", "lost_surface_mass", "image_price_db", "empty_fraction")
    return {"occupancy": {name: facts.get(name) for name in names}}
