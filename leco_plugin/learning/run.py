"""A run: the training loop around a learner, and how far it has come, which a checkpoint keeps."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from leco_plugin.scenes.input_error import require_keys

PACE = "leco_pace"
"""Attribute of an optimizer: the multiple of its learning rates that it steps with."""


CONFIG = "config.yml"
"""In the folder of each run of nerfstudio."""


def folder_of(checkpoint: Path) -> Path:
    """The folder of a run, given by a checkpoint or its folder of checkpoints: the nearest one
    above with a config, else the next one."""
    checkpoints = checkpoint if checkpoint.is_dir() else checkpoint.parent
    above = checkpoints.absolute().parents
    return next((folder for folder in above if (folder / CONFIG).is_file()), checkpoints.parent)


class Run(Protocol):
    """A training run. `LearningOnly` is one without a trainer."""

    goes_on: bool
    """Whether the field goes on after freezing; else it is left behind."""
    start: int
    """Its first step: not 0 where it was resumed."""

    @property
    def end(self) -> float:
        """The step after its last one; infinity where freezing ends it."""

    folder: Path | None
    """Where it leaves its files; None leaves none."""
    resumed_from: Path | None
    """A checkpoint, or a folder of checkpoints, that it was resumed from."""

    def optimizers(self) -> list[Optimizer]:
        """All optimizers of the mixture's parameters."""

    def save(self, step: int) -> None:
        """Saves a checkpoint, if it saves any."""
        return None

    def forget(self, groups: dict[str, list[nn.Parameter]]) -> None:
        """Has optimizers forget all parameters but these, by the names of their groups."""
        return None


class LearningOnly(Run):
    """A run that ends when the gate is frozen, and leaves no file; over in minutes, it saves no
    checkpoint."""

    goes_on, start, end = False, 0, math.inf
    folder: Path | None = None
    resumed_from: Path | None = None

    def __init__(self, optimizers: list[Optimizer] | None = None) -> None:
        self._optimizers = optimizers or []

    def optimizers(self) -> list[Optimizer]:
        return self._optimizers


def keep_pace(optimizers: Iterable[Optimizer], pace: float) -> None:
    """Has optimizers step at a multiple of their learning rates from now on; a power of two leaves
    rates as they were to the last bit. They are multiplied for the time of a step only: schedulers
    and checkpoints see what was asked for."""
    for optimizer in optimizers:
        if not hasattr(optimizer, PACE):
            if pace == 1.0:
                continue
            optimizer.register_step_pre_hook(_slow_down)
            optimizer.register_step_post_hook(_restore)
        setattr(optimizer, PACE, pace)


def _slow_down(optimizer: Optimizer, *_: Any) -> None:
    for group in optimizer.param_groups:
        group["lr"] *= getattr(optimizer, PACE)


def _restore(optimizer: Optimizer, *_: Any) -> None:
    for group in optimizer.param_groups:
        group["lr"] /= getattr(optimizer, PACE)


@dataclass
class WatchState:
    """What is known of the price of skipping; travels with a checkpoint."""

    due: int = 0
    """Step after which the price is measured next; 0 is not known yet."""
    rechecks: int = 0
    """How often it was measured."""
    evidence: dict[str, tuple[float, ...]] = field(default_factory=dict)
    """`Evidence` of each price since the threshold was last changed, by the price's name."""
    nothing_since: int = -1
    """Step since which batches hold no kept sample; -1 where they do."""
    lower: float | None = None
    """Of hosts: a lower threshold, if one is followed until the first measurement."""

    @classmethod
    def from_dict(cls, state: dict[str, Any]) -> WatchState:
        """What a checkpoint holds; KeyError where that is not of the present fields."""
        require_keys(state, (each.name for each in fields(cls)))
        return cls(**state)


@dataclass
class Progress:
    """Travels with a checkpoint, as plain values and one tensor."""

    learn_steps: int = 0
    """Step of the run at which the first phase ends: not a count. Recoveries and extensions move
    it."""
    configured: int = 0
    """`ScheduleConfig.learn_steps` when `phase` was set; 0 before the first step."""
    phase: int = 0
    """Length of the first phase in steps: `configured`, or what the run has room for; 0 before the
    first step."""
    began: int = 0
    """Step at which gate and field last began to learn; 0 unless both were started anew."""
    learn_seconds: float = 0.0
    """Time spent in the first phase."""
    extensions: int = 0
    """How often the first phase was extended, because the gate had not settled."""
    recoveries: int = 0
    """How often a collapsed gate has been healed."""
    suspected_since: int = -1
    """Step since which the gate looks collapsed; -1 where it does not."""
    fewest_kept: float = 1.0
    """Smallest share of the probe positions kept at any look, since the gate began or was reset."""
    healed_at: int = -1
    """Step of the last recovery that began on dense samples; -1 is none."""
    dense_until: int = 0
    """Step before which a healed gate is not followed."""
    pull: float = 1.0
    """Factor, after recoveries, of what pulls the gate towards empty space."""
    balance: float = 1.0
    """Factor, after recoveries, of the balance among scene experts."""
    pace: float = 1.0
    """Factor, after recoveries, of all learning rates."""
    paper_given_up: bool = False
    """Whether the gate, after recoveries, is taught in logit form although the paper's is asked."""
    learning_kept: float = 1.0
    """Share of candidates that are shaded while the gate is learned, a running mean."""
    sharpened_at: int = -1
    """Step at which a small gate was last taught; -1 is none."""
    left_alone: bool = False
    """Whether a gate that calls everything occupied, or needs one scene expert only, after all its
    recoveries is left so."""
    decisions: Tensor = field(default_factory=lambda: torch.zeros(0, dtype=torch.bool))
    """[P] bool, what the gate decided of the probe positions at the last check."""

    watch: WatchState = field(default_factory=WatchState)
    """What is known of the price of skipping since the gate was frozen."""

    @property
    def since(self) -> int:
        """Step from which `phase` counts: where learning began, or after the last recovery on dense
        samples."""
        return max(self.began, self.healed_at + 1)

    @property
    def looks_collapsed(self) -> bool:
        """Whether the gate is suspected of having stopped to decide."""
        return self.suspected_since >= 0 or self.watch.nothing_since >= 0

    def has_shaded(self, share: float) -> None:
        """Updates `learning_kept` by the share of a batch's candidates that was shaded."""
        self.learning_kept = 0.9 * self.learning_kept + 0.1 * share

    def begin(self, configured: int, most: int) -> None:
        """Sets `learn_steps`, unless a checkpoint did so under the same config: `configured` steps
        from `since` on, or `most`, as many as this process leaves for the first phase."""
        if configured != self.configured:
            self.phase = min(configured, most)
            self.learn_steps = self.since + self.phase
            self.configured = configured

    def lengthen(self, steps: int) -> None:
        """Makes the first phase one of so many steps, if it has its usual length and no extension:
        a run of fixed time knows only on the way how many steps it has."""
        if self.configured <= self.phase < steps and self.extensions == 0:
            self.learn_steps += steps - self.phase
            self.phase = steps

    @classmethod
    def from_dict(cls, state: dict[str, Any]) -> Progress:
        """What `to_dict` gave; KeyError where that is not of the present fields."""
        require_keys(state, (each.name for each in fields(cls)))
        return cls(**{**state, "watch": WatchState.from_dict(state["watch"])})

    def to_dict(self) -> dict[str, Any]:
        """What a checkpoint holds."""
        return {**vars(self), "watch": dict(vars(self.watch))}
