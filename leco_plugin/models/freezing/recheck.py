"""The price of skipping, measured again in guided training: a frozen gate meets a better field.

Calibration bounds the price for the field of that moment. Every so many steps it is measured anew
on a few held-out rays that the calibration did not use. What is lost near surfaces counts where the
photographs miss it: where the gate skips, the field is not trained any more, and shows haze. Where
a price is found to be beyond its bounds, the threshold is calibrated again among lower ones; where
none of these is within them, nothing is skipped any more. A field that was begun anew at freezing
has never learned what is skipped, and may show anything there: its image alone is asked.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from leco_plugin.models.compute.ranks import from_first, say
from leco_plugin.models.freezing.calibration import (
    CalibrationConfig,
    Measured,
    calibrate,
    ray_prices,
)
from leco_plugin.models.freezing.held_out_rendering import (
    calibration_rays,
    dense_rendering,
    evaluating,
    images_of,
)
from leco_plugin.models.learning.progress import NO_EVIDENCE, Progress
from leco_plugin.scenes.pixels.held_out_pixels import held_out_sampler

if TYPE_CHECKING:
    from leco_plugin.models.leco import LecoModel

REMEMBERED = 0.8
"""How much the rays of a measurement count beside those of the next: the field goes on learning."""
SURE = 2.0
"""Standard errors by which a price must be beyond its bound. Without, a long run of measurements
would lower the threshold of a sound gate step by step to nothing."""
SHARE_OF_TIME = 0.01
"""Of guided training, the largest share that measuring again may take."""


class Evidence(NamedTuple):
    """How far rays are beyond a bound on average, from sums in which older rays count less."""

    rays: float
    total: float
    squares: float

    def with_rays(self, values: Tensor, most: float) -> Evidence:
        """With the rays of one more measurement.

        Args:
            values: [R], of one of the excesses of `calibration.RayPrices`. What is not finite is no
                evidence; a field whose loss is not finite stops the run by itself.
            most: rays that there are: however often they are measured, they are no more evidence.
        """
        values = values[values.isfinite()].double()
        new = (float(len(values)), float(values.sum()), float(values.square().sum()))
        sums = [REMEMBERED * old + more for old, more in zip(self, new)]
        share = min(1.0, most / max(sums[0], 1e-9))
        return Evidence(*(share * total for total in sums))

    def exceeds(self) -> bool:
        """Whether the mean is above 0 by more than `SURE` standard errors."""
        if self.rays <= 1.0:
            return False
        mean = self.total / self.rays
        variance = max(0.0, self.squares / self.rays - mean * mean)
        return mean > 0.0 and mean > SURE * math.sqrt(variance / self.rays)


def rays_to_check_with(datamanager: Any, config: CalibrationConfig) -> float:
    """How many held-out rays there are to measure again with, or at least as many as are remembered
    of a long run of measurements."""
    sampler = held_out_sampler(datamanager)
    if sampler is None:
        return math.inf
    remembered = math.ceil(config.recheck_rays / (1.0 - REMEMBERED))
    return float(sampler.count_held_out(images_of(datamanager), remembered, "recheck"))


def steps_until_next(config: CalibrationConfig, seconds: float, a_step: float) -> int:
    """Steps between two measurements.

    Args:
        seconds: that the last one took.
        a_step: seconds of a training step.
    """
    within_share = math.ceil(seconds / (SHARE_OF_TIME * max(a_step, 1e-9)))
    return max(config.steps_per_recheck, within_share)


def bounds_of(model: LecoModel) -> CalibrationConfig:
    """What skipping may cost the field as it is: of one that was begun anew, any of its surfaces,
    which it has put before the haze of its first weights. That haze also makes any skipping look
    good, so that such a field is in effect not watched."""
    config = model.config.calibration
    return replace(config, lost_surface_mass=1.0) if model.config.schedule.restart else config


@torch.no_grad()
def measure_again(model: LecoModel, datamanager: Any) -> None:
    """Adds one measurement to the evidence in the model's progress; the model is left as it was."""
    config, progress = bounds_of(model), model.progress
    threshold = float(model.threshold)

    def evidence() -> tuple[tuple[float, ...], tuple[float, ...]]:
        seed = progress.rechecks + 1
        rays, truth = calibration_rays(model, datamanager, config.recheck_rays, seed, "recheck")
        with evaluating(model):
            prices = ray_prices(*dense_rendering(model, rays, truth), threshold, missed_only=True)
        found = prices.surface_excess(config), prices.image_excess(config)
        before = (Evidence(*progress.surface), Evidence(*progress.image))
        most = rays_to_check_with(datamanager, config)
        surface, image = (old.with_rays(new, most) for old, new in zip(before, found))
        return tuple(surface), tuple(image)

    progress.surface, progress.image = from_first(evidence, model.device)
    progress.rechecks += 1


def beyond_bounds(progress: Progress) -> str | None:
    """Which price is found to be beyond its bound, in words; None is neither."""
    named = {"lost surface mass": progress.surface, "the image price": progress.image}
    found = [name for name, evidence in named.items() if Evidence(*evidence).exceeds()]
    return " and ".join(found) or None


@torch.no_grad()
def skip_less(model: LecoModel, datamanager: Any, step: int, why: str) -> Measured:
    """Lowers the threshold until the prices are within their bounds; 0 where none is low enough.

    Args:
        why: see `beyond_bounds`.
    """
    progress, before = model.progress, float(model.threshold)

    def again() -> Measured:
        rays, truth = calibration_rays(model, datamanager, seed=progress.rechecks, share="all")
        with evaluating(model):
            rendering = dense_rendering(model, rays, truth)
            return calibrate(*rendering, bounds_of(model), below=before, missed_only=True)

    measured = from_first(again, model.device)
    model.threshold.fill_(measured.threshold)
    # a new report: whoever was given the old one keeps what it said
    model.report = model.report | {
        **measured._asdict(),
        "lowered": [*model.report.get("lowered", []), [step, measured.threshold]],
    }
    model.forget_estimator()
    progress.surface = progress.image = NO_EVIDENCE
    now = (
        f"threshold {before:.4f} lowered to {measured.threshold:.4f}, which skips "
        f"{measured.empty_fraction:.1%} for {measured.image_price_db:+.3f} dB and "
        f"{measured.lost_surface_mass:.2e} of the surface mass"
        if measured.threshold > 0.0
        else "no threshold is low enough: from now on nothing is skipped"
    )
    say(f"step {step}: {why} of skipping is beyond its bound for the field as it is now; {now}")
    return measured
