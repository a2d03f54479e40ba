"""Stands beside guided training: skips less where skipping costs too much, and re-opens a gate that
keeps nothing of what the cameras see."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from leco_plugin.models.compute.ranks import from_first, mean
from leco_plugin.models.failures import GateCollapsed
from leco_plugin.models.freezing.freezing import write_occupancy
from leco_plugin.models.freezing.recheck import (
    beyond_bounds,
    measure_again,
    skip_less,
    steps_until_next,
)
from leco_plugin.models.learning.healing import MOST_RECOVERIES, REMEDY, SUSPECTED_STEPS
from leco_plugin.models.learning.phases import Collapse

if TYPE_CHECKING:
    from leco_plugin.models.learning.lifecycle import Lifecycle

FEWEST_KEPT = 0.5
"""Samples a ray from which, by its calibration, an occupancy keeps something in every batch: fewer
are right where there is nothing."""


class GuidedWatch:
    """The part of a `Lifecycle` that begins when the gate is frozen."""

    def __init__(self, lifecycle: Lifecycle) -> None:
        self.lifecycle = lifecycle
        self.steps, self.seconds = 0, 0.0
        self.recheck_seconds = 0.0

    def after_step(self, step: int, seconds: float) -> None:
        """Looks at the batch of a step, and measures again when that is due.

        Args:
            seconds: that the step took.
        Raises:
            GateCollapsed: the gate has been re-opened as often as it may.
        """
        self.steps, self.seconds = self.steps + 1, self.seconds + seconds
        lifecycle = self.lifecycle
        progress, config = lifecycle.progress, lifecycle.model.config.calibration
        if self._collapsed(step):
            self._reopen(step)
            return
        if config.recheck_rays == 0:
            return
        if progress.recheck_due == 0:
            progress.recheck_due = step + config.steps_per_recheck
        if step >= progress.recheck_due:
            self._recheck(step)

    def _recheck(self, step: int) -> None:
        lifecycle = self.lifecycle
        model, progress = lifecycle.model, lifecycle.progress
        config, data = model.config.calibration, lifecycle.pipeline.datamanager
        if float(model.threshold) == 0.0:  # nothing is skipped, and nothing is lost
            progress.recheck_due = step + config.steps_per_recheck
            return
        started = time.monotonic()
        measure_again(model, data)
        seconds, a_step = time.monotonic() - started, self.seconds / self.steps
        self.recheck_seconds += seconds
        wait = from_first(lambda: steps_until_next(config, seconds, a_step), model.device)
        progress.recheck_due = step + wait
        why = beyond_bounds(progress)
        if why is not None:
            started = time.monotonic()
            skip_less(model, data, step, why)
            self.recheck_seconds += time.monotonic() - started
            if lifecycle.folder is not None:
                write_occupancy(model, lifecycle.folder)
            lifecycle.save(step)

    def _collapsed(self, step: int) -> bool:
        """Whether batches have held no kept sample at all for `SUSPECTED_STEPS` steps."""
        model, progress = self.lifecycle.model, self.lifecycle.progress
        wanted = (1.0 - model.report["empty_fraction"]) * model.config.sizes.candidates
        kept = mean(model.guided_kept, model.device)
        if kept > 0.0 or wanted < FEWEST_KEPT:
            progress.suspected_since = -1
            return False
        if progress.suspected_since < 0:
            progress.suspected_since = step
        return step - progress.suspected_since >= SUSPECTED_STEPS

    def _reopen(self, step: int) -> None:
        """The gate learns once more, on dense samples first.

        Raises:
            GateCollapsed: it has done so as often as it may.
        """
        lifecycle = self.lifecycle
        progress = lifecycle.progress
        cause = "the frozen gate keeps nothing of what the cameras see"
        if progress.recoveries >= MOST_RECOVERIES:
            raise GateCollapsed(
                f"step {step}: {cause}, after {MOST_RECOVERIES} recoveries. {REMEDY}"
            )
        lifecycle.recoveries.reopen(Collapse(cause), step)
