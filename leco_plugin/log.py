"""What is said while something runs: lines and progress bars, once for all processes.

A run with a log file has a short screen: `say` writes to both, `note` to the file alone.
"""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Protocol, TextIO, TypeVar

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from torch import distributed

from leco_plugin.models.compute.ranks import is_first

T = TypeVar("T")
R = TypeVar("R")
SECONDS_TO_FIRST, SECONDS_A_LINE, SHARE_A_LINE = 10.0, 60.0, 0.05
"""To the first line without a terminal to draw a bar on, and between two lines: seconds, share."""
OF_A_DEVICE = ("leco_plugin.samplers.kernels.fused", "leco_plugin.models.compute.grouped")
"""Whose warnings are of the device of one process; all others have the same everywhere."""
SCREEN, WIDE = Console(highlight=False), Console(width=120)

_details: TextIO | None = None
"""The log file of the run that goes on."""
_kept_back: list[str] | None = None
"""Lines that whoever keeps them back may still show."""


@contextmanager
def details_in(file: TextIO) -> Iterator[None]:
    """While this lasts, details go to a log file, and the screen has only what `say` is given."""
    global _details
    before, _details = _details, file
    try:
        yield
    finally:
        _details = before


@contextmanager
def kept_back() -> Iterator[list[str]]:
    """While this lasts, yields what would be said by `say`, `note` and the package's loggers."""
    global _kept_back
    say_what_is_logged()
    before, _kept_back = _kept_back, []
    try:
        yield _kept_back
    finally:
        _kept_back = before


def on_screen() -> bool:
    """Whether a run with a log file goes on, whose user watches a short screen."""
    return _details is not None


def console() -> Console:
    """The screen of a run with a log file; else nerfstudio's console, if loaded, or one as wide."""
    if _details is not None:
        return SCREEN
    nerfstudio = sys.modules.get("nerfstudio.utils.rich_utils")
    return WIDE if nerfstudio is None else nerfstudio.CONSOLE


def say(line: str) -> None:
    """A line on the screen, as it is, said once for all processes; also in the run's log file."""
    if is_first() and _details is not None and _kept_back is None:
        put(line)
    else:
        note(line, offset=3)


def say_all(lines: Iterable[str]) -> None:
    """Says each of some lines."""
    for line in lines:
        say(line)


def note(line: str, offset: int = 2) -> None:
    """A detail: a line in the run's log file; where there is none, as `say`. The `offset` is of
    calls up to the one whose place in the code rich names."""
    if not is_first():
        return
    if _kept_back is not None:
        _kept_back.append(line)
    elif _details is None:
        console().log(f"[leco] {line}", markup=False, emoji=False, _stack_offset=offset)
    else:
        _write(line)


def summarize(summary: Iterable[str], details: Iterable[str]) -> None:
    """Notes details, of which a short screen shows a summary instead."""
    for line in details:
        note(line)
    say_all(summary if on_screen() else ())


def _write(line: str) -> None:
    """Into the run's log file, where there is one."""
    if _details is not None:
        print(time.strftime("%H:%M:%S"), line, file=_details, flush=True)


class _Says(logging.Handler):
    """Says what the package's loggers warn of, and notes what else they log."""

    def emit(self, record: logging.LogRecord) -> None:
        line = record.getMessage()
        warns = record.levelno >= logging.WARNING
        if is_first():
            (say if warns else note)(line)
        elif warns and record.name in OF_A_DEVICE:
            process = f"[leco] process {distributed.get_rank()}"
            console().log(f"{process}: {line}", markup=False, emoji=False)


def say_what_is_logged() -> None:
    """From now on lines of the package's logger, also those that are no warnings, are said."""
    log = logging.getLogger("leco_plugin")
    if not any(isinstance(handler, _Says) for handler in log.handlers):
        log.addHandler(_Says())
        log.setLevel(logging.INFO)


class Show(Protocol):
    """Shows how far some work is."""

    def __call__(self, share: float, figures: str = "") -> None:
        """The share done, and in a few words what has been reached."""


@contextmanager
def bar(what: str) -> Iterator[Show]:
    """Shows a bar while it lasts, once for all processes; yields what takes the share done.

    In a file or a pipe, where no bar can be drawn, it is a line after ten seconds, then one for
    each twentieth of the work, at most one a minute. So it is in the run's log file.
    """
    if not is_first():
        yield lambda share, figures="": None
        return
    if not (console().is_terminal or console().is_jupyter):
        yield _Lines(what, put)
        return
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TimeElapsedColumn())
    in_file = _Lines(what, _write)
    with Progress(*columns, TimeRemainingColumn(), console=console(), transient=True) as progress:
        task = progress.add_task(what, total=1.0)

        def show(share: float, figures: str = "") -> None:
            words = f"{what}: {figures}" if figures else what
            progress.update(task, completed=share, description=words)
            in_file(share, figures)

        yield show


def for_each(what: str, items: Sequence[T], make: Callable[[T], R]) -> list[R]:
    """What `make` makes of each item, under a bar."""
    made: list[R] = []
    with bar(what) as show:
        for item in items:
            made.append(make(item))
            show(len(made) / len(items))
    return made


class _Lines:
    """A bar as lines, which are few."""

    def __init__(self, what: str, put: Callable[[str], None]) -> None:
        self.what, self.put = what, put
        self.began = time.monotonic()
        self.due, self.next_share = self.began + SECONDS_TO_FIRST, 0.0
        self.share_before: float | None = None

    def __call__(self, share: float, figures: str = "") -> None:
        now = time.monotonic()
        if self.share_before is None:
            self.share_before = share
        if now < self.due or share < self.next_share:
            return
        self.due, self.next_share = now + SECONDS_A_LINE, share + SHARE_A_LINE
        done, elapsed = share - self.share_before, now - self.began
        known = done >= 0.01  # of less nobody can tell how long the rest takes
        left = f"about {spell(elapsed / done * (1.0 - share))} left" if known else ""
        reached = f"{share:.0%} after {spell(elapsed)}"
        self.put(f"{self.what}: " + ", ".join(filter(None, [reached, figures, left])))


def put(line: str) -> None:
    """A line of a command's own on the screen, as it is; also in a run's log file."""
    console().print(line, markup=False, emoji=False, highlight=False, soft_wrap=True)
    _write(line)


def spell(seconds: float) -> str:
    """A duration in words: 45 s, 12 min, 3 h 20 min."""
    if seconds < 90.0:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60.0)
    hours, rest = divmod(minutes, 60)
    return f"{hours} h {rest} min" if hours else f"{minutes} min"


def by_number(count: int, one: str, many: str) -> str:
    """Words for one thing, or words for another number of them."""
    return one if count == 1 else many


def counted(count: int, one: str, many: str | None = None) -> str:
    """A number of things in words: 1 run, 2 runs. Without `many` that is `one` with an s."""
    return f"{count} {by_number(count, one, many or f'{one}s')}"


def first_of(names: Sequence[str], most: int = 5, rest: str = "more") -> str:
    """Up to so many names of a list, and how many more there are, in words."""
    left = len(names) - most
    return ", ".join(names[:most]) + (f" and {left} {rest}" if left > 0 else "")


@contextmanager
def resumable() -> Iterator[None]:
    """A context for resumable work: Ctrl-C says that finished parts are kept."""
    try:
        yield
    except KeyboardInterrupt:
        put("stopped; what is finished is kept, and the same command goes on with the rest")
        raise
