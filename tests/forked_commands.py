"""Commands of nerfstudio and of this package, in forks of one process that imported them once.

A command alone takes some six seconds to import nerfstudio; what it then computes on a scene for
tests takes one.
"""

from __future__ import annotations

import atexit
import importlib
import json
import os
import runpy
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from leco_plugin.studio.commands import (
    render_images_without_ffmpeg,
    show_one_line_in_ns_commands,
)

ENTRY_POINTS = {
    "ns-train": "nerfstudio.scripts.train:entrypoint",
    "ns-eval": "nerfstudio.scripts.eval:entrypoint",
    "ns-render": "nerfstudio.scripts.render:entrypoint",
    "leco": "leco_plugin.cli:main",
    "ns-export": "nerfstudio.scripts.exporter:entrypoint",
    "python": "forked_commands:run_script",
}
NOT_EVERYWHERE = ("ns-export", "python")
"""Imported only when they are run: not all machines have open3d, which the first one needs."""


class ForkedCommands:
    """Runs commands one after the other; a context manager.

    Args:
        environment: variables of the commands' processes.
        folder: their working directory, and where their output is kept.
    """

    def __init__(self, environment: dict[str, str], folder: Path) -> None:
        self.folder = folder
        self.count = 0
        here = str(Path(__file__).parent)
        paths = [here, *filter(None, [environment.get("PYTHONPATH")])]
        self.server = subprocess.Popen(
            [sys.executable, __file__],
            env=environment | {"PYTHONPATH": os.pathsep.join(paths)},
            cwd=folder,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,  # of the imports; each command has a log
            text=True,
        )

    def __enter__(self) -> ForkedCommands:
        return self

    def __exit__(self, *_: object) -> None:
        _pipe(self.server.stdin).close()
        self.server.wait(timeout=60)
        _pipe(self.server.stdout).close()

    def __call__(self, name: str, *arguments: object, status: int = 0) -> str:
        """Runs a command to its end, which must be of this status; returns what it printed."""
        started = self.start(name, *arguments)
        found = started.wait()
        printed = started.log.read_text()
        assert found == status, f"{name} ended with {found}:\n{printed[-4000:]}"
        return printed

    def start(self, name: str, *arguments: object) -> Started:
        """Starts a command, for whose end one waits before the next one."""
        self.count += 1
        log = self.folder / f"{self.count:03d}-{name}.log"
        log.touch()  # for who looks before it has begun
        asked = {"command": [name, *map(str, arguments)], "log": str(log), "number": self.count}
        line = json.dumps(asked)
        stdin = _pipe(self.server.stdin)
        stdin.write(line + "\n")
        stdin.flush()
        number = self.count
        return Started(self._answer(number), log, lambda: self._answer(number))

    def _answer(self, number: int) -> int:
        """The next answer about the command of this number; what is still said of an earlier one,
        for whose end a test did not wait, is left out."""
        while True:
            about, value = map(int, _pipe(self.server.stdout).readline().split())
            if about == number:
                return value


@dataclass
class Started:
    """A command that is running: its process, what it prints, and a function that waits for its end
    and returns its status, of a signal a negative one."""

    process: int
    log: Path
    wait: Callable[[], int]

    def until(self, seen: Callable[[], bool], seconds: float = 120.0) -> None:
        """Returns as soon as something is seen; fails if it ends before, or takes so long."""
        deadline = time.monotonic() + seconds
        while not seen():
            ended = not Path(f"/proc/{self.process}").exists()
            assert not ended and time.monotonic() < deadline, self.log.read_text()[-4000:]
            time.sleep(0.05)


def _pipe(pipe: IO[str] | None) -> IO[str]:
    assert pipe is not None
    return pipe


def run_script() -> None:
    """The script that the first argument names, with the others."""
    del sys.argv[0]
    runpy.run_path(sys.argv[0], run_name="__main__")


def _run(command: list[str], log: str) -> int:
    """One command in this process, which ends with it; returns its exit status."""
    with open(log, "wb") as printed:
        os.dup2(printed.fileno(), sys.stdout.fileno())
        os.dup2(printed.fileno(), sys.stderr.fileno())
    sys.argv = command
    show_one_line_in_ns_commands()
    render_images_without_ffmpeg()
    module, _, function = ENTRY_POINTS[command[0]].partition(":")
    try:
        ended = getattr(importlib.import_module(module), function)()
    except SystemExit as end:
        ended = end.code
    except BaseException:  # noqa: BLE001  as Python itself ends
        sys.excepthook(*sys.exc_info())
        ended = 1
    if isinstance(ended, str):
        print(ended, file=sys.stderr)
        ended = 1
    sys.stdout.flush()
    sys.stderr.flush()
    return int(ended or 0)


def _end(status: int) -> None:
    """Ends this process as Python does, after its threads and what runs at exit; but what it has
    imported is not taken down piece by piece, which takes longer than most commands."""
    threading._shutdown()
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


def _serve() -> None:
    import quick_imports  # noqa: F401
    from mortal_training import leave_out_the_cache

    for name, entry in ENTRY_POINTS.items():
        if name not in NOT_EVERYWHERE:
            importlib.import_module(entry.partition(":")[0])
    importlib.import_module("leco_plugin.swap")
    leave_out_the_cache()
    for line in sys.stdin:
        asked = json.loads(line)
        number = asked.pop("number")
        child = os.fork()
        if child == 0:
            _end(_run(**asked))
        print(number, child, flush=True)
        _, status = os.waitpid(child, 0)
        print(number, os.waitstatus_to_exitcode(status), flush=True)


if __name__ == "__main__":
    _serve()
