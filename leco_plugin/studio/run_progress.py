"""The short screen of a run of `ns-train`: what it says, and what goes to the run's log file.

nerfstudio prints to one console for the whole process, viser to rich's own. Its table of step times
is a writer of its own, and so is its profile; neither has a PSNR. Of the run's config, which it
prints in 300 lines, it saves `config.yml`."""

from __future__ import annotations

import re
import shlex
import shutil
import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, TextIO

import rich
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.utils.rich_utils import CONSOLE
from rich.console import Console
from torch import Tensor, nn

from leco_plugin.evaluation.held_out_psnr import OF, HeldOutPsnr
from leco_plugin.evaluation.inspection import describe, doubts
from leco_plugin.evaluation.metrics import FigureUnavailable
from leco_plugin.learning.freezing import FILE_NAME, leave_file
from leco_plugin.learning.quality import AT_END, FIELD, ONE_COLOUR, doubts_of_field
from leco_plugin.log import Show, bar, counted, details_in, on_screen, say, say_all, spell
from leco_plugin.models.compute.ranks import is_first
from leco_plugin.occupancy import Occupancy
from leco_plugin.on_cpu import on_cpu
from leco_plugin.studio.commands import hide_warnings_of_no_use
from leco_plugin.studio.run_folder import CONFIG

LOG = "train.log"
"""File in a run's folder with all that the screen leaves out."""

ESCAPES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


def is_short(config: Any) -> bool:
    """Whether a run has a short screen: not where all is to be shown, nor where nothing is."""
    verbose = getattr(config, "verbose", False)  # another package's config has none
    return not verbose and bool(config.logging.local_writer.enable)


@contextmanager
def short_screen(config: Any) -> Iterator[None]:
    """While it lasts, only what the package says is on the screen of a run that has a short one."""
    if not is_short(config):
        yield
        return
    path = config.get_base_dir() / LOG
    path.parent.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        plain: Any = stack.enter_context(closing(_Log(path)))
        for console in (CONSOLE, rich.get_console()):
            stack.enter_context(_printing_to(console, plain))
        stack.enter_context(warnings.catch_warnings())
        hide_warnings_of_no_use()
        # of the images that nerfstudio measures now and then; ns-eval says it
        warnings.filterwarnings("ignore", category=FigureUnavailable)
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


def without_tables(config: Any) -> Any:
    """A trainer's config without nerfstudio's table of step times, which moves the cursor over what
    others print, and without its profile, unless torch's was asked for."""
    logging = config.logging
    profiler = "none" if logging.profiler == "basic" else logging.profiler
    writer = replace(logging.local_writer, enable=False)
    return replace(config, logging=replace(logging, local_writer=writer, profiler=profiler))


class RunProgress:
    """Stands around the steps of a run until its `end`: a bar with PSNR, and then where everything
    lies."""

    def __init__(self, trainer: Any, end: int) -> None:
        self.trainer, self.end = trainer, end
        self.psnr = HeldOutPsnr(trainer.pipeline.model, trainer.pipeline.datamanager)
        self.of_batch: Any = None
        self.began, self.steps = time.monotonic(), 0
        self._bar = ExitStack()
        self._show: Show | None = None
        where = TrainingCallbackLocation
        trainer.callbacks.append(TrainingCallback([where.AFTER_TRAIN_ITERATION], self.after_step))
        trainer.callbacks.append(TrainingCallback([where.AFTER_TRAIN], self.finish))
        if start := getattr(trainer, "_start_step", 0):
            say(f"goes on at step {start}")
        say(f"run: {trainer.base_dir}" + (f", details in {LOG}" if on_screen() else ""))
        say_all(getattr(trainer.viewer_state, "viewer_info", None) or ())

    def __enter__(self) -> RunProgress:
        self.began = time.monotonic()
        return self

    def __exit__(self, *_: Any) -> None:
        self._bar.close()

    def after_step(self, step: int) -> None:
        """Measures where that is due, and shows how far the run is. The bar begins after the first
        step: before it, what learns first has one of its own."""
        self.steps += 1
        if self._show is None:
            self.psnr.begin()
            self._show = self._bar.enter_context(bar("Training"))
        self.psnr.look()
        figures = [f"step {step + 1} of {self.end}", self._words(), _phase(self.trainer)]
        self._show((step + 1) / self.end, ", ".join(filter(None, figures)))

    def note_batch(self, metrics: dict[str, Any]) -> None:
        """Keeps the PSNR of a training batch, if the model computes one."""
        found = metrics.get("psnr")
        self.of_batch = found.detach() if isinstance(found, Tensor) else found

    def _words(self) -> str:
        """PSNR on held-out pixels, or on those of a batch where a data manager holds out none."""
        if self.psnr.has_pixels or self.of_batch is None:
            return self.psnr.words()
        return f"{float(self.of_batch):.1f} dB on training pixels"

    def finish(self, step: int) -> None:
        """Measures once more, and says what was reached, where it lies, and what to do next."""
        self._bar.close()
        seconds, pixels = time.monotonic() - self.began, self.psnr.look_last()
        reached = self._words().replace(OF, f"on {pixels:,} held-out pixels")
        line = f"finished: {counted(self.steps, 'step')} in {spell(seconds)}"
        tested = self.psnr.look_at_tests()
        of_tests = "" if tested is None else f"{tested:.1f} dB on test photographs"
        say(", ".join(filter(None, [line, reached, of_tests])))
        folder = Path(self.trainer.base_dir)
        occupancy = folder / FILE_NAME
        last = self.psnr.latest if tested is None else tested
        if occupancy.exists():
            say_all(doubts(describe(at_end(occupancy, last, self.psnr.of_one_colour))))
        elif last is not None:
            say_all(doubts_of_field(last, self.psnr.of_one_colour))
        say(f"  run        {folder}")
        if occupancy.exists():
            say(f"  occupancy  {occupancy}, {occupancy.stat().st_size / 1e3:.0f} kB")
        say("next:")
        tests = len(self.trainer.pipeline.datamanager.eval_dataset or ())
        for command in next_commands(folder, occupancy.exists(), tests):
            say(f"  {command}")


def at_end(path: Path, field: float | None, one_colour: float) -> Occupancy:
    """The occupancy that a run leaves, with what it has reached in its report, as far as that was
    measured: its file is written anew, so that inspection repeats what is bad. All processes may
    come here; the first writes."""
    occupancy = Occupancy.load(path)
    if field is not None:
        occupancy.report = {**occupancy.report, AT_END: {FIELD: field, ONE_COLOUR: one_colour}}
        if is_first():
            leave_file(occupancy, path.parent)
    return occupancy


def next_commands(folder: Path, occupancy: bool, tests: int) -> list[str]:
    """What to run after a run: to look at it, to film it, to measure it if there are `tests`,
    photographs to test with, and to draw its occupancy and take it elsewhere if it has left one."""

    def at(name: str) -> str:
        return shlex.quote(str(folder / name))

    config = f"--load-config {at(CONFIG)}"
    film = at("film.mp4") if shutil.which("ffmpeg") else f"{at('film')} --output-format images"
    between = "" if tests > 1 else " --pose-source train"
    commands = [
        f"ns-viewer {config}",
        f"ns-render interpolate {config} --output-path {film} --downscale-factor 4{between}",
    ]
    if tests:
        commands.append(f"ns-eval {config} --output-path {at('eval.json')}")
    if occupancy:
        commands.append(f"leco inspect {at(FILE_NAME)} --picture {at('occupancy.png')}")
        commands.append(f"leco export {at(FILE_NAME)} --out {at('export')}")
    return commands


def _phase(trainer: Any) -> str:
    """What a model is doing; nothing of one that has no occupancy."""
    model: nn.Module = trainer.pipeline.model
    frozen = getattr(getattr(model, "mixture", None), "frozen", None)
    if frozen is None:
        return "guided" if hasattr(model, "leco_guide") else ""
    return "guided" if bool(on_cpu(frozen)) else "learning the occupancy"
