"""The folder of a chart: each finished run in a file of its own, and what all of them share."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from leco_plugin.chart.contenders.contender import Contender
from leco_plugin.evaluation.json_file import read_object, write_json
from leco_plugin.scenes.input_error import InputError
from leco_plugin.studio.run_folder import alone_in

SETTINGS, RESULTS = "settings.json", "results.json"
RUNS, UNFINISHED, LOGS = "runs", "unfinished", "logs"
DAMAGED = "is damaged, or not of a chart; delete it, or name a new folder"


@dataclass(frozen=True)
class Job:
    """One run to be made."""

    contender: Contender
    seed: int

    @property
    def name(self) -> str:
        """Of its files."""
        return f"{self.contender.key}-seed-{self.seed}"


class ChartFolder:
    """Runs that may stand on one chart: the same scene, time, evaluation and machine.

    More methods and more seeds may join later; other settings may not.

    Args:
        path: the folder, made if there is none.
        settings: JSON values that all runs share.

    Raises:
        InputError: the folder holds something else, or runs with other settings.
        OSError: it cannot be written.
    """

    def __init__(self, path: Path, settings: Mapping[str, Any]) -> None:
        self.path = path
        found = read_settings(path)
        if found is not None and (other := difference(found, settings)):
            raise InputError(
                f"{path} holds a chart with another {other}; name a new folder with --out"
            )
        if found is None and path.exists() and any(path.iterdir()):
            raise InputError(f"{path} holds something else; name a new folder with --out")
        if found is None:
            write_json(path / SETTINGS, dict(settings))
        for name in (RUNS, UNFINISHED, LOGS):
            (path / name).mkdir(exist_ok=True)

    @contextmanager
    def alone(self) -> Iterator[None]:
        """While runs are made: no other process makes any here.

        Raises:
            InputError: another one does.
        """
        with alone_in(self.path, "chart"):
            shutil.rmtree(self.path / UNFINISHED, ignore_errors=True)  # of one that was killed
            (self.path / UNFINISHED).mkdir(exist_ok=True)
            yield

    def stored(self) -> dict[str, dict[str, Any]]:
        """Finished runs by the name of their job; each has `contender`, `run`, and `made`, unless
        it is from before charts noted that."""
        return stored_in(self.path)

    def store(
        self,
        job: Job,
        run: Mapping[str, Any],
        made: Mapping[str, Any] | None = None,
        reused: bool = False,
    ) -> None:
        """Keeps a finished run: whole, or not at all.

        Args:
            made: when, by which command and by which code.
            reused: whether it was made for another chart.
        """
        record: dict[str, Any] = {
            "contender": asdict(job.contender),
            "run": {**run, "reused": True} if reused else dict(run),
        }
        if made is not None:
            record["made"] = dict(made)
        write_json(self.path / RUNS / f"{job.name}.json", record)
        (self.path / LOGS / f"{job.name}.json").unlink(missing_ok=True)

    def fail(self, job: Job, reason: str) -> None:
        """Notes that a run has ended without a result, until it is made again."""
        one = job.contender
        failure = {"name": one.name, "method": one.method, "sampler": one.sampler}
        write_json(
            self.path / LOGS / f"{job.name}.json", failure | {"seed": job.seed, "reason": reason}
        )

    def failures(self) -> list[dict[str, Any]]:
        """Runs that ended without a result, by seed: `name`, `method`, `sampler`, `seed` and
        `reason`."""
        found = [read_object(file, DAMAGED) for file in sorted((self.path / LOGS).glob("*.json"))]
        return sorted(found, key=lambda failure: (failure["seed"], failure["name"]))

    def keep(self, job: Job, files: Iterable[Path]) -> None:
        """Copies files that a run has left beside its record, under the name of its job."""
        for file in files:
            shutil.copyfile(file, self.path / RUNS / f"{job.name}{file.suffix}")


def stored_in(path: Path) -> dict[str, dict[str, Any]]:
    """The records in the folder of a chart, by the names of their jobs.

    Raises:
        InputError: one is damaged.
    """
    found = {}
    for file in sorted((path / RUNS).glob("*.json")):
        record = read_object(file, DAMAGED)
        if not all(isinstance(record.get(part), dict) for part in ("contender", "run")):
            raise InputError(f"{file} is no run of a chart; delete it to have it made again")
        found[file.stem] = record
    return found


def read_settings(path: Path) -> dict[str, Any] | None:
    """What the runs of the chart in a folder share; None where there is no chart.

    Raises:
        InputError: it cannot be read.
    """
    file = path / SETTINGS
    # runs came one after the other before charts noted how many there are at once
    return {"at_once": 1, **read_object(file, DAMAGED)} if file.is_file() else None


def difference(found: Mapping[str, Any], wanted: Mapping[str, Any]) -> str | None:
    """The first setting that is not as wanted, in words; None where all are."""
    for name, value in json.loads(json.dumps(wanted)).items():
        if found.get(name) != value:
            said = f"{_short(found.get(name))}, not {_short(value)}"
            return f"{name.replace('_', ' ')} ({said})"
    return None


def _short(value: Any) -> str:
    """A value in a line."""
    if isinstance(value, Mapping):
        value = ", ".join(str(part) for part in value.values())
    text = str(value)
    return text if len(text) < 120 else f"{text[:117]}..."
