"""A progress bar under nerfstudio's log, for work that nerfstudio shows none for."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from nerfstudio.utils.rich_utils import CONSOLE
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from leco_plugin.models.compute.ranks import is_first


@contextmanager
def bar(what: str) -> Iterator[Callable[[float], None]]:
    """Shows a bar while it lasts, once for all processes; yields what takes the share done."""
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(
        *columns, TimeRemainingColumn(), console=CONSOLE, transient=True, disable=not is_first()
    ) as progress:
        task = progress.add_task(what, total=1.0)
        yield lambda share: progress.update(task, completed=share)


@contextmanager
def resumable(say: Callable[[str], None]) -> Iterator[None]:
    """Around work of which every finished part is kept: says so when somebody stops it."""
    try:
        yield
    except KeyboardInterrupt:
        say("stopped; what is finished is kept, and the same command goes on with the rest")
        raise
