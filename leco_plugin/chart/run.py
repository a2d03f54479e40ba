"""Makes the runs of a chart that are missing, and writes what all of them say."""

from __future__ import annotations

import datetime
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from leco_plugin.chart.contender import Contender
from leco_plugin.chart.folder import ChartFolder, Job
from leco_plugin.chart.processes import RunFailed
from leco_plugin.chart.protocol import Protocol, describe_scene, settings_of
from leco_plugin.chart.table import write_table
from leco_plugin.evaluation.json_file import write_json
from leco_plugin.evaluation.machine import describe_code, describe_machine

Runner = Callable[[Job, Callable[[float], None]], dict[str, Any]]
Say = Callable[[str], None]

RESULTS, TABLE = "results.json", "table.md"


def jobs_of(contenders: Sequence[Contender], seeds: Sequence[int]) -> list[Job]:
    """All runs: the contenders take turns within a seed, so that a machine whose speed drifts
    treats them alike."""
    return [Job(contender, seed) for seed in dict.fromkeys(seeds) for contender in contenders]


class Chart:
    """One chart: its folder, its runs, and its results so far.

    Args:
        data: a scene in nerfstudio's format.
        out: the chart's folder.
        contenders: what is compared.
        seeds: of each.
        protocol: how long, and how it is evaluated.
        suite: name and question of the comparison, if it has one.
        command: what made it, for the results.

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
        suite: tuple[str, str] | None = None,
        command: str = "leco chart",
    ) -> None:
        if not contenders or not seeds:
            raise ValueError("a chart needs at least one method and one seed")
        self.scene, self.machine = describe_scene(data), describe_machine()
        self.protocol, self.suite, self.command = protocol, suite, command
        self.contenders = list(contenders)
        self.jobs = jobs_of(contenders, seeds)
        name = suite[0] if suite is not None else None
        settings = settings_of(self.scene, protocol, name, self.machine)
        self.folder = ChartFolder(out, settings)
        self.failures: list[dict[str, Any]] = []

    def missing(self) -> list[Job]:
        """Runs that are not stored. One that failed is missing."""
        stored = self.folder.stored()
        return [job for job in self.jobs if job.name not in stored]

    def make(self, runner: Runner, say: Say = print, show: Callable[[float], None] = print) -> None:
        """Makes what is missing; whenever it is stopped, what was finished is kept.

        Args:
            runner: makes one run, or raises `RunFailed`.
            say: called with a line for each run.
            show: called with the share of all runs that is done.
        """
        todo = self.missing()
        if todo:
            say(self.forecast(todo))
        self.write()
        for number, job in enumerate(todo):
            done = len(self.jobs) - len(todo) + number

            def show_share(share: float, done: int = done) -> None:
                show((done + share) / len(self.jobs))

            show_share(0.0)
            title = f"seed {job.seed}, {job.contender.name}"
            try:
                run = runner(job, show_share)
            except RunFailed as failure:
                self._fail(job, str(failure))
                say(f"{title}: failed: {failure}")
            else:
                self.folder.store(job, run)
                say(
                    f"{title}: {run['psnr']:.2f} dB after {run['train_seconds']:.0f} s, "
                    f"{run['render_seconds_per_image']:.2f} s an image"
                )
            self.write()

    def forecast(self, todo: Sequence[Job]) -> str:
        """How many runs are to be made, and about how long that takes."""
        minutes = self.protocol.minutes(job.contender for job in todo)
        runs = f"{len(todo)} run{'s' if len(todo) > 1 else ''}"
        stored = len(self.jobs) - len(todo)
        there = f" ({stored} more are there already)" if stored else ""
        if minutes is None:
            return f"{runs} of {self.protocol.describe()}{there}"
        return f"{runs}, about {max(minutes, 1.0):.0f} minutes on two CPU cores{there}"

    def _fail(self, job: Job, reason: str) -> None:
        contender = job.contender
        self.failures.append(
            {
                "name": contender.name,
                "method": contender.method,
                "sampler": contender.sampler,
                "seed": job.seed,
                "reason": reason,
            }
        )

    def results(self) -> dict[str, Any]:
        """All finished runs in the folder, the contenders of this call first."""
        stored = self.folder.stored()
        order = [contender.key for contender in self.contenders]
        records = sorted(stored.values(), key=lambda record: _place(record, order))
        runs = [_run_of(record, self.contenders) for record in records]
        occupancies = [run["occupancy"] for run in runs if run.get("occupancy")]
        return {
            "format": 1,
            "machine": self.machine,
            "scene": self.scene,
            "protocol": asdict(self.protocol),
            "suite": self.suite[0] if self.suite is not None else None,
            "question": self.suite[1] if self.suite is not None else None,
            "made": {
                "date": datetime.date.today().isoformat(),
                "command": self.command,
                **describe_code(),
            },
            "occupancy": occupancies[0] if occupancies else None,
            "runs": runs,
            "failures": self.failures,
        }

    def write(self) -> dict[str, Any]:
        """`results.json` and `table.md`, as far as there are runs."""
        results = self.results()
        write_json(self.folder.path / RESULTS, results)
        write_table(results, self.folder.path / TABLE)
        return results

    def draw(self) -> dict[str, Any]:
        """The results, and from them `chart.png`, the same on black, and `chart.html`.

        Nothing is drawn when no run has succeeded.
        """
        from leco_plugin.chart.page import write_page
        from leco_plugin.chart.picture import draw
        from leco_plugin.chart.theme import DARK, LIGHT

        results = self.write()
        if results["runs"]:
            place = self.folder.path
            draw(results, place / "chart.png", LIGHT)
            draw(results, place / "chart-dark.png", DARK)
            write_page(results, place / "chart.html")
        return results


def _place(record: dict[str, Any], order: Sequence[str]) -> tuple[int, str, int]:
    key = Contender.from_dict(record["contender"]).key
    place = order.index(key) if key in order else len(order)
    return place, key, record["run"]["seed"]


def _run_of(record: dict[str, Any], contenders: Sequence[Contender]) -> dict[str, Any]:
    """The run under the name that its contender has now."""
    key = Contender.from_dict(record["contender"]).key
    names = {contender.key: contender.name for contender in contenders}
    return {**record["run"], "name": names.get(key, record["contender"]["name"])}
