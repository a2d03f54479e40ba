"""A run of nerfstudio: who has its folder, its sizes, where it ends, and as a learner sees it.

nerfstudio's main of July 2025 means some options otherwise than its last release. Both call
themselves 1.1.5, so that a version tells nothing: what is installed is looked at, here alone.
"""

from __future__ import annotations

import atexit
import functools
import inspect
import math
import os
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.engine.trainer import Trainer
from torch import nn
from torch.nn import Parameter
from torch.optim import Optimizer

from leco_plugin.learning.run import CONFIG, LearningOnly, Run
from leco_plugin.log import counted
from leco_plugin.models.compute.ranks import is_first
from leco_plugin.models.sizing.sizes import sizes_in, sizes_to_resume
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.whole_files import lock, unlock, write_whole, writing_into
from leco_plugin.studio.checkpoints import (
    allow_checkpoint_globals,
    damage_of,
    step_of,
    whole_of,
)

OUTPUT = "--output-dir"
"""The option that says where runs' folders are made."""
_held: dict[Path, int] = {}
"""Descriptors of this process's locks, by folder."""


def claim(folder: Path, checkpoints: Path, load_from: Path | None) -> str | None:
    """Takes a folder for the run of this process until it ends; returns why it cannot be had. It
    saves in `checkpoints`, and resumes from the folder or file `load_from`, if from any. InputError
    if nothing can be written there."""
    place = folder.resolve()
    if place not in _held:
        with writing_into(folder, OUTPUT):
            folder.mkdir(parents=True, exist_ok=True)
            held = lock(folder)
        if held is None:
            return f"another run is going on in {folder}"
        if not _held:
            atexit.register(_release_all, os.getpid())
        _held[place] = held
    theirs = [path for path in checkpoints.glob("*.ckpt") if step_of(path) >= 0]
    theirs += folder.glob("*.safetensors")  # also of a run that saved no checkpoint
    source = None if load_from is None else load_from.resolve()
    if theirs and (source is None or checkpoints.resolve() not in (source, source.parent)):
        release(folder)
        return f"{folder} holds an earlier run, with which this one does not go on"
    return None


def release(folder: Path) -> None:
    """Lets go of a folder before the process ends."""
    held = _held.pop(folder.resolve(), None)
    if held is not None:
        unlock(folder, held)


def _release_all(process: int) -> None:
    """When a process ends; one that was forked from it has nothing to let go of."""
    if os.getpid() == process:
        for folder in list(_held):
            release(folder)


def checkpoint_of(config: Any) -> Path | None:
    """The checkpoint that training goes on from: of a folder, the newest that is whole, with a line
    about each newer one. InputError if the folder holds none, or the one that is named is not there
    or damaged."""
    path: Path | None = config.load_checkpoint
    if config.load_dir is not None:
        if config.load_step is None:
            return whole_of(config.load_dir, "going on from {}")
        path = Path(config.load_dir) / f"step-{config.load_step:09d}.ckpt"
    if path is None:
        return None
    fault = damage_of(path) if path.exists() else "there is no such file"
    if fault is not None:
        remedy = "give --load-dir without --load-step for the newest that is whole"
        raise InputError(f"the checkpoint {path} cannot be gone on with ({fault}): {remedy}")
    return path


def with_sizes_of(config: Any, checkpoint: Path | None) -> Any:
    """A trainer's config with the sizes of the run that is gone on with, if its checkpoint is
    there. InputError if a size has been set by hand, and the run has another one."""
    from leco_plugin.models.leco_config import LecoModelConfig

    model = config.pipeline.model
    if checkpoint is None or not isinstance(model, LecoModelConfig) or not checkpoint.exists():
        return config
    allow_checkpoint_globals()
    stored = sizes_in(checkpoint)
    if stored is None:
        return config
    return _with_model(config, replace(model, sizes=sizes_to_resume(model.sizes, stored)))


def keep_sizes(config: Any, model: Any, asked: Any) -> Any:
    """A trainer's config with the sizes that its model has, also in the run's `config.yml`, which
    so far has those of the model's config as `asked` for."""
    if not _has_mixture(model) or asked.sizes == model.config.sizes:
        return config
    config = _with_model(config, model.config)
    path = config.get_base_dir() / CONFIG
    if is_first() and path.exists():  # what is not to be stored has none
        text = yaml.dump(config)
        with writing_into(path.parent, OUTPUT):
            write_whole(path, text.encode("utf8"))
    return config


def check_photographs(pipeline: Any) -> None:
    """InputError if a run that is gone on with has more or fewer photographs than it was begun
    with: their codes would go to others; or as `LecoDataManager.refuse_others`."""
    model: Any = getattr(pipeline, "model", None)
    manager: Any = getattr(pipeline, "datamanager", None)
    now = len(manager.train_dataset) if _has_mixture(model) else 0
    if now and model.num_train_data != now:
        raise InputError(
            f"the run was begun with {counted(model.num_train_data, 'training photograph')}, and "
            f"the scene has {now}: put the same ones there, or begin a new run"
        )
    if hasattr(manager, "refuse_others"):
        manager.refuse_others()


def _has_mixture(model: Any) -> bool:
    """Whether a model is `leco-occupancy`'s, whose sizes may be chosen from the scene."""
    from leco_plugin.models.mixture import Mixture

    return isinstance(getattr(model, "mixture", None), Mixture)


def _with_model(config: Any, model: Any) -> Any:
    return replace(config, pipeline=replace(config.pipeline, model=model))


ENDLESS = 10_000_000
"""Steps of a run that ends by its time: no run makes so many."""
COUNTED_FROM_ZERO = re.compile(
    r"max_num_iterations\s*-\s*self\._start_step"
    r"|range\(\s*self\._start_step\s*,\s*self\.config\.max_num_iterations\s*\)"
)
"""In the source of `Trainer.train` where a resumed run ends after `max_num_iterations` in all."""


@functools.cache
def counts_from_zero() -> bool:
    """Whether `--max-num-iterations` of a resumed run counts the steps before it too."""
    try:
        return COUNTED_FROM_ZERO.search(inspect.getsource(Trainer.train)) is not None
    except (OSError, TypeError):  # installed without its source: then as released
        return False


def end_of(config: Any, done: int) -> int:
    """Steps of a run when it ends, by its trainer's config and the steps `done` when it began or
    was resumed."""
    asked = int(config.max_num_iterations)
    return asked if counts_from_zero() else done + asked


def iterations_until(end: int, done: int) -> int:
    """The `--max-num-iterations` with which a run goes on after `done` steps and ends at `end`."""
    return end if counts_from_zero() else end - done


def keeps_all_images(config: Any, photographs: int) -> bool:
    """Whether a data manager loads all training photographs at once; the release says so by -1, and
    main by infinity."""
    some = config.train_num_images_to_sample_from
    return bool(some == -1 or some >= photographs)


def run_of(trainer: Any) -> Run:
    """The run of a trainer; without one, a run that leaves no file and ends at freezing."""
    return LearningOnly() if trainer is None else TrainerRun(trainer)


class TrainerRun:
    """A run of nerfstudio's trainer, which is set up, with its checkpoint loaded."""

    goes_on = True

    def __init__(self, trainer: Any) -> None:
        self.trainer = trainer
        self.start = int(trainer._start_step)
        self.folder = Path(trainer.base_dir) if is_first() else None
        config = trainer.config
        resumed = config.load_dir or config.load_checkpoint  # of both, nerfstudio's choice
        self.resumed_from = None if resumed is None else Path(resumed)

    @property
    def end(self) -> float:
        """Of the trainer's config as it is now: a run of fixed time knows it only on the way."""
        end = end_of(self.trainer.config, self.trainer._start_step)
        return float(end) if end < ENDLESS else math.inf

    def optimizers(self) -> list[Optimizer]:
        """Those of all parameter groups."""
        return list(self.trainer.optimizers.optimizers.values())

    def save(self, step: int) -> None:
        """A checkpoint, where the run saves any."""
        if self.trainer.config.steps_per_save > 0:
            self.trainer.save_checkpoint(step)

    def forget(self, groups: dict[str, list[nn.Parameter]]) -> None:
        """Has optimizers forget all parameters but these, by the names of their groups."""
        filled = {name: group for name, group in groups.items() if group}
        drop_missing_parameters(self.trainer.optimizers, filled)


def drop_missing_parameters(optimizers: Optimizers, groups: dict[str, list[Parameter]]) -> None:
    """Drops the parameters that a model no longer has from its optimizers, with their state, by the
    model's parameters of each name; optimizers of other names do not change."""
    for name, parameters in groups.items():
        optimizer, there = optimizers.optimizers[name], {id(p) for p in parameters}
        # in place: others hold on to the same groups
        for held in (*(g["params"] for g in optimizer.param_groups), optimizers.parameters[name]):
            held[:] = [parameter for parameter in held if id(parameter) in there]
        for parameter in [known for known in optimizer.state if id(known) not in there]:
            del optimizer.state[parameter]
