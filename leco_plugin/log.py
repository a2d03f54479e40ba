"""What is said while something runs: lines and progress bars, once for all processes."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from torch import distributed

from leco_plugin.models.compute.ranks import is_first

SECONDS_A_LINE = 60.0
"""Between two lines where there is no terminal to draw a bar on."""
OF_A_DEVICE = ("leco_plugin.samplers.kernels.fused", "leco_plugin.models.compute.grouped")
"""Whose warnings are of the device of one process; all others have the same everywhere."""


def console() -> Console:
    """nerfstudio's console where that is loaded, else one as wide."""
    nerfstudio = sys.modules.get("nerfstudio.utils.rich_utils")
    return _own_console() if nerfstudio is None else nerfstudio.CONSOLE


@cache
def _own_console() -> Console:
    return Console(width=120)


def say(line: str) -> None:
    """A line in the log, said once for all processes."""
    if is_first():
        console().log(f"\\[leco] {line}", _stack_offset=2)


class _Says(logging.Handler):
    """Says what samplers and experts log."""

    def emit(self, record: logging.LogRecord) -> None:
        line = escape(record.getMessage())
        if is_first():
            say(line)
        elif record.levelno >= logging.WARNING and record.name in OF_A_DEVICE:
            console().log(f"\\[leco] process {distributed.get_rank()}: {line}")


def say_what_is_logged() -> None:
    """From now on lines of the package's logger, also those that are no warnings, are said."""
    log = logging.getLogger("leco_plugin")
    if not any(isinstance(handler, _Says) for handler in log.handlers):
        log.addHandler(_Says())
        log.setLevel(logging.INFO)


@contextmanager
def bar(what: str) -> Iterator[Callable[[float], None]]:
    """Shows a bar while it lasts, once for all processes; yields what takes the share done.

    In a file or a pipe, where no bar can be drawn, it is a line a minute.
    """
    if not (console().is_terminal or console().is_jupyter):
        yield _lines(what) if is_first() else lambda share: None
        return
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TimeElapsedColumn())
    with Progress(
        *columns, TimeRemainingColumn(), console=console(), transient=True, disable=not is_first()
    ) as progress:
        task = progress.add_task(what, total=1.0)
        yield lambda share: progress.update(task, completed=share)


def _lines(what: str) -> Callable[[float], None]:
    began = said = time.monotonic()

    def show(share: float) -> None:
        nonlocal said
        now = time.monotonic()
        if now - said >= SECONDS_A_LINE:
            said = now
            said_now = f"{what}: {share:.0%} after {now - began:.0f} s"
            console().print(said_now, markup=False, highlight=False)

    return show


@contextmanager
def resumable(say: Callable[[str], None]) -> Iterator[None]:
    """A context for resumable work: Ctrl-C logs that finished parts are kept."""
    try:
        yield
    except KeyboardInterrupt:
        say("stopped; what is finished is kept, and the same command goes on with the rest")
        raise
