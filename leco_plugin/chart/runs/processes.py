"""Runs in processes of their own: a peak of memory belongs to one, and a crash ends only one."""

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
from dataclasses import asdict
from pathlib import Path
from typing import Any

from leco_plugin.chart.contenders.protocol import Protocol
from leco_plugin.chart.runs.folder import LOGS, RUNS, UNFINISHED, ChartFolder, Job
from leco_plugin.chart.runs.worker import FAILURE, JOB, PROGRESS, RESULT
from leco_plugin.evaluation.json_file import write_json

KEPT = ("occupancy.safetensors", "view.png")
"""What a run may leave in its folder to be kept beside its record, by its ending."""
POLL_SECONDS = 0.25
WORKER = (sys.executable, "-W", "ignore", "-m", "leco_plugin.chart.runs.worker")


class RunFailed(RuntimeError):
    """A run has ended without a result; the message is its reason."""


class ProcessRunner:
    """Makes the runs of a chart, one after the other.

    Args:
        data: the scene.
        protocol: how long, and how they are evaluated.
        folder: of the chart; a failed run leaves its log there.
        command: what is started, with the folder of the job behind it.
        environment: variables of that process that differ from those of this one.
        stop: when it is set, a run under way is ended.
    """

    def __init__(
        self,
        data: Path,
        protocol: Protocol,
        folder: ChartFolder,
        command: Sequence[str] = WORKER,
        environment: Mapping[str, str] | None = None,
        stop: threading.Event | None = None,
    ) -> None:
        self.data, self.protocol, self.folder = data.resolve(), protocol, folder
        self.command = list(command)
        self.environment = {**os.environ, **(environment or {})}
        self.stop = stop or threading.Event()

    def __call__(self, job: Job, show: Callable[[float], None]) -> dict[str, Any]:
        """The run's record. Its occupancy is left beside the stored runs.

        Args:
            show: called with the share that is done.
        Raises:
            RunFailed: the process has failed or was killed.
            KeyboardInterrupt: it was ended because all is to stop.
        """
        place = self.folder.path
        work = Path(tempfile.mkdtemp(prefix=f"{job.name}-", dir=place / UNFINISHED))
        write_json(
            work / JOB,
            {
                "contender": asdict(job.contender),
                "seed": job.seed,
                "data": str(self.data),
                "protocol": asdict(self.protocol),
            },
        )
        log = place / LOGS / f"{job.name}.log"
        status = self._wait_for(work, log, show)
        if not (work / RESULT).exists():
            raise RunFailed(_reason(work, status, log))
        result: dict[str, Any] = json.loads((work / RESULT).read_text())
        for name in KEPT:
            if (work / name).exists():
                kept = (place / RUNS / job.name).as_posix() + Path(name).suffix
                (work / name).replace(kept)
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
    """Why there is no result, in one line."""
    if (work / FAILURE).exists():
        return str(json.loads((work / FAILURE).read_text())["reason"])
    if status < 0:
        name = signal.Signals(-status).name
        memory = "; the machine may have run out of memory" if name == "SIGKILL" else ""
        return f"the process was ended by {name}{memory}"
    lines = log.read_text(errors="replace").split("\n")
    last = next((line.strip() for line in reversed(lines) if line.strip()), "it said nothing")
    return f"the process ended with status {status}: {last[:200]}"
