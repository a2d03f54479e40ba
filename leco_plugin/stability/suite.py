"""Makes the runs of a table that are missing, as many at once as there are cores."""

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import asdict
from pathlib import Path
from typing import Any

from leco_plugin.chart.contender import Job
from leco_plugin.chart.protocol import Protocol, require_seeds, settings_of
from leco_plugin.chart.runner import LOGS, ProcessRunner, RunFailed
from leco_plugin.chart.runner import RunFolder as ChartFolder
from leco_plugin.evaluation.report import describe_code, describe_machine, usable_cores, write_json
from leco_plugin.scenes.description import describe_scene
from leco_plugin.stability.cases import Case
from leco_plugin.stability.contenders import Sampler
from leco_plugin.stability.cost import core_seconds, in_words
from leco_plugin.stability.plan import Entry, Run, entries_of, runs_of, scenes_of
from leco_plugin.stability.results import results_of, runs_in
from leco_plugin.stability.scene_folder import digest_of, write_scene
from leco_plugin.stability.sizes import Sizes
from leco_plugin.stability.table_folder import RUNS, SCENES, finished_in, forget_unfinished, take

WORKER = (sys.executable, "-W", "ignore", "-m", "leco_plugin.stability.worker")
RESULTS = "stability.json"
FAILED = ".failed"
"""Ending of the file, beside its log, with the reason why a run has no result."""
PER_PORTION = {"cores", "threads"}
"""Facts of the machine that say how many runs are made at once, and change no run."""
Runner = Callable[[Job, Callable[[float], None]], dict[str, Any]]
Say = Callable[[str], None]


class Suite:
    """One table: its scenes, its runs, and its results so far.

    Args:
        out: its folder; `scenes` holds what is photographed, `runs` what was run, by scene.
        cases, samplers, seeds: what is compared.
        sizes: of everything.
        command: what made it, for the results.
        beside: seeds of the samplers that learned occupancy is compared with, see `entries_of`.

    Raises:
        ValueError, OSError: nothing to run, no seed, or a folder of something else, of other sizes
            or versions.
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
        take(out, sizes)
        self.out, self.cases, self.sizes, self.command = out, list(cases), sizes, command
        self.machine = describe_machine()
        self.made = {"cpu": self.machine["cpu"], **describe_code()}
        self.entries = entries_of(cases, samplers, seeds, sizes, beside)
        shown = {entry.sampler.name for entry in self.entries}
        self.samplers = [one for one in samplers if one.name in shown]
        self.protocol = Protocol(steps=sizes.steps)
        self.stop = threading.Event()
        scenes = scenes_of(cases, sizes)
        self.digests = {name: digest_of(*scene) for name, scene in scenes.items()}
        self.data = {
            name: write_scene(*scene, out / SCENES / name) for name, scene in scenes.items()
        }
        self.folders = {name: self._folder(name) for name in self.data}

    def _folder(self, scene: str) -> ChartFolder:
        described = describe_scene(self.data[scene])
        machine = {key: fact for key, fact in self.machine.items() if key not in PER_PORTION}
        settings = settings_of(described, self.protocol, None, machine)
        return ChartFolder(self.out / RUNS / scene, settings | {"sizes": asdict(self.sizes)})

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
            (scene, name): run
            for scene, folder in self.folders.items()
            for name, run in finished_in(folder).items()
        }

    def failures(self) -> dict[tuple[str, str], str]:
        """Why runs have ended without a result, likewise: until they are made with one."""
        return {
            (scene, file.stem): file.read_text()
            for scene, folder in self.folders.items()
            for file in (folder.path / LOGS).glob(f"*{FAILED}")
        }

    def missing(self) -> list[Run]:
        """Runs that are not stored: those that nobody tried, then those that have failed."""
        stored, failures = self.stored(), self.failures()
        runs = [run for run in runs_of(self.entries) if run.key not in stored]
        return sorted(runs, key=lambda run: run.key in failures)

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
        seconds: float = math.inf,
    ) -> None:
        """Makes what is missing; whenever this is stopped, what was finished is kept.

        Args:
            say: called with a line for each run.
            show: called with the share of all runs that is done.
            runner_for: gives what makes the runs of a scene, instead of processes.
            seconds: after which no run is to go on; but for the first ones, what would take longer
                is left for another time.
        """
        todo, total, stored = self.missing(), len(runs_of(self.entries)), self.stored()
        expected = [core_seconds([run], list(stored.values()), self.sizes) for run in todo]
        make_one, ends = runner_for or self.runner, time.monotonic() + seconds
        done = total - len(todo)
        for folder in self.folders.values():
            forget_unfinished(folder)
        self.write()
        with ThreadPoolExecutor(self.workers) as pool:
            under_way: set[Future[str]] = set()
            try:
                for number, run in enumerate(todo):
                    late = time.monotonic() + expected[number] > ends
                    if late and number >= self.workers:
                        continue
                    under_way.add(pool.submit(self._run, run, make_one(run.scene)))
                    if len(under_way) >= self.workers:
                        done += self._collect(under_way, say)
                        show(done / total)
                while under_way:
                    done += self._collect(under_way, say)
                    show(done / total)
            except BaseException:
                self.stop.set()
                raise

    def _collect(self, under_way: set[Future[str]], say: Say) -> int:
        """Waits for one run, or more that end together, and takes them out; returns how many."""
        done, rest = wait(under_way, return_when=FIRST_COMPLETED)
        for future in done:
            say(future.result())
        self.write()
        under_way &= rest
        return len(done)

    def _run(self, run: Run, runner: Runner) -> str:
        """Makes a run and keeps it; returns a line about it."""
        title = f"{run.scene}, {run.job.contender.name}, seed {run.job.seed}"
        folder = self.folders[run.scene]
        failure = folder.path / LOGS / f"{run.job.name}{FAILED}"
        try:
            record = runner(run.job, lambda share: None)
        except RunFailed as error:
            failure.write_text(str(error))
            return f"{title}: failed: {error}"
        folder.store(run.job, record | {"made": self.made})
        failure.unlink(missing_ok=True)
        psnr = "no PSNR" if record["psnr"] is None else f"{record['psnr']:.2f} dB"
        return f"{title}: {psnr} after {record['processor_seconds']:.0f} s"

    def take_over(self, results: Mapping[str, Any]) -> int:
        """Keeps the runs of another table that would be made here just so; returns how many."""
        taken, stored = runs_in(results, self), self.stored()
        runs = [run for run in runs_of(self.entries) if run.key in taken.keys() - stored.keys()]
        for run in runs:
            self.folders[run.scene].store(run.job, taken[run.key])
        return len(runs)

    def results(self) -> dict[str, Any]:
        """The table, as in `stability.json`."""
        return results_of(self)

    def reference_of(self, entry: Entry) -> Entry:
        """The cell that a cell is held against."""
        return next(
            other
            for other in self.entries
            if other.case is entry.case and other.sampler.name == entry.sampler.reference
        )

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
