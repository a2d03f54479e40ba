"""Heals a gate that has collapsed, by the rule of `healing`, within the steps that the run has."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from leco_plugin.models.compute.ranks import say, share
from leco_plugin.models.failures import GateCollapsed
from leco_plugin.models.freezing.calibration import Measured
from leco_plugin.models.freezing.freezing import FILE_NAME, HARDLY_ANYTHING
from leco_plugin.models.gate import Gate, route
from leco_plugin.models.learning.healing import (
    MOST_RECOVERIES,
    REMEDY,
    heal,
    is_collapsed,
    is_enough,
    may_fall_back,
    starts_anew,
)
from leco_plugin.models.learning.phases import Collapse
from leco_plugin.models.losses import expert_shares

if TYPE_CHECKING:
    from leco_plugin.models.learning.lifecycle import Lifecycle


class Recoveries:
    """The part of a `Lifecycle` that begins when a gate collapses."""

    def __init__(self, lifecycle: Lifecycle) -> None:
        self.lifecycle = lifecycle

    def after_look(self, step: int, logits: Tensor, kept: Tensor, last: bool) -> bool:
        """Heals a gate that has collapsed for a while; returns whether it has.

        Args:
            logits: [P, 1 + n] of the gate at the probe positions.
            kept: [P] bool, whether o(x) there is worth a sample.
            last: whether this look ends the first phase.
        Raises:
            GateCollapsed: more often than it may.
        """
        model, progress = self.lifecycle.model, self.lifecycle.progress
        shares = expert_shares(route(logits, model.routing.empty_below), logits.shape[-1])
        share_kept = float(kept.float().mean())
        collapse = is_collapsed(progress, step, share_kept, shares, last)
        if collapse is None:
            return False
        if self._is_left(collapse, step, last):
            return False
        if progress.recoveries >= MOST_RECOVERIES:
            cause = f"step {step}: {collapse.cause}, after {MOST_RECOVERIES} recoveries"
            if collapse.kind == "occupied":  # slow, and never wrong: what can be is skipped
                progress.left_occupied, progress.suspected_since = True, -1
                say(f"{cause}; so be it")
                return False
            raise GateCollapsed(f"{cause}. {REMEDY}")
        progress.decisions = kept
        say(f"step {step}: {collapse.cause}; {self.heal(collapse, shares, step)}")
        return True

    def _is_left(self, collapse: Collapse, step: int, last: bool) -> bool:
        """Whether a gate is frozen as it is, collapsed or not: calibration makes it safe. So it is
        where the run has no steps to heal it in, and at the end of a phase where the points of one
        expert have been shared out before: what is empty that gate knows."""
        progress, room = self.lifecycle.progress, self._room(step)
        if collapse.kind == "one expert":
            return last and (room < 1 or progress.balance > 1.0)
        return not is_enough(room)

    def falls_back(self, step: int, measured: Measured) -> bool:
        """Has a gate that hardly anything can be skipped by taught otherwise, where there is
        another way, and time for it; returns whether it has."""
        progress, losses = self.lifecycle.progress, self.lifecycle.model.config.gate_loss
        if not may_fall_back(losses) or progress.paper_given_up:
            return False
        if measured.empty_fraction >= HARDLY_ANYTHING or not is_enough(self._room(step)):
            return False
        skipped = f"{measured.empty_fraction:.1%} of all candidates"
        self.reopen(
            Collapse(f"no threshold within bounds skips more than {skipped}", "useless"), step
        )
        return True

    def reopen(self, collapse: Collapse, step: int) -> None:
        """Has a frozen gate learn once more, on dense samples first; its file is withdrawn."""
        self.lifecycle.model.reopen()
        self._withdraw_file()
        done = self.heal(collapse, torch.zeros(self.lifecycle.model.gate.head.out_features), step)
        say(f"step {step}: {collapse.cause}; the gate is opened again, {done}")

    def _withdraw_file(self) -> None:
        """Nobody should be guided by the gate as it was."""
        if self.lifecycle.folder is None:
            return
        file = self.lifecycle.folder / FILE_NAME
        try:
            file.unlink(missing_ok=True)
        except OSError as error:
            say(f"{file} could not be withdrawn ({error}); its gate is of no use")

    def heal(self, collapse: Collapse, shares: Tensor, step: int) -> str:
        """Does what the rule says; returns what that is, in words. Arguments as of `heal`."""
        lifecycle = self.lifecycle
        model, progress, losses = (
            lifecycle.model,
            lifecycle.progress,
            lifecycle.model.config.gate_loss,
        )
        anew = starts_anew(collapse, losses, progress)
        if anew:
            model.gate.load_state_dict(Gate(model.gate.config).state_dict())
            share(model.gate.parameters())
            lifecycle.restart_field()
        done = heal(model.gate.head, progress, collapse, shares, step, losses, self._room(step))
        share(model.gate.head.parameters())  # the remedy is drawn at random
        return f"{done} (recovery {progress.recoveries} of {MOST_RECOVERIES})"

    def _room(self, step: int) -> float:
        """Steps of the run after this one."""
        lifecycle = self.lifecycle
        return lifecycle.end() - (step + 1) if lifecycle.trainer is not None else math.inf
