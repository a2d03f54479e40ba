"""The short screen of a run of `ns-train`: what nerfstudio 1.1.5 and libraries print besides goes
to the run's log file.

nerfstudio prints to one console for the whole process, viser to rich's own. Its table of step times
is a writer of its own, and so is its profile; neither has a PSNR. Of the run's config, which it
prints in 300 lines, it saves `config.yml`.
"""

from __future__ import annotations

import re
import sys
import warnings
from collections.abc import Iterator
from contextlib import (
    AbstractContextManager,
    ExitStack,
    closing,
    contextmanager,
    nullcontext,
    suppress,
)
from dataclasses import replace
from pathlib import Path
from typing import Any, TextIO

import rich
from nerfstudio.utils.rich_utils import CONSOLE
from rich.console import Console

from leco_plugin.evaluation.metrics import LpipsUnavailable
from leco_plugin.log import details_in
from leco_plugin.studio.commands import hide_warnings_of_no_use

LOG = "train.log"
"""File in a run's folder with all that the screen leaves out."""

ESCAPES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


def is_short(config: Any) -> bool:
    """Whether a run has a short screen: not where all is to be shown, nor where nothing is."""
    verbose = getattr(config, "verbose", False)  # another package's config has none
    return not verbose and bool(config.logging.local_writer.enable)


def short_screen(config: Any) -> AbstractContextManager[None]:
    """While it lasts, only what the package says is on the screen of a run.

    Args:
        config: of the trainer; where its screen is not to be short, nothing changes.
    """
    return _short(config.get_base_dir() / LOG) if is_short(config) else nullcontext()


@contextmanager
def _short(path: Path) -> Iterator[None]:
    path.parent.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        plain: Any = stack.enter_context(closing(_Log(path)))
        for console in (CONSOLE, rich.get_console()):
            stack.enter_context(_printing_to(console, plain))
        stack.enter_context(warnings.catch_warnings())
        hide_warnings_of_no_use()
        # of the images that nerfstudio measures now and then; ns-eval says it
        warnings.filterwarnings("ignore", category=LpipsUnavailable)
        stack.enter_context(details_in(plain))
        yield


@contextmanager
def _printing_to(console: Console, file: TextIO) -> Iterator[None]:
    before: Any = console.file
    console.file = file
    try:
        yield
    finally:
        # None is the standard output of the moment, which may be another one by then
        console.file = None if before is sys.stdout else before  # type: ignore[assignment]


class _Log:
    """A log file, without the colours of a terminal in which nerfstudio's console still writes; a
    disk that is full costs lines, and no run."""

    def __init__(self, path: Path) -> None:
        self.file = path.open("a", encoding="utf8", buffering=1)

    def write(self, text: str) -> int:
        with suppress(OSError):
            self.file.write(ESCAPES.sub("", text))
        return len(text)

    def flush(self) -> None:
        with suppress(OSError):
            self.file.flush()

    def close(self) -> None:
        with suppress(OSError):
            self.file.close()

    def isatty(self) -> bool:
        return False


def without_tables(config: Any) -> Any:
    """A trainer's config without nerfstudio's table of step times, which moves the cursor over what
    others print, and without its profile, unless torch's was asked for."""
    logging = config.logging
    profiler = "none" if logging.profiler == "basic" else logging.profiler
    writer = replace(logging.local_writer, enable=False)
    return replace(config, logging=replace(logging, local_writer=writer, profiler=profiler))
