"""Makes the runs of a chart that are missing, and writes what all of them say."""

from __future__ import annotations

import datetime
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import asdict
from pathlib import Path
from typing import Any

from leco_plugin.chart.contenders import forecast
from leco_plugin.chart.contenders.contender import Contender
from leco_plugin.chart.contenders.protocol import Protocol, require_seeds, settings_of
from leco_plugin.chart.drawing.table import write_table
from leco_plugin.chart.runs.folder import RESULTS, ChartFolder, Job
from leco_plugin.chart.runs.processes import RunFailed
from leco_plugin.chart.runs.reuse import check_sources, take_over
from leco_plugin.evaluation.json_file import write_json
from leco_plugin.evaluation.machine import describe_code, describe_machine
from leco_plugin.scenes.description import describe_scene

Runner = Callable[[Job, Callable[[float], None]], dict[str, Any]]
Say = Callable[[str], None]

TABLE = "table.md"


def jobs_of(contenders: Sequence[Contender], seeds: Sequence[int]) -> list[Job]:
    """All runs: the contenders take turns within a seed, each seed beginning with another, so that
    a machine whose speed drifts treats them alike."""
    jobs = []
    for turn, seed in enumerate(dict.fromkeys(seeds)):
        first = turn % len(contenders)
        order = [*contenders[first:], *contenders[:first]]
        jobs += [Job(contender, seed) for contender in order]
    return jobs


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
        suite: tuple[str, str] | None = None,
        command: str = "leco chart",
        reuse: Sequence[Path] = (),
    ) -> None:
        if not contenders or not seeds:
            raise ValueError("a chart needs at least one method and one seed")
        require_seeds(seeds)
        self.data, self.scene, self.machine = data, describe_scene(data), describe_machine()
        self.machine["threads"] = protocol.threads(self.machine["threads"])
        self.protocol, self.suite, self.command = protocol, suite, command
        self.stop = threading.Event()
        self.contenders = list(contenders)
        self.jobs = jobs_of(contenders, seeds)
        name = suite[0] if suite is not None else None
        self.settings = settings_of(self.scene, protocol, name, self.machine)
        check_sources(reuse, self.settings)
        self.folder = ChartFolder(out, self.settings)
        self.reuse = list(reuse)

    def missing(self) -> list[Job]:
        """Runs that are not stored. One that failed is missing."""
        stored = self.folder.stored()
        return [job for job in self.jobs if job.name not in stored]

    def make(self, runner: Runner, say: Say = print, show: Callable[[float], None] = print) -> None:
        """Makes what is missing; whenever it is stopped, what was finished is kept.

        Args:
            runner: makes one run, or raises `RunFailed`; asked in several threads where there are
                several runs at once. It ends what is under way when `stop` is set.
            say: called with a line for each run.
            show: called with the share of all runs that is done.
        Raises:
            InputError: another process makes runs in the same folder.
        """
        with self.folder.alone():
            self._make_missing(runner, say, show)

    def _make_missing(self, runner: Runner, say: Say, show: Callable[[float], None]) -> None:
        taken = take_over(self.folder, self.missing(), self.reuse)
        if taken:
            say(f"{_counted(len(taken), 'run')} taken over from other charts")
        todo = self.missing()
        if todo:
            say(self.forecast(todo))
        self.write()
        shares = {job.name: float(job not in todo) for job in self.jobs}

        def make_one(job: Job) -> str:
            def show_share(share: float) -> None:
                shares[job.name] = share
                show(sum(shares.values()) / len(shares))

            show_share(0.0)
            said = self._make_one(job, runner, show_share)
            shares[job.name] = 1.0
            return said

        with ThreadPoolExecutor(self.protocol.at_once) as pool:
            under_way: set[Future[str]] = set()
            try:
                for job in todo:
                    under_way.add(pool.submit(make_one, job))
                    if len(under_way) == self.protocol.at_once:
                        self._collect(under_way, say)
                while under_way:
                    self._collect(under_way, say)
            except BaseException:
                self.stop.set()
                raise

    def _make_one(self, job: Job, runner: Runner, show: Callable[[float], None]) -> str:
        """Makes a run and keeps it, or why there is none; returns a line about it."""
        title = f"seed {job.seed}, {job.contender.name}"
        try:
            run = runner(job, show)
        except RunFailed as failure:
            if self.stop.is_set():  # its process was told to end when we were
                raise KeyboardInterrupt from None
            self.folder.fail(job, str(failure))
            return f"{title}: failed: {failure}"
        code = run.pop("code", None) or describe_code()
        self.folder.store(job, run, {**self._made(), **code})
        return (
            f"{title}: {run['psnr']:.2f} dB after {run['train_seconds']:.0f} s, "
            f"{run['render_seconds_per_image']:.2f} s an image"
        )

    def _collect(self, under_way: set[Future[str]], say: Say) -> None:
        """Waits for one run, or more that end together, and takes them out."""
        done, rest = wait(under_way, return_when=FIRST_COMPLETED)
        under_way &= rest
        for future in done:
            say(future.result())
        self.write()

    def forecast(self, todo: Sequence[Job]) -> str:
        """How many runs are to be made, and about how long that takes."""
        about = forecast.about((job.contender for job in todo), self.protocol)
        runs = f"{_counted(len(todo), 'run')} of {self.protocol.describe()}"
        beside = f", {self.protocol.at_once} at a time" if self.protocol.at_once > 1 else ""
        stored = len(self.jobs) - len(todo)
        there = f" ({stored} more are there already)" if stored else ""
        return f"{runs}{beside}, {about}{there}"

    def _failures(self) -> list[dict[str, Any]]:
        """All that ended without a result, and whether this call asked for them."""
        asked = {(job.contender.name, job.seed) for job in self.jobs}
        found = self.folder.failures()
        return [{**one, "asked": (one["name"], one["seed"]) in asked} for one in found]

    def results(self) -> dict[str, Any]:
        """All finished runs in the folder, the contenders of this call first."""
        stored = {
            name: record
            for name, record in self.folder.stored().items()
            if not _is_of_another(record, self.contenders)
        }
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
            "made": self._made_of(stored),
            "occupancy": occupancies[0] if occupancies else None,
            "runs": runs,
            "failures": self._failures(),
            "missing": self._unfinished(stored),
        }

    def _unfinished(self, stored: Mapping[str, object]) -> int:
        """How many of the runs of this call have neither ended well nor failed yet."""
        failed = {(one["name"], one["seed"]) for one in self.folder.failures()}
        todo = [job for job in self.jobs if job.name not in stored]
        return sum((job.contender.name, job.seed) not in failed for job in todo)

    def _made(self) -> dict[str, Any]:
        """When, how and by which code something is made now."""
        today = datetime.date.today().isoformat()
        return {"date": today, "command": self.command, **describe_code()}

    def _made_of(self, stored: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
        """The same of all runs that are stored: this call's command, where it asks for all of them,
        else those that made the others before it; and the commits at which they were made."""
        asked = {job.name for job in self.jobs}
        made = {name: record.get("made") or {} for name, record in stored.items()}
        others = [of["command"] for name, of in made.items() if name not in asked and of]
        commits = sorted({of["commit"] for of in made.values() if of.get("commit")})
        now = self._made()
        return {
            **now,
            "command": " && ".join(dict.fromkeys([*others, self.command])),
            "commit": ", ".join(commits) or now["commit"],
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
        from leco_plugin.chart.drawing.page import write_page
        from leco_plugin.chart.drawing.picture import draw
        from leco_plugin.chart.drawing.theme import DARK, LIGHT

        results = self.write()
        if results["runs"]:
            place = self.folder.path
            draw(results, place / "chart.png", LIGHT)
            draw(results, place / "chart-dark.png", DARK)
            write_page(results, place / "chart.html")
        return results


def _counted(count: int, name: str) -> str:
    return f"{count} {name}{'s' if count != 1 else ''}"


def _place(record: dict[str, Any], order: Sequence[str]) -> tuple[int, str, int]:
    key = Contender.from_dict(record["contender"]).key
    place = order.index(key) if key in order else len(order)
    return place, key, record["run"]["seed"]


def _is_of_another(record: dict[str, Any], contenders: Sequence[Contender]) -> bool:
    """Whether a run bears the name of a contender and was made with other settings, as by an
    earlier version: both in one line would be a mean of two things."""
    made = Contender.from_dict(record["contender"])
    same_name = [one for one in contenders if one.name == made.name]
    return bool(same_name) and all(one.key != made.key for one in same_name)


def _run_of(record: dict[str, Any], contenders: Sequence[Contender]) -> dict[str, Any]:
    """The run under the name that its contender has now, with the code that made it."""
    key = Contender.from_dict(record["contender"]).key
    names = {contender.key: contender.name for contender in contenders}
    made = record.get("made") or {}
    code = made.get("sources") or made.get("commit")
    return {**record["run"], "name": names.get(key, record["contender"]["name"]), "code": code}
