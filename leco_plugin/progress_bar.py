"""A progress bar under nerfstudio's log, for work that nerfstudio shows none for."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from nerfstudio.utils.rich_utils import CONSOLE
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from leco_plugin.models.compute.ranks import is_first

SECONDS_A_LINE = 60.0
"""Between two lines where there is no terminal to draw a bar on."""


@contextmanager
def bar(what: str) -> Iterator[Callable[[float], None]]:
    """Shows a bar while it lasts, once for all processes; yields what takes the share done.

    In a file or a pipe, where no bar can be drawn, it is a line a minute.
    """
    if not (CONSOLE.is_terminal or CONSOLE.is_jupyter):
        yield _lines(what) if is_first() else lambda share: None
        return
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TimeElapsedColumn())
    with Progress(
        *columns, TimeRemainingColumn(), console=CONSOLE, transient=True, disable=not is_first()
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
            CONSOLE.print(said_now, markup=False, highlight=False)

    return show


@contextmanager
def resumable(say: Callable[[str], None]) -> Iterator[None]:
    """Around work of which every finished part is kept: says so when somebody stops it."""
    try:
        yield
    except KeyboardInterrupt:
        say("stopped; what is finished is kept, and the same command goes on with the rest")
        raise
