"""The folder of a chart: each finished run in a file of its own, and what all of them share."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from leco_plugin.chart.contender import Contender
from leco_plugin.evaluation.json_file import write_json
from leco_plugin.scenes.input_error import InputError

SETTINGS, RUNS, UNFINISHED, LOGS = "settings.json", "runs", "unfinished", "logs"


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
        file = path / SETTINGS
        wanted = json.loads(json.dumps(settings))
        if file.exists():
            _refuse_others(path, json.loads(file.read_text()), wanted)
        elif path.exists() and any(path.iterdir()):
            raise InputError(f"{path} holds something else; name a new folder with --out")
        else:
            write_json(file, wanted)
        shutil.rmtree(path / UNFINISHED, ignore_errors=True)  # of a process that was killed
        for name in (RUNS, UNFINISHED, LOGS):
            (path / name).mkdir(exist_ok=True)

    def stored(self) -> dict[str, dict[str, Any]]:
        """Finished runs by the name of their job; each has `contender` and `run`."""
        found = {}
        for file in sorted((self.path / RUNS).glob("*.json")):
            found[file.stem] = json.loads(file.read_text())
        return found

    def store(self, job: Job, run: Mapping[str, Any]) -> None:
        """Keeps a finished run: whole, or not at all."""
        record = {"contender": asdict(job.contender), "run": dict(run)}
        write_json(self.path / RUNS / f"{job.name}.json", record)


def _refuse_others(path: Path, found: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
    names = [name for name in wanted if found.get(name) != wanted[name]]
    if names:
        name = names[0]
        raise InputError(
            f"{path} holds a chart with another {name.replace('_', ' ')} "
            f"({_short(found.get(name))}, not {_short(wanted[name])}); name a new folder with --out"
        )


def _short(value: Any) -> str:
    """A value in a line."""
    if isinstance(value, Mapping):
        value = ", ".join(str(part) for part in value.values())
    text = str(value)
    return text if len(text) < 120 else f"{text[:117]}..."
