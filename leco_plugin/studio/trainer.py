"""nerfstudio's trainer, of which nothing that was saved is lost, however it ends."""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import sys
import threading
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.engine.trainer import Trainer
from nerfstudio.utils.decorators import check_main_thread

from leco_plugin.learning.collapse import GateCollapsed
from leco_plugin.learning.run import Progress
from leco_plugin.log import counted, say, say_what_is_logged
from leco_plugin.models.compute.ranks import is_first
from leco_plugin.names import options_in
from leco_plugin.samplers.kernels import VARIABLE, kernels_off
from leco_plugin.scenes.input_error import InputError, TrainingStopped, first_line, one_line
from leco_plugin.studio.checkpoints import first_not_finite, previous_of, step_of
from leco_plugin.studio.cooldown import ending_at
from leco_plugin.studio.run_folder import (
    check_photographs,
    checkpoint_of,
    drop_missing_parameters,
    end_of,
    iterations_until,
    keep_sizes,
    with_sizes_of,
)
from leco_plugin.studio.run_progress import RunProgress, short_screen, without_tables
from leco_plugin.studio.viewer import stay_open

HEARD = "\nstopping after this step; Ctrl-C once more stops at once\n"


@contextmanager
def catch_first_interrupt() -> Iterator[threading.Event]:
    """An event that the first Ctrl-C sets; the second raises `KeyboardInterrupt` as usual. Changes
    nothing outside of the main thread, or where another handler is already installed."""
    asked = threading.Event()
    before: Any = signal.getsignal(signal.SIGINT)
    in_main = threading.current_thread() is threading.main_thread()
    if not in_main or before is not signal.default_int_handler:
        yield asked
        return

    def hear(number: int, frame: Any) -> None:
        if asked.is_set():
            before(number, frame)
        asked.set()
        os.write(2, HEARD.encode())  # nothing that might hold a lock just now

    signal.signal(signal.SIGINT, hear)
    try:
        yield asked
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def _trackers_in_one_line(vis: str) -> Iterator[None]:
    """InputError for what wandb or comet raise where a run would begin to be logged there."""
    try:
        yield
    except Exception as error:
        calls = traceback.extract_tb(error.__traceback__)
        is_tracked = "wandb" in vis or "comet" in vis
        if not is_tracked or all(call.name != "setup_event_writer" for call in calls):
            raise
        fault = f"--vis {vis} cannot begin ({one_line(error, 120)})"
        raise InputError(f"{fault}: log in there, or give --vis tensorboard") from error


@contextmanager
def _misfits_in_one_line() -> Iterator[None]:
    """InputError for a checkpoint that is not of this model with these optimizers."""
    try:
        yield
    except (InputError, torch.OutOfMemoryError):
        raise
    except (KeyError, RuntimeError, ValueError) as error:
        fault = (
            f"the checkpoint does not fit this method with these options ({one_line(error, 120)})"
        )
        remedy = "go on with the method and options of its run, or begin a new run without it"
        raise InputError(f"{fault}: {remedy}") from error


class PrunedOptimizers(Optimizers):
    """Optimizers without the parameters that a loaded model has dropped."""

    def __init__(self, config: dict[str, Any], pipeline: Any) -> None:
        super().__init__(config, pipeline.get_param_groups())
        self.pipeline = pipeline

    def load_optimizers(self, loaded_state: dict[str, Any]) -> None:
        """As nerfstudio's, for the parameters that the model has now. InputError if it came back
        with other photographs than the scene has."""
        check_photographs(self.pipeline)
        drop_missing_parameters(self, self.pipeline.get_param_groups())
        super().load_optimizers(loaded_state)


SECONDS_BETWEEN_SAVES = 60.0
"""A run that saves at all is saved this often, however few its steps are..."""
SAVES_COST = 100.0
"""...unless a save takes longer than a hundredth of that."""


class AtomicTrainer(Trainer):
    """Set as `_target` of a `TrainerConfig`.

    nerfstudio writes a checkpoint in place and deletes the one before, and resuming takes the file
    with the highest step: one that was cut off half-way ends every attempt to go on.
    """

    done_before = 0
    """Steps of the run that is gone on with, by the name of its checkpoint."""
    saved_at = 0.0
    """When the last checkpoint was saved, or training began."""
    save_seconds = 0.0
    """What it took."""
    asked_to_stop: threading.Event | None = None
    """Set by Ctrl-C while it trains alone."""
    progress: RunProgress | None = None
    """What the screen says of the run; None where it says nothing."""

    def __init__(self, config: Any, *arguments: Any, **options: Any) -> None:
        with short_screen(config):
            super().__init__(config, *arguments, **options)

    def setup(self, *arguments: Any, **options: Any) -> None:
        """As nerfstudio's, in the sizes of the run that is gone on with; then checkpoints are also
        saved by the clock.

        InputError if there is no whole checkpoint to go on from, or no step left; if sizes are not
        those set by hand, the scene has other photographs now, or no kernel has a name that is to
        be off.
        """
        with short_screen(self.config):
            self._setup(*arguments, **options)

    def _setup(self, *arguments: Any, **options: Any) -> None:
        say_what_is_logged()
        _say_which_kernels_are_off()
        asked = self.config.pipeline.model
        checkpoint = checkpoint_of(self.config)
        self.done_before = 0 if checkpoint is None else step_of(checkpoint) + 1
        config = with_sizes_of(self.config, checkpoint)
        self.config = replace(config, load_dir=None, load_checkpoint=checkpoint)
        if config.logging.local_writer.enable:
            self.config = without_tables(self.config)
        try:
            with _trackers_in_one_line(config.vis):
                super().setup(*arguments, **options)
        finally:
            self.config = config
        end = end_of(config, self._start_step)
        if self._start_step >= end:
            raise InputError(
                f"the checkpoint has {counted(self._start_step, 'step')} already: this nerfstudio "
                f"counts these in --max-num-iterations {self.config.max_num_iterations}, so give "
                "more"
            )
        self.config = keep_sizes(self.config, self.pipeline.model, asked)
        self.saved_at = time.monotonic()
        where = [TrainingCallbackLocation.AFTER_TRAIN_ITERATION]
        self.callbacks.append(TrainingCallback(where, self.save_by_the_clock))
        self.callbacks.append(TrainingCallback(where, self.stop_if_asked))
        if self.config.logging.local_writer.enable and is_first():
            self.progress = RunProgress(self, end)

    def setup_optimizers(self) -> Optimizers:
        """nerfstudio's, which resume with the parameters that a checkpoint has left the model;
        rates know where the run ends."""
        optimizers = ending_at(self.config.optimizers, end_of(self.config, self.done_before))
        return PrunedOptimizers(optimizers, self.pipeline)

    def train_iteration(self, step: int) -> Any:
        """As nerfstudio's; the PSNR of its batch is kept for the screen."""
        outputs = super().train_iteration(step)
        if self.progress is not None:
            self.progress.note_batch(outputs[2])
        return outputs

    def save_by_the_clock(self, step: int) -> None:
        """Saves if the last time is long ago; nothing where a run is to save nothing, or keeps all
        that it saves: then their number is the user's choice."""
        config = self.config
        if config.steps_per_save <= 0 or not config.save_only_latest_checkpoint:
            return
        wait = max(SECONDS_BETWEEN_SAVES, SAVES_COST * self.save_seconds)
        if time.monotonic() - self.saved_at > wait:
            self.save_checkpoint(step)

    def stop_if_asked(self, step: int) -> None:
        """After Ctrl-C, saves and ends the run by a TrainingStopped that says how to go on."""
        if self.asked_to_stop is None or not self.asked_to_stop.is_set():
            return
        if self.config.steps_per_save > 0:
            self.save_checkpoint(step)
        parts = [f"step {step}: stopped by Ctrl-C", self._what_is_left()]
        if saved := self._saved():  # a step in doubt is not saved: it goes on from the one before
            done, end = step_of(saved[-1]) + 1, end_of(self.config, self._start_step)
            steps = f"--max-num-iterations {iterations_until(end, done)}"
            folder = shlex.quote(str(self.checkpoint_dir))
            resume = f"the same command with --load-dir {folder} {steps} goes on"
            typed = {"--load-dir", "--max-num-iterations"}.intersection(options_in(sys.argv))
            resume += f", in place of its own {' and '.join(sorted(typed))}" if typed else ""
            parts += [resume] if done < end else []
        raise TrainingStopped("; ".join(parts))

    def train(self) -> None:
        """Trains to the last step, and then stays while somebody looks into the viewer.

        TrainingStopped if a loss is not finite, and the step was not taken; if the gate has
        collapsed more often than it may; or if somebody has pressed Ctrl-C.
        """
        with short_screen(self.config), self.progress or nullcontext():
            if self.world_size > 1:  # its processes would not stop after the same step
                self._train()
                return
            with catch_first_interrupt() as self.asked_to_stop:
                self._train()
            stay_open(self.viewer_state)

    def _train(self) -> None:
        try:
            super().train()
        except FloatingPointError as error:
            line = f"step {self.step}: {error} The step was not taken; {self._what_is_left()}"
            raise TrainingStopped(line) from None
        except GateCollapsed as error:
            raise TrainingStopped(f"{error} Kept: {self._what_is_left()}") from None

    def _saved(self) -> list[Path]:
        """The checkpoints in the run's folder, the newest last."""
        return sorted(self.checkpoint_dir.glob("*.ckpt"))

    def _what_is_left(self) -> str:
        """For the last line of a run that ends before its time."""
        if saved := self._saved():
            return f"the last good checkpoint is {saved[-1]}"
        return "no checkpoint was saved yet"

    @_misfits_in_one_line()
    def _load_checkpoint(self) -> None:
        """As nerfstudio's. InputError for a checkpoint of another method or of other options."""
        super()._load_checkpoint()

    @check_main_thread
    def save_checkpoint(self, step: int) -> None:
        """Writes the checkpoint of `step` beside the folder of checkpoints, then moves it in.

        The one before stays in a folder of its own. A disk that is full costs this checkpoint, and
        a state that is not finite is not saved; training goes on, but TrainingStopped ends a run
        that is over.
        """
        bad = first_not_finite(self.pipeline)
        reason = f"{bad} is not finite" if bad is not None else self._doubts()
        started = time.monotonic()
        if reason is None:
            try:
                self._save_whole(step)
            except (OSError, RuntimeError) as error:  # as which torch reports a disk that is full
                reason = first_line(error)
        self.saved_at = time.monotonic()
        self.save_seconds = self.saved_at - started
        if reason is None:
            return
        line = f"step {step}: no checkpoint could be saved ({reason}); {self._what_is_left()}"
        if self.training_state == "completed":
            raise TrainingStopped(line)
        say(line)

    def _doubts(self) -> str | None:
        """Why the model should not replace the last good checkpoint; None where it may."""
        if self.training_state == "completed":
            return None  # the one before stays beside it
        progress = getattr(getattr(self.pipeline, "model", None), "progress", None)
        doubted = isinstance(progress, Progress) and progress.looks_collapsed
        return "the gate looks collapsed" if doubted else None

    def _save_whole(self, step: int) -> None:
        """Beside, because nerfstudio reads a step out of every file name in its folder. OSError or
        RuntimeError if it cannot be written; what was there before is there."""
        checkpoints = self.checkpoint_dir
        beside = checkpoints.with_name(f"{checkpoints.name}.unfinished")
        self.checkpoint_dir = beside
        try:
            super().save_checkpoint(step)
            unfinished = beside / f"step-{step:09d}.ckpt"
            with unfinished.open("rb") as file:
                os.fsync(file.fileno())
            checkpoints.mkdir(parents=True, exist_ok=True)
            finished = unfinished.replace(checkpoints / unfinished.name)
        finally:
            self.checkpoint_dir = checkpoints
            shutil.rmtree(beside, ignore_errors=True)  # also what a killed process has left there
        if self.config.save_only_latest_checkpoint:
            self._put_aside([path for path in self._saved() if path != finished])

    def _put_aside(self, older: list[Path]) -> None:
        """Keeps the newest of these as the one before the newest of the run, and no other."""
        if not older:
            return
        aside = previous_of(self.checkpoint_dir)
        aside.mkdir(exist_ok=True)
        *others, newest = older
        kept = newest.replace(aside / newest.name)
        for path in [*others, *aside.glob("*.ckpt")]:
            if path != kept:
                path.unlink()


def _say_which_kernels_are_off() -> None:
    try:
        off = ", ".join(sorted(kernels_off()))
    except ValueError as error:
        raise InputError(str(error)) from None
    if off:
        say(f"{VARIABLE}: torch answers in place of {off}")
