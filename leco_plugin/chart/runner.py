"""Jobs in processes of their own, with a folder that keeps every finished one.

A process of its own gives each job its peak of memory, and a crash ends only one of them.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from leco_plugin.evaluation.report import read_object
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.whole_files import LOCK, write_json, writing_into

if TYPE_CHECKING:
    from leco_plugin.chart.contender import Job

SETTINGS, RESULTS = "settings.json", "results.json"
RUNS, UNFINISHED, LOGS = "runs", "unfinished", "logs"
JOB, RESULT, FAILURE, PROGRESS = "job.json", "result.json", "failure.json", "progress"
"""Files in the folder of a job that is under way."""
KEPT = ("occupancy.safetensors", "view.png")
"""Files of a job that are kept beside its record, under its name and their ending."""
DAMAGED = "is damaged, or not of a chart; delete it, or name a new folder"
POLL_SECONDS = 0.25


Runner = Callable[[Any, Callable[[float], None]], dict[str, Any]]
"""Makes a job and returns its result as JSON values; reports the share that is done."""


class RunFailed(RuntimeError):
    """A job has ended without a result; the message is the reason."""


class RunFolder:
    """Finished jobs that share their settings, JSON values: one file for each.

    Raises:
        InputError: the folder holds something else, or jobs with other settings.
        OSError: it cannot be written.
    """

    def __init__(self, path: Path, settings: Mapping[str, Any]) -> None:
        self.path = path
        take_folder(path / SETTINGS, settings)
        for name in (RUNS, UNFINISHED, LOGS):
            (path / name).mkdir(exist_ok=True)

    def clear(self) -> None:
        """Deletes what killed processes left. Only for the process that alone makes jobs here."""
        shutil.rmtree(self.path / UNFINISHED, ignore_errors=True)
        (self.path / UNFINISHED).mkdir(exist_ok=True)

    def stored(self) -> dict[str, dict[str, Any]]:
        return stored_in(self.path)

    def store(self, job: Job, run: Mapping[str, Any], **noted: Any) -> None:
        """Keeps the result of a job, whole or not at all."""
        record = {**asdict(job), "run": dict(run), **noted}
        write_json(self.path / RUNS / f"{job.name}.json", record)
        (self.path / LOGS / f"{job.name}.json").unlink(missing_ok=True)

    def fail(self, job: Job, reason: str) -> None:
        """Notes why a job has no result, until it is made again."""
        write_json(self.path / LOGS / f"{job.name}.json", {**asdict(job), "reason": reason})

    def failures(self) -> list[dict[str, Any]]:
        """Jobs without a result: their values, the `reason`, and the name of the `job`."""
        files = sorted((self.path / LOGS).glob("*.json"))
        return [{**read_object(file, DAMAGED), "job": file.stem} for file in files]


def stored_in(path: Path) -> dict[str, dict[str, Any]]:
    """Records of finished jobs in a folder, by name: the values of the job, `run` and what was
    noted. A damaged one is an `InputError`."""
    found = {}
    for file in sorted((path / RUNS).glob("*.json")):
        record = read_object(file, DAMAGED)
        if not all(isinstance(record.get(part), dict) for part in ("contender", "run")):
            raise InputError(f"{file} is no run of a chart; delete it to have it made again")
        found[file.stem] = record
    return found


def take_folder(
    file: Path,
    settings: Mapping[str, Any],
    holds: str = "a chart with another",
    damaged: str = DAMAGED,
    words: Mapping[str, str] | None = None,
) -> None:
    """Writes settings to a file in a new or empty folder, or checks those that it holds.

    Args:
        holds: what is said of a folder before the first setting that is not as wanted.
        damaged: what is said of a damaged file.
        words: what is said of a folder with another value of a setting, by its name, instead of
            `holds` and both values.
    Raises:
        InputError: it holds something else, has other settings, or cannot be written; nothing was.
    """
    folder = file.parent
    if file.is_file():
        found = read_object(file, damaged)
        if (other := _first_other(found, settings)) is not None:
            said = (words or {}).get(other[0]) or f"{holds} {_in_words(found, *other)}"
            raise InputError(f"{folder} holds {said}; name a new folder with --out")
    elif folder.exists() and (not folder.is_dir() or set(os.listdir(folder)) - {LOCK}):
        raise InputError(f"{folder} holds something else; name a new folder with --out")
    else:
        with writing_into(folder, "--out"):
            write_json(file, dict(settings))


def difference(found: Mapping[str, Any], wanted: Mapping[str, Any]) -> str | None:
    """The first setting that is not as wanted, in words; None where all are."""
    other = _first_other(found, wanted)
    return None if other is None else _in_words(found, *other)


def _first_other(found: Mapping[str, Any], wanted: Mapping[str, Any]) -> tuple[str, Any] | None:
    """Name and wanted value of the first setting that is not as wanted; None where all are."""
    stored = json.loads(json.dumps(wanted))  # tuples as lists
    return next((pair for pair in stored.items() if found.get(pair[0]) != pair[1]), None)


def _in_words(found: Mapping[str, Any], name: str, wanted: Any) -> str:
    return f"{name.replace('_', ' ')} ({_short(found.get(name))}, not {_short(wanted)})"


def _short(value: Any) -> str:
    if isinstance(value, Mapping):
        value = ", ".join(str(part) for part in value.values())
    text = str(value)
    return text if len(text) < 120 else f"{text[:117]}..."


def make_jobs(
    jobs: Sequence[Any],
    make_one: Callable[[Any, Callable[[float], None]], str],
    say: Callable[[str], None],
    show: Callable[[float], None],
    *,
    stop: threading.Event | None = None,
    at_once: int = 1,
    done: int = 0,
    is_wanted: Callable[[Any], bool] = lambda job: True,
) -> None:
    """Makes jobs in their order: in this thread, or several at a time in threads of their own.

    Args:
        make_one: makes a job, keeps its result, and returns a line about it.
        say: called with that line, in this thread.
        show: called with the share of all jobs that is done.
        stop: set when an error or Ctrl-C ends this, to end the jobs that are under way.
        done: jobs that were finished before.
        is_wanted: asked when a job's turn comes; one that is not is left out.
    """
    shares = [0.0] * len(jobs)

    def make(number: int) -> str | None:
        def show_share(share: float) -> None:
            shares[number] = share
            show((done + sum(shares)) / (done + len(shares)))

        if not is_wanted(jobs[number]):
            return None
        show_share(0.0)
        said = make_one(jobs[number], show_share)
        show_share(1.0)
        return said

    if at_once == 1:
        for number in range(len(jobs)):
            if (said := make(number)) is not None:
                say(said)
        return
    with ThreadPoolExecutor(at_once) as pool:
        under_way = [pool.submit(make, number) for number in range(len(jobs))]
        try:
            for finished in as_completed(under_way):
                if (said := finished.result()) is not None:
                    say(said)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            if stop is not None:
                stop.set()
            raise


class ProcessRunner:
    """Makes each job in a process of its own.

    Args:
        data, protocol: the scene and a dataclass, written beside the values of the job.
        command: what is started; the folder of the job is its last argument.
        threads: of a process; None leaves them to it.
        stop: ends the jobs under way when it is set.
    """

    def __init__(
        self,
        data: Path,
        protocol: Any,
        folder: RunFolder,
        command: Sequence[str],
        threads: int | None = None,
        stop: threading.Event | None = None,
    ) -> None:
        self.shared = {"data": str(data.resolve()), "protocol": asdict(protocol)}
        self.folder, self.command = folder, list(command)
        limit = {} if threads is None else {"OMP_NUM_THREADS": str(threads)}
        self.environment = {**os.environ, **limit}
        self.stop = stop or threading.Event()

    def __call__(self, job: Job, show: Callable[[float], None]) -> dict[str, Any]:
        """The result of a job, whose files of `KEPT` are left beside the records.

        Raises:
            RunFailed: the process has failed or was killed.
            KeyboardInterrupt: it was ended because all is to stop.
        """
        place = self.folder.path
        work = Path(tempfile.mkdtemp(prefix=f"{job.name}-", dir=place / UNFINISHED))
        write_json(work / JOB, asdict(job) | self.shared)
        log = place / LOGS / f"{job.name}.log"
        status = self._wait_for(work, log, show)
        if not (work / RESULT).exists():
            if self.stop.is_set() or status == -signal.SIGINT:  # Ctrl-C tells all processes to end
                raise KeyboardInterrupt
            raise RunFailed(_reason(work, status, log))
        result: dict[str, Any] = json.loads((work / RESULT).read_text())
        for file in (work / name for name in KEPT):
            if file.exists():
                file.replace(place / RUNS / f"{job.name}{file.suffix}")
        shutil.rmtree(work)
        log.unlink()
        return result

    def _wait_for(self, work: Path, log: Path, show: Callable[[float], None]) -> int:
        with log.open("wb") as printed:
            # the worker ends when its input does, and so never outlives this process
            child = subprocess.Popen(
                [*self.command, str(work)],
                stdin=subprocess.PIPE,
                stdout=printed,
                stderr=subprocess.STDOUT,
                env=self.environment,
            )
            try:
                while child.poll() is None:
                    time.sleep(POLL_SECONDS)
                    if self.stop.is_set():
                        raise KeyboardInterrupt
                    if (work / PROGRESS).exists():
                        show(float((work / PROGRESS).read_text() or 0.0))
            finally:
                child.kill()
                child.wait()
                if child.stdin is not None:
                    child.stdin.close()
        return child.returncode


def _reason(work: Path, status: int, log: Path) -> str:
    if (work / FAILURE).exists():
        return str(json.loads((work / FAILURE).read_text())["reason"])
    if status < 0:
        name = signal.Signals(-status).name
        memory = "; the machine may have run out of memory" if name == "SIGKILL" else ""
        return f"the process was ended by {name}{memory}"
    lines = log.read_text(errors="replace").split("\n")
    last = next((line.strip() for line in reversed(lines) if line.strip()), "it said nothing")
    return f"the process ended with status {status}: {last[:200]}"


def die_with_parent() -> None:
    """Ends this process when its parent has gone: a run that nobody waits for slows timed ones."""

    def wait_for_end() -> None:
        while os.read(sys.stdin.fileno(), 1):
            pass
        os._exit(1)

    threading.Thread(target=wait_for_end, daemon=True).start()
