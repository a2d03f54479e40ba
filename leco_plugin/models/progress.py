"""How far a run has come in learning its occupancy: what a resumed run goes on with."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor


@dataclass
class Progress:
    """Travels with a checkpoint, as plain values and one tensor."""

    learn_steps: int = 0
    """Steps after which the gate is frozen: those of the config, shortened for a short run and
    lengthened by recoveries."""
    configured: int = 0
    """`ScheduleConfig.learn_steps` that they were made from; 0 before the first step."""
    learn_seconds: float = 0.0
    """Time spent in the first phase."""
    recoveries: int = 0
    """How often a collapsed gate has been healed."""
    suspected: bool = False
    """Whether the gate looked collapsed at the last check."""
    decisions: Tensor = field(default_factory=lambda: torch.zeros(0, dtype=torch.bool))
    """[P] bool, what the gate decided of the probe positions at the last check."""

    def begin(self, configured: int, most: int) -> None:
        """Sets `learn_steps`, unless a checkpoint did so under the same config.

        Args:
            configured: of the config; a resumed run may have been given another one.
            most: steps that this process leaves for the first phase.
        """
        if configured != self.configured:
            self.learn_steps, self.configured = min(configured, most), configured

    def to_dict(self) -> dict[str, Any]:
        """What a checkpoint holds."""
        return dict(vars(self))
