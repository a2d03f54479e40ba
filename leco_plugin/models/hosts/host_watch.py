"""The price of skipping in a guided host, measured again while it trains.

Through the seam of packed hosts: the same held-out rays are rendered with every candidate and with
those that the occupancy keeps. A host says nothing of rendering weights, so that the image price is
what is bounded. Hosts that draw a fixed number of samples skip none, and are not watched.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from leco_plugin.compat.host_outputs import true_colours
from leco_plugin.models.compute.ranks import from_first, is_first, mean, say
from leco_plugin.models.freezing.calibration import (
    THRESHOLDS,
    CalibrationConfig,
    Measured,
)
from leco_plugin.models.freezing.freezing import leave_file
from leco_plugin.models.freezing.held_out_rendering import evaluating, held_out_bundle
from leco_plugin.models.freezing.recheck import Evidence, rays_to_check_with, steps_until_next
from leco_plugin.models.hosts.guide import Guide
from leco_plugin.models.hosts.probation import end_probation
from leco_plugin.models.learning.healing import SUSPECTED_STEPS
from leco_plugin.models.learning.progress import NO_EVIDENCE
from leco_plugin.occupancy import CALIBRATED_AT

LOWERED_TO = 0.25
"""Share of the threshold that is left when it is lowered; the next measurement, after the fewest
steps, says if it is low enough."""


class HostWatch:
    """Stands around the steps of a guided host.

    Args:
        config: bounds and how often they are measured.
        pipeline, trainer: nerfstudio's.
    """

    def __init__(
        self, host: Any, guide: Guide, config: CalibrationConfig, pipeline: Any, trainer: Any
    ) -> None:
        self.host, self.guide, self.config = host, guide, config
        self.pipeline, self.trainer = pipeline, trainer
        self.started, self.steps, self.seconds = 0.0, 0, 0.0
        self.nothing_since: int | None = None
        if config.recheck_rays == 0:
            end_probation(guide)  # of an earlier run, with nothing to end it any more

    def before_step(self, step: int) -> None:
        """Called after everything else that happens before a step."""
        self.started = time.monotonic()

    def after_step(self, step: int) -> None:
        """Measures again where that is due; skips less where it has come to cost too much."""
        self.steps, self.seconds = self.steps + 1, self.seconds + time.monotonic() - self.started
        guide, config = self.guide, self.config
        if guide.kept is None or config.recheck_rays == 0:
            return
        device, watched = guide.frame.device, guide.watched
        nothing = self._keeps_nothing(step, device)
        if not nothing and step < watched.setdefault("due", step + config.steps_per_recheck):
            return
        if not guide.the_occupancy_skips():
            watched["due"] = step + config.steps_per_recheck
            return
        if nothing:
            self._lower(step, 0.0, f"the occupancy kept nothing for {SUSPECTED_STEPS} steps")
            return
        began, low = time.monotonic(), end_probation(guide)
        watched["image"] = from_first(self._measured, device)
        watched["rechecks"] = watched.get("rechecks", 0) + 1
        seconds, a_step = time.monotonic() - began, self.seconds / self.steps
        wait = from_first(lambda: steps_until_next(config, seconds, a_step), device)
        watched["due"] = step + wait
        if low is not None:  # the time that was measured holds the building of a sampler
            watched["due"] = step + config.steps_per_recheck
        if Evidence(*watched["image"]).exceeds():
            lower = LOWERED_TO * guide.the_occupancy().threshold if low is None else low
            why = "the image price of skipping is beyond its bound"
            self._lower(step, lower if lower >= THRESHOLDS[-1] else 0.0, why)
        elif low is not None:
            now = f"its threshold is {guide.the_occupancy().threshold:.4f} now"
            say(f"step {step}: skipping costs this host what it may; {now}")

    def _keeps_nothing(self, step: int, device: torch.device) -> bool:
        """Whether no process has kept a sample for `SUSPECTED_STEPS` steps; all say the same."""
        if mean(float(self.guide.kept or 0), device) > 0.0:
            self.nothing_since = None
            return False
        if self.nothing_since is None:
            self.nothing_since = step
        return step - self.nothing_since >= SUSPECTED_STEPS

    @torch.no_grad()
    def _measured(self) -> tuple[float, ...]:
        """The evidence so far, with that of a few more rays."""
        guide, host, config = self.guide, self.host, self.config
        seed = guide.watched.get("rechecks", 0) + 1
        data = self.pipeline.datamanager
        bundle, truth = held_out_bundle(data, config.recheck_rays, seed, "recheck")
        bundle, truth = bundle.to(host.device), truth.to(host.device).float()
        kept = guide.kept
        try:
            with evaluating(host):
                gated = self._errors(bundle, truth)
                guide.dense = True
                dense = self._errors(bundle, truth)
        finally:
            guide.dense, guide.kept = False, kept
        excess = gated - 10.0 ** (0.1 * config.image_price_db) * dense
        before = Evidence(*guide.watched.get("image", NO_EVIDENCE))
        return tuple(before.with_rays(excess, rays_to_check_with(data, config)))

    def _errors(self, bundle: Any, truth: Tensor) -> Tensor:
        """Squared error of rendered rays: [R]."""
        rgb = self.host(bundle)["rgb"][:, :3].float()
        return ((rgb - true_colours(self.host, truth)) ** 2).sum(dim=-1)

    def _lower(self, step: int, threshold: float, why: str) -> None:
        occupancy = self.guide.the_occupancy()
        before = occupancy.threshold
        end_probation(self.guide)
        occupancy.threshold_value.fill_(threshold)
        occupancy.report = _lowered(occupancy.report, before, step, threshold)
        self.guide.watched["image"] = NO_EVIDENCE
        # of what was wrong once it is soon asked whether it still is, however long that takes
        self.guide.watched["due"] = step + self.config.steps_per_recheck
        self.guide.changed()
        now = f"lowered from {before:.4f} to {threshold:.4f}"
        nothing = "0: from now on nothing is skipped"
        say(f"step {step}: {why}; the threshold is {now if threshold > 0.0 else nothing}")
        if self.trainer is not None and is_first():
            leave_file(occupancy, Path(self.trainer.base_dir))


def _lowered(report: dict[str, Any], before: float, step: int, threshold: float) -> dict[str, Any]:
    """What an occupancy says of itself with a lower threshold. Its figures stay those of the
    threshold that was calibrated, which it names from then on; of nothing skipped all are known."""
    lowered = {"threshold": threshold, "lowered": [*report.get("lowered", []), [step, threshold]]}
    if threshold > 0.0:
        return {CALIBRATED_AT: before, **report, **lowered}
    known = {name: value for name, value in report.items() if name != CALIBRATED_AT}
    return known | dict.fromkeys(Measured._fields, 0.0) | lowered
