"""Measurements on held-out pixels: the price of skipping, and which experts are needed.

The methods return values and do not change the mixture.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from leco_plugin.evaluation.metrics import psnr
from leco_plugin.learning.calibration import (
    THRESHOLDS,
    CalibrationConfig,
    Measured,
    backdrop_price,
    calibrate,
    lost_by_each,
    measure,
    promise,
    ray_prices,
)
from leco_plugin.learning.dense import dense_reference, dense_rendering, evaluating
from leco_plugin.learning.merging import Merging, find_unneeded
from leco_plugin.learning.price_watch import PriceSource
from leco_plugin.learning.quality import FIELD, ONE_COLOUR, psnr_of_one_colour
from leco_plugin.learning.sharpening import Sharpened, SharpeningConfig, sharpen
from leco_plugin.models.mixture import Mixture
from leco_plugin.models.objective import GateLossConfig
from leco_plugin.models.rendering import Rays
from leco_plugin.occupancy import BACKDROP_PRICE, CAMERAS_THAT_VOUCH, TESTS_LOSE

if TYPE_CHECKING:
    from leco_plugin.scenes.learning_data import LearningData
    from leco_plugin.scenes.pixels.held_out_pixels import Share


OF_SURFACES = ("lost_surface_mass", "lost_mass", "surface_error")
"""What a report says of lost weight: the haze of a restarted field falsifies it."""
CAREFUL = 0.25
"""Share of its calibrated threshold at which a learned gate skips until a small one follows it."""


class HeldOut(PriceSource):
    """Held-out pixels, as a mixture renders them.

    Args:
        config: how many, and what skipping may cost.
        restarted: whether the field was started anew when the gate was frozen. Where the gate
            skips, it keeps the haze of its first weights, which would count as lost surface: only
            the image price has a bound. Haze flatters that too: in effect nothing is watched.
    """

    def __init__(
        self, mixture: Mixture, data: LearningData, config: CalibrationConfig, restarted: bool
    ) -> None:
        self.mixture, self.data, self.config = mixture, data, config
        self.guided = replace(config, lost_surface_mass=1.0) if restarted else config

    def rays(self, count: int, seed: int = 0, which: Share = "calibration") -> tuple[Rays, Tensor]:
        """Rays cut to the region, and their colours [R, 3]; see `held_out_bundle`."""
        return self.data.held_out(self.mixture, count, seed, which)

    def cameras(self) -> list[Rays]:
        """Rays of each photograph that vouches."""
        return self.data.of_vouching(self.mixture, self.config.cameras, self.config.camera_rays)

    def tests(self) -> list[Rays]:
        """Rays of each of some test photographs, which neither teach nor choose a threshold: they
        say what a new view loses to both a careful gate and the small one after it."""
        return self.data.of_tests(self.mixture, self.config.cameras, self.config.camera_rays)

    @torch.no_grad()
    def price(self, careful: bool = False) -> tuple[Measured, Measured, dict[str, Any]]:
        """The threshold to freeze at, the largest one within the bounds, and what a report says of
        the first.

        Args:
            careful: whether to skip less than the bounds allow: what is skipped while the field is
                haze, it does not find later.
        """
        mixture, config = self.mixture, self.config
        rays, truth = self.rays(config.rays)
        with evaluating(mixture):
            rendering = dense_rendering(mixture, rays, truth, config.rays_at_once)
            of_cameras = [dense_reference(mixture, of_one) for of_one in self.cameras()]
            tests = self.tests() if careful else []
            of_tests = [dense_reference(mixture, of_one) for of_one in tests]
            measured = within = calibrate(rendering, config, cameras=of_cameras)
            if careful and within.threshold > 0.0:
                lowest = THRESHOLDS[-1]  # else the watch had none to lower it to but 0
                measured = measure(rendering, max(CAREFUL * within.threshold, lowest))
            of_backdrop = backdrop_price(rendering)
            rendered = torch.cat([reference.rgb for reference in rendering.references])
        rule, region = mixture.rule(), mixture.region
        report = {
            "params": sum(p.numel() for p in mixture.gate.parameters()),
            **measured._asdict(),
            BACKDROP_PRICE: round(of_backdrop, 4),
            FIELD: round(psnr(rendered.clamp(0.0, 1.0), truth), 3),
            ONE_COLOUR: round(psnr_of_one_colour(truth), 3),
            "calibration_rays": len(truth),
            CAMERAS_THAT_VOUCH: promise(lost_by_each(of_cameras, measured.threshold), config),
            "near": float(region.near),
            "far": float(region.far),
            "step_size": rule.step_size,
            "cone_angle": rule.cone_angle,
            "aabb": region.aabb.tolist(),
            **self.data.facts(),
        }
        if careful:
            report[TESTS_LOSE] = lost_by_each(of_tests, measured.threshold)
        return measured, within, report

    @torch.no_grad()
    def lower(self, below: float, seed: int) -> Measured:
        """The largest threshold below another one within the bounds, for the field as it is now.
        For a restarted field the report keeps the lost mass of the first field."""
        config = self.guided
        rays, truth = self.rays(config.rays, seed, "all")
        with evaluating(self.mixture):
            rendering = dense_rendering(self.mixture, rays, truth, config.rays_at_once)
            found = calibrate(rendering, config, below=below, missed_only=True)
        if config is self.config or found.threshold == 0.0:
            return found
        report = self.mixture.report
        return found._replace(**{name: report[name] for name in OF_SURFACES if name in report})

    def excesses(self, seed: int) -> dict[str, Tensor]:
        """See `PriceSource`; lost surfaces count as with `missed_only` of `calibration.measure`."""
        config, mixture = self.guided, self.mixture
        rays, truth = self.rays(config.recheck_rays, seed, "recheck")
        with evaluating(mixture):
            rendering = dense_rendering(mixture, rays, truth, config.rays_at_once)
            prices = ray_prices(rendering, float(mixture.threshold), missed_only=True)
        return {
            "lost surface mass": prices.surface_excess(config),
            "the image price": prices.image_excess(config),
        }

    def count_rays(self, limit: int) -> float:
        return self.data.count_held_out(limit)

    def sharpened(self, losses: GateLossConfig, config: SharpeningConfig) -> Sharpened | None:
        """A small gate that training pixels teach and these calibrate; see `sharpen`."""
        taught = self.data.training_rays(self.mixture, config.rays)
        rays, cameras = self.rays(self.config.rays), self.cameras()
        tests = self.tests() if self.mixture.report.get(TESTS_LOSE) else []
        return sharpen(self.mixture, taught, rays, cameras, tests, losses, self.config, config)

    def unneeded(self, count: int, bound: float) -> Merging:
        """Scene experts without which the image loses no more than `bound` dB."""
        rays, truth = self.rays(count)
        return find_unneeded(self.mixture, rays, truth, bound, self.config.rays_at_once)
