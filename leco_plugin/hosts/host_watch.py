"""How a guided host begins, opaque and at a lower threshold, and what skipping costs it later.

Through the seam of packed hosts: the same held-out rays are rendered with every candidate and with
those that the occupancy keeps. A host says nothing of rendering weights, so that the image price is
what is bounded. Hosts that draw a fixed number of samples skip none, and are not watched.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from leco_plugin.evaluation.clock import seconds_now
from leco_plugin.hosts.guide import Guide
from leco_plugin.hosts.stand_ins import is_packed
from leco_plugin.learning.calibration import THRESHOLDS, CalibrationConfig, Measured, promise_below
from leco_plugin.learning.collapse import SUSPECTED_STEPS
from leco_plugin.learning.dense import evaluating
from leco_plugin.learning.freezing import leave_file
from leco_plugin.learning.price_watch import PriceWatch
from leco_plugin.learning.run import Run
from leco_plugin.log import note, say
from leco_plugin.models.compute.ranks import from_first
from leco_plugin.occupancy import CALIBRATED_AT, Occupancy
from leco_plugin.scenes.learning_data import count_held_out, held_out_bundle
from leco_plugin.studio.host_models import true_colours

OPACITY = 0.9
"""Of half of the rays, what is kept hides at least so much at first."""
SCALE = "average_init_density"
"""nerfstudio's name for the density with which a field begins."""


def begin_opaque(host: nn.Module, guide: Guide, kept_lengths: Tensor) -> None:
    """Raises the density with which a packed host's field begins, before its first step, where the
    kept stretches [R] of its rays, scene units, need it; the guide remembers it for checkpoints."""
    scales = [float(getattr(module, SCALE)) for module in _scaled(host)]
    if not scales:
        return
    lengths = kept_lengths[kept_lengths > 0.0]
    length = from_first(lambda: float(lengths.median()) if len(lengths) else 0.0, lengths.device)
    if length == 0.0 or (wanted := -math.log(1.0 - OPACITY) / length) <= min(scales):
        return
    guide.first_density = wanted
    set_first_density(host, guide)
    note(
        f"the host begins with a density of {wanted:.3g} instead of {min(scales):.3g}, with which "
        f"the {length:.3g} scene units that are kept of a ray are opaque"
    )


def set_first_density(host: nn.Module, guide: Guide) -> None:
    """Gives the host's fields what a guide has found or has read from a checkpoint."""
    for module in _scaled(host):
        if guide.first_density is not None:
            setattr(module, SCALE, max(guide.first_density, float(getattr(module, SCALE))))


def _scaled(host: nn.Module) -> list[nn.Module]:
    """What has that density to set in a host whose samples are packed: its fields, or itself."""
    return [each for each in host.modules() if hasattr(each, SCALE)] if is_packed(host) else []


CAREFUL = 1.0 / 16.0
"""Share of the calibrated threshold that a host begins with, where that skips enough."""
STILL_SKIPPED = 0.4
"""Of what the calibrated threshold skips within the scene's bounds, the least share that is skipped
at first too."""
ANYTHING = 1e-30
"""A threshold that keeps all that is within the bounds."""


def begin_carefully(host: nn.Module, guide: Guide, skipped: Callable[[Occupancy], float]) -> bool:
    """Has a packed host follow a lower threshold for the beginning; returns whether it does.
    `skipped` says what share of what the cameras see an occupancy skips."""
    if not is_packed(host):
        return False
    occupancy = guide.the_occupancy()
    lower = from_first(lambda: _first_threshold(occupancy, skipped), guide.frame.device)
    if lower is None:
        return False
    guide.watched.lower = lower
    guide.changed()
    note(
        f"the host begins at threshold {lower:.4f} instead of {occupancy.threshold:.4f}, until "
        "skipping has shown in it what it costs"
    )
    return True


def _first_threshold(occupancy: Occupancy, skipped: Callable[[Occupancy], float]) -> float | None:
    """The lower threshold to begin with; None where only the calibrated one skips enough."""
    calibrated = occupancy.threshold
    lower = max(CAREFUL * calibrated, THRESHOLDS[-1])
    if calibrated < 1.1 * lower:
        return None
    beyond = skipped(occupancy.with_threshold(ANYTHING))
    enough = beyond + STILL_SKIPPED * (skipped(occupancy) - beyond)
    while skipped(occupancy.with_threshold(lower)) < enough:
        lower *= 2.0
        if calibrated < 1.1 * lower:
            return None
    return lower


def end_probation(guide: Guide) -> float | None:
    """Has a host follow the calibrated threshold; returns the lower one, None where it has none."""
    lower, guide.watched.lower = guide.watched.lower, None
    if lower is not None:
        guide.changed()
    return lower


LOWERED_TO = 0.25
"""Share of the threshold that is left when it is lowered; the next measurement, after the fewest
steps, says if it is low enough."""


class HostWatch:
    """Stands around the steps of a guided host, and measures the price bounds of a config."""

    def __init__(
        self, host: Any, guide: Guide, config: CalibrationConfig, pipeline: Any, run: Run
    ) -> None:
        self.host, self.guide, self.config = host, guide, config
        self.pipeline, self.run = pipeline, run
        self.started = 0.0
        self.ended_probation: float | None = None
        self.watch = PriceWatch(guide.watched, self, config, guide.frame.device)
        if config.recheck_rays == 0:
            end_probation(guide)  # of an earlier run, with nothing to end it any more

    def before_step(self, step: int) -> None:
        """Called after everything else that happens before a step."""
        self.started = seconds_now()

    def after_step(self, step: int) -> None:
        """Measures again where that is due; skips less where it has come to cost too much."""
        seconds, guide = seconds_now() - self.started, self.guide
        if guide.kept is None or self.config.recheck_rays == 0:
            return
        self.watch.state, self.ended_probation = guide.watched, None
        skips = not guide.needs_occupancy or guide.the_occupancy().threshold > 0.0
        finding = self.watch.after_step(step, seconds, float(guide.kept), skips)
        low = self.ended_probation
        if low is not None:  # the time that was measured holds the building of a sampler
            self.watch.put_off(step)
        if finding is None:
            return
        if finding.kind == "nothing kept":
            self._lower(step, 0.0, f"the occupancy kept nothing for {SUSPECTED_STEPS} steps")
        elif finding.kind == "beyond":
            lower = LOWERED_TO * guide.the_occupancy().threshold if low is None else low
            why = f"{finding.why} of skipping is beyond its bound"
            self._lower(step, lower if lower >= THRESHOLDS[-1] else 0.0, why)
        elif low is not None:
            now = f"its threshold is {guide.the_occupancy().threshold:.4f} now"
            note(f"step {step}: skipping is within its price bounds; {now}")

    def prepare(self) -> None:
        """See `price_watch.PriceSource`: the calibrated threshold is followed from now on."""
        self.ended_probation = end_probation(self.guide)

    @torch.no_grad()
    def excesses(self, seed: int) -> dict[str, Tensor]:
        """See `price_watch.PriceSource`."""
        guide, host, config = self.guide, self.host, self.config
        bundle, truth = held_out_bundle(
            self.pipeline.datamanager, config.recheck_rays, seed, "recheck"
        )
        bundle, truth = bundle.to(host.device), truth.to(host.device).float()
        kept = guide.kept
        try:
            with evaluating(host):
                gated = squared_errors(host, bundle, truth)
                guide.dense = True
                dense = squared_errors(host, bundle, truth)
        finally:
            guide.dense, guide.kept = False, kept
        return {"the image price": gated - 10.0 ** (0.1 * config.image_price_db) * dense}

    def count_rays(self, limit: int) -> float:
        """See `price_watch.PriceSource`."""
        return count_held_out(self.pipeline.datamanager, limit)

    def _lower(self, step: int, threshold: float, why: str) -> None:
        occupancy = self.guide.the_occupancy()
        before = occupancy.threshold
        end_probation(self.guide)
        report = _lowered(occupancy.report, before, step, threshold)
        occupancy = occupancy.with_threshold(threshold, report)
        self.guide.set_occupancy(occupancy)
        self.watch.state.evidence = {}
        # of what was wrong once it is soon asked whether it still is, however long that takes
        self.watch.put_off(step)
        now = f"lowered from {before:.4f} to {threshold:.4f}"
        nothing = "0: from now on nothing is skipped"
        say(f"step {step}: {why}; the threshold is {now if threshold > 0.0 else nothing}")
        leave_file(occupancy, self.run.folder)


def squared_errors(host: Any, bundle: Any, truth: Tensor) -> Tensor:
    """Squared error [R] of rays that a host renders, on its device."""
    rgb = host(bundle)["rgb"][:, :3].float()
    return ((rgb - true_colours(host, truth)) ** 2).sum(dim=-1)


def _lowered(report: dict[str, Any], before: float, step: int, threshold: float) -> dict[str, Any]:
    """What an occupancy says of itself with a lower threshold. Its figures stay those of the
    threshold that was calibrated, which it names from then on: a host gives no weights to measure
    others by. Where nothing is skipped all are 0, as `calibration.measure` finds them there too."""
    lowered = {"threshold": threshold, "lowered": [*report.get("lowered", []), [step, threshold]]}
    if threshold > 0.0:
        return {CALIBRATED_AT: before, **report, **lowered}
    known = {name: value for name, value in report.items() if name != CALIBRATED_AT}
    return known | dict.fromkeys(Measured._fields, 0.0) | promise_below(report, 0.0) | lowered
