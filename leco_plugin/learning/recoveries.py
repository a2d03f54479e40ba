"""Heals a collapsed gate by the rule in `collapse`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from leco_plugin.learning.calibration import Measured
from leco_plugin.learning.collapse import (
    MOST_RECOVERIES,
    REMEDY,
    Collapse,
    GateCollapsed,
    action_on,
    form_of,
    heal,
    is_enough,
    is_restart_due,
    look,
    may_fall_back,
)
from leco_plugin.learning.freezing import HARDLY_ANYTHING, withdraw_file
from leco_plugin.learning.run import Progress, Run
from leco_plugin.log import say
from leco_plugin.models.compute.ranks import share
from leco_plugin.models.gate import route
from leco_plugin.models.losses import expert_shares
from leco_plugin.models.mixture import Mixture
from leco_plugin.models.rendering import Routing

if TYPE_CHECKING:
    from leco_plugin.models.leco_config import LecoModelConfig

KEEPS_NOTHING = "the frozen gate keeps nothing of what the cameras see"


class Recoveries:
    """Heals the gate of a mixture that a method of a config learns."""

    def __init__(
        self, mixture: Mixture, run: Run, progress: Progress, config: LecoModelConfig
    ) -> None:
        self.mixture, self.run, self.progress = mixture, run, progress
        self.losses, self.homogeneous = config.gate_loss, config.homogeneous

    def routing(self) -> Routing:
        """Which expert each point is sent to, after the recoveries so far."""
        logit = form_of(self.losses, self.progress) == "logit"
        return Routing(self.losses.empty_below if logit else None, self.homogeneous)

    def heal_if_collapsed(self, step: int, logits: Tensor, kept: Tensor, last: bool) -> bool:
        """Heals a gate that has stayed collapsed; returns whether it did so. GateCollapsed if it
        was healed as often as it may be.

        Args:
            logits: [P, 1 + n] of the gate at the probe positions.
            kept: [P] bool, whether o(x) there is worth a sample.
            last: whether this look ends the first phase.
        """
        progress = self.progress
        routes = route(logits, self.mixture.routing.empty_below)
        shares = expert_shares(routes, logits.shape[-1])
        collapse = look(progress, step, float(kept.float().mean()), shares, last)
        if collapse is None:
            return False
        action = action_on(collapse, progress, last, self._room(step))
        cause = f"step {step}: {collapse.cause}"
        if action == "heal":
            progress.decisions = kept
            say(f"{cause}; {self._heal(collapse, shares, step)}")
        elif action == "give up":
            raise GateCollapsed(f"{cause}, after {MOST_RECOVERIES} recoveries. {REMEDY}")
        elif action == "leave for good":
            progress.left_alone, progress.suspected_since = True, -1
            say(f"{cause}, after {MOST_RECOVERIES} recoveries; it is left as it is")
        return action == "heal"

    def fall_back(self, step: int, measured: Measured) -> bool:
        """Restarts a gate by which hardly anything can be skipped in logit form, unless it was
        taught so already, or too few steps are left; returns whether it did so."""
        if not may_fall_back(self.losses) or self.progress.paper_given_up:
            return False
        if measured.empty_fraction >= HARDLY_ANYTHING or not is_enough(self._room(step)):
            return False
        skipped = f"{measured.empty_fraction:.1%} of all candidates"
        cause = f"no threshold within bounds skips more than {skipped}"
        self._reopen(Collapse(cause, "useless"), step)
        return True

    def reopen_useless(self, step: int) -> bool:
        """Opens a frozen gate that keeps nothing, if there are steps left to learn in; returns
        whether it did so. GateCollapsed if it was healed as often as it may be."""
        enough = is_enough(self._room(step))
        if enough and self.progress.recoveries >= MOST_RECOVERIES:
            after = f"after {MOST_RECOVERIES} recoveries"
            raise GateCollapsed(f"step {step}: {KEEPS_NOTHING}, {after}. {REMEDY}")
        self.progress.watch.nothing_since = -1  # of the gate as it was
        if enough:
            self._reopen(Collapse(KEEPS_NOTHING), step)
        return enough

    def restart_field(self) -> None:
        """Gives the field the weights of a new one, and optimizers nothing to remember."""
        self.mixture.restart_field()
        share(self.mixture.field.parameters())
        for optimizer in self.run.optimizers():
            optimizer.state.clear()

    def _reopen(self, collapse: Collapse, step: int) -> None:
        """Has a frozen gate learn once more, on dense samples first; its file is withdrawn."""
        self.mixture.reopen()
        withdraw_file(self.run.folder)
        done = self._heal(collapse, torch.zeros(self.mixture.gate.head.out_features), step)
        say(f"step {step}: {collapse.cause}; the gate is opened again, {done}")

    def _heal(self, collapse: Collapse, shares: Tensor, step: int) -> str:
        """Does what the rule says; returns what that is, in words."""
        mixture, progress = self.mixture, self.progress
        if is_restart_due(collapse, self.losses, progress):
            mixture.restart_gate()
            share(mixture.gate.parameters())
            self.restart_field()
        head = mixture.gate.head
        done = heal(head, progress, collapse, shares, step, self.losses, self._room(step))
        share(head.parameters())  # the remedy is drawn at random
        mixture.routing = self.routing()
        return f"{done} (recovery {progress.recoveries} of {MOST_RECOVERIES})"

    def _room(self, step: int) -> float:
        """Steps of the run after this one."""
        return self.run.end - (step + 1)
