"""A training run of nerfstudio: where it ends by the release that is installed, and as a learner
sees it.

nerfstudio's main of July 2025 means some options otherwise than its last release. Both call
themselves 1.1.5, so that a version tells nothing: what is installed is looked at, here alone.
"""

from __future__ import annotations

import functools
import inspect
import re
from pathlib import Path
from typing import Any

from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.engine.trainer import Trainer
from torch import nn
from torch.nn import Parameter
from torch.optim import Optimizer

from leco_plugin.learning.run import LearningOnly, Run
from leco_plugin.models.compute.ranks import is_first

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


def end_of(trainer: Any) -> int:
    """Steps of a run when it ends, those before it was resumed included."""
    asked = int(trainer.config.max_num_iterations)
    return asked if counts_from_zero() else int(trainer._start_step) + asked


def iterations_until(end: int, done: int) -> int:
    """The `--max-num-iterations` with which a run goes on after `done` steps and ends at `end`."""
    return end if counts_from_zero() else end - done


def keeps_all_images(config: Any, photographs: int) -> bool:
    """Whether a data manager loads all training photographs at once.

    Args:
        config: of the data manager; the release says so by -1, and main by infinity.
        photographs: how many there are.
    """
    some = config.train_num_images_to_sample_from
    return bool(some == -1 or some >= photographs)


def run_of(trainer: Any) -> Run:
    """The run of a trainer; without one, a run that leaves no file and ends at freezing."""
    return LearningOnly() if trainer is None else TrainerRun(trainer)


class TrainerRun:
    """A run of nerfstudio's trainer.

    Args:
        trainer: set up, with its checkpoint loaded.
    """

    goes_on = True

    def __init__(self, trainer: Any) -> None:
        self.trainer = trainer
        self.start, self.end = int(trainer._start_step), float(end_of(trainer))
        self.folder = Path(trainer.base_dir) if is_first() else None
        config = trainer.config
        resumed = config.load_checkpoint or config.load_dir
        self.resumed_from = None if resumed is None else Path(resumed)

    def optimizers(self) -> list[Optimizer]:
        """Those of all parameter groups."""
        return list(self.trainer.optimizers.optimizers.values())

    def left(self, step: int) -> float:
        """Those up to the last one."""
        return self.end - step - 1

    def save(self, step: int) -> None:
        """A checkpoint, where the run saves any."""
        if self.trainer.config.steps_per_save > 0:
            self.trainer.save_checkpoint(step)

    def forget(self, groups: dict[str, list[nn.Parameter]]) -> None:
        """Has optimizers forget all parameters but these, by the names of their groups."""
        filled = {name: group for name, group in groups.items() if group}
        drop_missing_parameters(self.trainer.optimizers, filled)


def drop_missing_parameters(optimizers: Optimizers, groups: dict[str, list[Parameter]]) -> None:
    """Drops the parameters that a model no longer has from its optimizers, with their state.

    Args:
        groups: the model's parameters by optimizer name; optimizers of other names do not change.
    """
    for name, parameters in groups.items():
        optimizer, there = optimizers.optimizers[name], {id(p) for p in parameters}
        # in place: others hold on to the same groups
        for held in (*(g["params"] for g in optimizer.param_groups), optimizers.parameters[name]):
            held[:] = [parameter for parameter in held if id(parameter) in there]
        for parameter in [known for known in optimizer.state if id(known) not in there]:
            del optimizer.state[parameter]
