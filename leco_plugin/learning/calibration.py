"""The threshold: the largest one whose price, measured on held-out rays, is within its bounds.

The reference is a dense rendering. Skipping every sample with o(x) < tau loses weight near surfaces
(lost surface mass) and changes the image (image price). Both are measured.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

import torch
from torch import Tensor

from leco_plugin.learning.dense import DenseRendering, Reference
from leco_plugin.occupancy import CAMERAS_THAT_VOUCH
from leco_plugin.on_cpu import in_float64
from leco_plugin.samplers.packed import accumulate_along_rays
from leco_plugin.scenes.input_error import require

THRESHOLDS = tuple(0.75 * 0.8**i for i in range(32))
"""Tried from the largest down, to 0.0007; below that a gate that fails is kept out of use (0)."""

SURE = 1.0
"""Standard errors by which a price must be beyond its bound to count as beyond it."""
MOST = 10.0
"""Times its bound that a price may be measured, however large its standard error is."""
MORE_KEPT = 1.25
"""Photographs that vouch may lower the threshold until so many times as many candidates are kept,
and no further. A view that resembles no other loses much by any threshold: the report says so."""
EXACT = 1e-10
"""Mean squared error, 100 dB, below which two renderings are both exact."""


@dataclass(frozen=True)
class CalibrationConfig:
    """What skipping may cost."""

    lost_surface_mass: float = 3e-4
    """Largest share of the weight near surfaces that may fall on skipped samples, up to a standard
    error of what is measured."""
    image_price_db: float = 0.04
    """Largest loss of PSNR on the calibration rays, in dB, likewise."""
    camera_surface_mass: float = 2e-3
    """Largest share of the weight near surfaces that any photograph may lose that vouches."""
    cameras: int = 9
    """Training photographs that teach a learned gate nothing, and vouch for it: what none of these
    loses, another view loses with a chance of one in one more. Once it is frozen they train the
    field, and teach a small gate too. 0 is none; nor are there any where they would be more than a
    quarter."""
    camera_rays: int = 512
    """Rays of each to measure with."""
    rays: int = 8192
    """Held-out training rays to measure with, or as many as there are."""
    rays_at_once: int = 1024
    """Rays rendered at a time."""
    recheck_rays: int = 512
    """Other held-out rays on which prices are measured again in guided training; 0 is never, and
    hosts are not watched at all then, and follow the threshold from their first step."""
    steps_per_recheck: int = 100
    """Fewest steps between two such measurements, also after one by which a host skips less; else
    more where they take over 1% of the time."""

    def __post_init__(self) -> None:
        at_least_one = ("camera_rays", "rays", "rays_at_once", "steps_per_recheck")
        fewest = dict.fromkeys(at_least_one, 1) | {"cameras": 0, "recheck_rays": 0}
        for name, least in fewest.items():
            value = getattr(self, name)
            option = f"calibration.{name.replace('_', '-')}"
            require(value >= least, option, value, f"at least {least}")
        for name in ("lost_surface_mass", "image_price_db", "camera_surface_mass"):
            value = getattr(self, name)
            option = f"calibration.{name.replace('_', '-')}"
            require(0.0 <= value < math.inf, option, value, "a number, at least 0")


class Measured(NamedTuple):
    """What a threshold costs and saves, on one set of rays."""

    threshold: float
    lost_surface_mass: float
    """Share of the weight near surfaces that is skipped."""
    lost_mass: float
    """Share of all weight that is skipped."""
    image_price_db: float
    """PSNR lost by skipping; NaN where nothing was rendered."""
    empty_fraction: float
    """Share of all candidates that are skipped."""
    surface_error: float = 0.0
    """Standard error of `lost_surface_mass`, by the spread over rays."""
    price_error_db: float = 0.0
    """Standard error of `image_price_db`."""

    @property
    def line(self) -> str:
        """In the words of the log."""
        return (
            f"skips {self.empty_fraction:.1%} for {in_decibels(self.image_price_db)} and "
            f"{self.lost_surface_mass:.2e} of the surface mass"
        )

    def on_top_of(self, before: Mapping[str, Any]) -> Measured:
        """The same with the costs and standard errors of an earlier report added to its own."""
        known = {name: float(before.get(name) or 0.0) for name in (*LOSSES, *ERRORS)}
        # in this order NaN stays NaN
        costs = {name: max(getattr(self, name), 0.0) + max(known[name], 0.0) for name in LOSSES}
        errors = {name: math.hypot(getattr(self, name), known[name]) for name in ERRORS}
        return self._replace(**costs, **errors)

    def line_beside(self, before: Mapping[str, Any], skipped: float) -> str:
        """The same in the words of the log, beside the share that was skipped before."""
        return f"{self.on_top_of(before).line} in all, where {skipped:.1%} were skipped"

    def within(self, config: CalibrationConfig) -> bool:
        """Whether each price is at most its bound and `SURE` standard errors, and at most `MOST`
        times its bound.

        In a small scene a single ray at the rim of a thing costs more than the bound.
        """
        return all(
            price - min(SURE * error, (MOST - 1.0) * bound) <= bound
            for price, error, bound in (
                (self.lost_surface_mass, self.surface_error, config.lost_surface_mass),
                (self.image_price_db, self.price_error_db, config.image_price_db),
            )
        )


def in_decibels(price: float) -> str:
    """What skipping costs in PSNR, without a minus before zero."""
    return f"{round(price, 3) + 0.0:+.3f} dB"


LOSSES = ("lost_surface_mass", "lost_mass", "image_price_db")
"""What a report says that skipping costs."""
ERRORS = ("surface_error", "price_error_db")
"""Standard errors of those."""
NOTHING: Mapping[str, Any] = MappingProxyType({})
"""A report by which nothing was skipped so far."""


def lost_by_each(cameras: Sequence[Reference], threshold: float) -> list[float]:
    """The share of its weight near surfaces that each of some photographs, densely rendered, loses
    by skipping below `threshold`. None falls as the threshold rises."""
    found = []
    for reference in cameras:
        surface = reference.surface_weights
        lost = float((surface * reference.skipped(threshold)).sum())
        found.append(lost / max(float(surface.sum()), 1e-12))
    return found


def worst_of(lost: Sequence[float]) -> float:
    """The largest of what `lost_by_each` gives; 0 of none."""
    return float(torch.tensor([0.0, *lost], dtype=torch.float64).max())  # NaN where any is


def promise(lost: Sequence[float], config: CalibrationConfig, taught: bool = False) -> Any:
    """What a report says of photographs that vouch, by what each of them has lost, as JSON values;
    None where none does.

    Were photographs drawn at random, another one would lose more than the worst of K with a chance
    of 1 in K + 1 at most, because a loss never falls as the threshold rises: split conformal
    prediction, as in Angelopoulos et al., "Conformal Risk Control", 2022. Those that have `taught`
    the gate say what they lose, and of other views nothing, with no confidence.
    """
    if not lost:
        return None
    worst, count = worst_of(lost), len(lost)
    return {
        "count": count,
        "worst_surface_mass": worst,
        "bound": max(worst, config.camera_surface_mass),
        "confidence": None if taught else round(count / (count + 1), 3),
    }


def promise_below(report: Mapping[str, Any], threshold: float) -> dict[str, Any]:
    """What changes in a report's promise when its threshold is lowered: at 0 nothing is lost. Above
    0 no more is lost, so the promise made at freezing holds. It cannot be measured again: those
    photographs have trained the field since."""
    said = report.get(CAMERAS_THAT_VOUCH)
    if not said or threshold > 0.0:
        return {}
    return {CAMERAS_THAT_VOUCH: said | {"worst_surface_mass": 0.0, "bound": 0.0}}


def worst_so_far(spent: Mapping[str, Any]) -> float:
    """What the worst photograph that vouches has lost by a report; 0 where none is named."""
    return float((spent.get(CAMERAS_THAT_VOUCH) or {}).get("worst_surface_mass", 0.0))


class RayPrices(NamedTuple):
    """What skipping below a threshold costs single rays, [R] each, and saves all of them."""

    surface: Tensor
    """Weight near surfaces."""
    lost_surface: Tensor
    """The part of it that is skipped; if asked so, 0 where the photograph does not miss it."""
    lost: Tensor
    """Weight of all that is skipped."""
    weight: Tensor
    dense_error: Tensor
    """Squared error of the dense image, and..."""
    gated_error: Tensor
    """...of the gated one; zero where nothing is rendered, as is the dense one."""
    skipped: int
    candidates: int

    def surface_excess(self, config: CalibrationConfig) -> Tensor:
        """Lost weight near surfaces less the share that may be lost: a mean above 0 is too much."""
        return self.lost_surface - config.lost_surface_mass * self.surface

    def image_excess(self, config: CalibrationConfig) -> Tensor:
        """Squared error of the gated image less what the bound makes of the dense one's."""
        return self.gated_error - 10.0 ** (0.1 * config.image_price_db) * self.dense_error


def ray_prices(
    rendering: DenseRendering, threshold: float, with_image: bool = True, missed_only: bool = False
) -> RayPrices:
    """Prices of skipping below `threshold`, ray by ray; arguments as for `measure`."""
    found: list[Tensor] = []
    skipped = candidates = 0
    for i, (reference, truth) in enumerate(zip(rendering.references, rendering.truths)):
        gone, ray_indices = reference.skipped(threshold), reference.intervals.ray_indices
        on_surface = reference.surface_weights
        lost_on_surface = on_surface * gone
        skipped, candidates = skipped + int(gone.sum()), candidates + len(gone)
        dense_error = gated_error = truth.new_zeros(len(truth))
        if with_image:
            dense_error = (reference.rgb - truth).square().sum(dim=-1)
            gated_error = (rendering.render_kept(i, ~gone) - truth).square().sum(dim=-1)
            if missed_only:
                with_surfaces = rendering.render_kept(i, ~gone | reference.near_surface)
                better = (with_surfaces - truth).square().sum(dim=-1) < gated_error
                lost_on_surface = lost_on_surface * better[ray_indices]
        samples = [on_surface, lost_on_surface, reference.weights * gone, reference.weights]
        of_rays = accumulate_along_rays(
            torch.ones_like(reference.weights),
            torch.stack(samples, dim=-1),
            ray_indices,
            len(truth),
        )
        found.append(in_float64(torch.stack([*of_rays.unbind(dim=-1), dense_error, gated_error])))
    together = torch.cat(found, dim=-1) if found else torch.zeros(6, 0)
    surface, lost_surface, lost, weight, dense_error, gated_error = together.unbind()
    return RayPrices(
        surface, lost_surface, lost, weight, dense_error, gated_error, skipped, candidates
    )


def measure(
    rendering: DenseRendering, threshold: float, with_image: bool = True, missed_only: bool = False
) -> Measured:
    """What skipping below `threshold` costs and saves.

    Args:
        with_image: whether to render at all; the image price is NaN otherwise.
        missed_only: of a ray, count lost surfaces only if its pixel is better rendered with them;
            needs `with_image`. Guided training never corrects the field where the gate skips, so
            haze may stand there, and only photographs tell it from a surface. A loss that the field
            has since painted over no longer shows: it is found soon after freezing or not at all.
    """
    rays = ray_prices(rendering, threshold, with_image, missed_only)
    surface = max(float(rays.surface.sum()), 1e-12)
    lost_surface = float(rays.lost_surface.sum()) / surface
    price = price_error = float("nan")
    if with_image and len(rays.weight):
        price, price_error = image_price(
            rays.gated_error, rays.dense_error, EXACT * sum(map(torch.numel, rendering.truths))
        )
    return Measured(
        threshold,
        lost_surface,
        float(rays.lost.sum()) / max(float(rays.weight.sum()), 1e-12),
        price,
        rays.skipped / max(rays.candidates, 1),
        float((rays.lost_surface - lost_surface * rays.surface).square().sum().sqrt()) / surface,
        price_error,
    )


def backdrop_price(rendering: DenseRendering) -> float:
    """What an image loses without its backdrop, dB of PSNR: 0 where all rays meet a ground."""
    dense = without = floor = 0.0
    for i, (reference, truth) in enumerate(zip(rendering.references, rendering.truths)):
        rgb = rendering.render_kept(i, ~reference.always_kept)
        dense += float(in_float64((reference.rgb - truth).square()).sum())
        without += float(in_float64((rgb - truth).square()).sum())
        floor += EXACT * truth.numel()
    return price_db(without, dense, floor) if floor else 0.0


def image_price(gated: Tensor, dense: Tensor, floor: float) -> tuple[float, float]:
    """By how many dB of PSNR an image is worse than the dense one, and the standard error of that,
    from squared errors [R] of the same rays; a sum of `floor` is as good as none."""
    gated, dense = in_float64(gated), in_float64(dense)
    after, before = float(gated.sum()), float(dense.sum())
    apart = gated / (after + floor) - dense / (before + floor)
    error = 10.0 / math.log(10.0) * float(apart.square().sum().sqrt())
    return price_db(after, before, floor), error


def price_db(error: float, of_dense: float, floor: float) -> float:
    """By how many dB of PSNR a squared error is worse than that of the dense image; one of `floor`
    is as good as none."""
    return 10.0 * math.log10((error + floor) / (of_dense + floor))


def thresholds_below(threshold: float) -> list[float]:
    """Those of `THRESHOLDS` that are lower, the highest first. A threshold that was kept in float32
    may come back a little above the one that it was; that one is not lower."""
    return [tried for tried in THRESHOLDS if tried < (1.0 - 1e-6) * threshold]


def calibrate(
    rendering: DenseRendering,
    config: CalibrationConfig,
    below: float = 1.0,
    missed_only: bool = False,
    cameras: Sequence[Reference] = (),
    spent: Mapping[str, Any] = NOTHING,
) -> Measured:
    """The largest threshold of `THRESHOLDS` within the bounds, with what it costs.

    When none is, the threshold is 0: everything is kept, which is slow and never wrong.

    Args:
        below: only lower thresholds are tried.
        missed_only: as for `measure`.
        cameras: dense renderings of photographs that vouch. None of them may lose more than
            `camera_surface_mass`, see `lost_by_each`, as far as `MORE_KEPT` allows.
        spent: the report of what has skipped so far. Its costs are added to those measured, and
            both together are held to the bounds.
    """
    best, earlier = None, worst_so_far(spent)
    if earlier > config.camera_surface_mass:
        earlier = 0.0  # no threshold did justice to that view; others are still looked after
    for threshold in thresholds_below(below):
        worst = worst_of(lost_by_each(cameras, threshold)) + earlier
        beyond = not worst <= config.camera_surface_mass
        if best is not None and beyond:
            continue
        if not missed_only:
            cheap = measure(rendering, threshold, with_image=False)
            cheap = cheap._replace(image_price_db=0.0, price_error_db=0.0)
            if not cheap.on_top_of(spent).within(config):
                continue
        measured = measure(rendering, threshold, missed_only=missed_only)
        if not measured.on_top_of(spent).within(config):
            continue
        if not beyond:
            kept = 1.0 - measured.empty_fraction
            if best is None or kept <= MORE_KEPT * (1.0 - best.empty_fraction):
                return measured
            return best
        best = measured
    return measure(rendering, 0.0) if best is None else best
