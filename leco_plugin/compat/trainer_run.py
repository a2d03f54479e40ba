"""nerfstudio's trainer as a learner's `Run`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torch import nn
from torch.optim import Optimizer

from leco_plugin.compat.nerfstudio_changes import end_of
from leco_plugin.compat.optimizers import forget_the_gone
from leco_plugin.models.compute.ranks import is_first


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

    def save(self, step: int) -> None:
        """A checkpoint, where the run saves any."""
        if self.trainer.config.steps_per_save > 0:
            self.trainer.save_checkpoint(step)

    def forget(self, groups: dict[str, list[nn.Parameter]]) -> None:
        """Has optimizers forget all parameters but these, by the names of their groups."""
        filled = {name: group for name, group in groups.items() if group}
        forget_the_gone(self.trainer.optimizers, filled)
