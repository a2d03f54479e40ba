"""Learning rates that stay full until a run is nearly over, and then fall to zero."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

from nerfstudio.engine.schedulers import Scheduler, SchedulerConfig
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR

from leco_plugin.learning.schedule import rate_at


@dataclass
class CooldownSchedulerConfig(SchedulerConfig):
    """Full rates, which fall to zero over the last quarter of the run"""

    _target: type = field(default_factory=lambda: CooldownScheduler)
    """target class to instantiate"""
    max_steps: int = 0
    """Step at which rates are zero; 0 is the end of the run, however long it is made."""


class CooldownScheduler(Scheduler):
    """Rates by `rate_at`; full ones for good while `max_steps` is 0."""

    config: CooldownSchedulerConfig

    def get_scheduler(self, optimizer: Optimizer, lr_init: float) -> LambdaLR:
        """One scheduler for all groups of an optimizer, whose rates begin at `lr_init`."""
        end = self.config.max_steps
        return LambdaLR(optimizer, lambda step: rate_at(step / end) if end else 1.0)


def ending_at(optimizers: dict[str, Any], end: int) -> dict[str, Any]:
    """nerfstudio's settings of optimizers, in which rates fall to zero by the end of the run where
    they name no step; those given are not changed."""
    made = {}
    for group, settings in optimizers.items():
        scheduler = settings["scheduler"]
        if isinstance(scheduler, CooldownSchedulerConfig) and not scheduler.max_steps:
            settings = {**settings, "scheduler": replace(scheduler, max_steps=end)}
        made[group] = settings
    return made
