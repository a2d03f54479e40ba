"""The threshold: the largest one whose price, measured on held-out rays, is within its bounds.

A dense rendering is the reference. Skipping every sample with o(x) < tau loses weight near surfaces
(lost surface mass) and changes the image (image price); both are measured, not hoped for.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from leco_plugin.models.gate import occupancy_from_logits
from leco_plugin.models.rendering import Intervals, Rays, Shaded, backdrop_of
from leco_plugin.samplers.packed import accumulate_along_rays, inclusive_sum

THRESHOLDS = tuple(0.75 * 0.8**i for i in range(32))
"""Tried from the largest down, to 0.0007; below that a gate that fails is kept out of use (0)."""

SURFACE_STEPS = 2.0
"""Weight within this many steps of a ray's median depth counts as surface, the rest as haze. Of a
ray whose median depth lies in the backdrop, all of it is haze."""
FEWEST_SURFACES = 0.02
"""Share of the rays that meet a surface by that rule; with fewer, haze counts too, so that a field
that has not found its surfaces yet does not pass for one that has nothing to lose."""


@dataclass(frozen=True)
class CalibrationConfig:
    """What skipping may cost."""

    lost_surface_mass: float = 3e-4
    """Largest share of the weight near surfaces that may fall on skipped samples."""
    image_price_db: float = 0.04
    """Largest loss of PSNR on the calibration rays, in dB."""
    rays: int = 8192
    """Held-out training rays to measure with, or as many as there are."""
    rays_at_once: int = 1024
    """Rays rendered at a time."""
    recheck_rays: int = 512
    """Other held-out rays on which prices are measured again in guided training; 0 is never."""
    steps_per_recheck: int = 100
    """Fewest steps between two such measurements; more where they take over 1% of the time."""


class Measured(NamedTuple):
    """What a threshold does, on one set of rays."""

    threshold: float
    lost_surface_mass: float
    lost_mass: float
    image_price_db: float
    empty_fraction: float
    """Share of all candidates between near and far that are skipped."""

    def within(self, config: CalibrationConfig) -> bool:
        """Whether both prices are within their bounds."""
        return (
            self.lost_surface_mass <= config.lost_surface_mass
            and self.image_price_db <= config.image_price_db
        )


class Reference(NamedTuple):
    """A dense rendering of some rays, and what the gate says about its samples."""

    intervals: Intervals
    weights: Tensor
    """[M] rendering weights."""
    occupancies: Tensor
    """[M] o(x)."""
    near_surface: Tensor
    """[M] bool: within `SURFACE_STEPS` steps of the ray's median depth, on rays that meet a
    surface."""
    rgb: Tensor
    """[R, 3] rendered."""
    always_kept: Tensor
    """[M] bool: the backdrop, which no threshold skips."""


def reference_of(shaded: Shaded, intervals: Intervals, rays: Rays) -> Reference:
    """The reference that a rendering of all candidates of some rays is."""
    is_backdrop = backdrop_of(intervals, rays)
    return Reference(
        intervals,
        shaded.weights,
        occupancy_from_logits(shaded.logits),
        near_surface(shaded, intervals, is_backdrop),
        shaded.rgb,
        is_backdrop,
    )


def near_surface(shaded: Shaded, intervals: Intervals, is_backdrop: Tensor) -> Tensor:
    """Which samples lie within `SURFACE_STEPS` steps of their ray's surface.

    A ray whose median depth lies in the backdrop meets none, unless hardly any ray of them all
    meets one. What is thin and before the sky has less than half of its ray's weight: it is guarded
    by the image price alone.

    Args:
        is_backdrop: [M] bool.
    Returns:
        [M] bool.
    """
    if len(is_backdrop) == 0:
        return is_backdrop
    medians = _medians(shaded, intervals)
    meets = ~is_backdrop[medians] & (shaded.packed_info[:, 1] > 0)
    if int(meets.sum()) < FEWEST_SURFACES * len(meets):
        meets = torch.ones_like(meets)
    return _near(medians, intervals) & meets[intervals.ray_indices]


def near_median_depth(shaded: Shaded, intervals: Intervals) -> Tensor:
    """Which samples lie within `SURFACE_STEPS` steps of the depth that halves their ray's weight.

    Returns:
        [M] bool.
    """
    return _near(_medians(shaded, intervals), intervals)


def _near(medians: Tensor, intervals: Intervals) -> Tensor:
    median = medians[intervals.ray_indices]
    middles = 0.5 * (intervals.t_starts + intervals.t_ends)
    steps = (intervals.t_ends - intervals.t_starts)[median]
    return (middles - middles[median]).abs() <= SURFACE_STEPS * steps * 1.001


def _medians(shaded: Shaded, intervals: Intervals) -> Tensor:
    """The sample of each ray that halves its weight: [R], any for a ray without samples."""
    num_rays = len(shaded.packed_info)
    below_half = (
        inclusive_sum(shaded.weights, packed_info=shaded.packed_info)
        < 0.5 * shaded.accumulation[intervals.ray_indices]
    )
    ahead = accumulate_along_rays(below_half.float(), None, intervals.ray_indices, num_rays)[
        :, 0
    ].long()
    starts, counts = shaded.packed_info.unbind(dim=-1)
    median = starts + torch.minimum(ahead, (counts - 1).clamp(min=0))
    return median.clamp(max=max(len(shaded.weights) - 1, 0))


def measure(
    references: list[Reference],
    truths: list[Tensor],
    render_kept: Callable[[int, Tensor], Tensor],
    threshold: float,
    with_image: bool = True,
    missed_only: bool = False,
) -> Measured:
    """What skipping below `threshold` costs and saves.

    Args:
        references: dense renderings of chunks of rays.
        truths: their true pixels, [R, 3] each.
        render_kept: renders chunk i with only the samples of a mask [M]: returns [R, 3].
        with_image: whether to render at all; the image price is NaN otherwise.
        missed_only: count as lost only what the photographs miss, see `is_missed`; with an image.
    """
    surface = lost_surface = total = lost = dense_error = gated_error = 0.0
    skipped = candidates = pixels = 0
    for i, (reference, truth) in enumerate(zip(references, truths)):
        gone = (reference.occupancies < threshold) & ~reference.always_kept
        on_surface = reference.weights * reference.near_surface
        surface += float(on_surface.sum(dtype=torch.float64))
        lost_on_surface = on_surface * gone
        total += float(reference.weights.sum(dtype=torch.float64))
        lost += float(reference.weights[gone].sum(dtype=torch.float64))
        skipped, candidates = skipped + int(gone.sum()), candidates + len(gone)
        if with_image:
            gated = render_kept(i, ~gone)
            dense_error += float(((reference.rgb - truth) ** 2).sum(dtype=torch.float64))
            gated_error += float(((gated - truth) ** 2).sum(dtype=torch.float64))
            pixels += truth.numel()
            if missed_only:
                lost_on_surface *= is_missed(reference, i, gone, gated, truth, render_kept)
        lost_surface += float(lost_on_surface.sum(dtype=torch.float64))
    price = float("nan")
    if with_image and pixels:
        floor = 1e-10 * pixels  # 100 dB: below it both renderings are exact
        ratio = torch.tensor((gated_error + floor) / (dense_error + floor))
        price = 10.0 * float(torch.log10(ratio))
    return Measured(
        threshold,
        lost_surface / max(surface, 1e-12),
        lost / max(total, 1e-12),
        price,
        skipped / max(candidates, 1),
    )


def is_missed(
    reference: Reference,
    number: int,
    gone: Tensor,
    gated: Tensor,
    truth: Tensor,
    render_kept: Callable[[int, Tensor], Tensor],
) -> Tensor:
    """Which samples lie on rays whose pixel is better rendered with what is lost near surfaces.

    A field that has been trained guided shows haze where the gate skips, which nothing has
    corrected since the gate was frozen; only the photographs can tell it from matter that is
    missed. What the field has repainted on the things behind it they do not miss: a true loss is
    found soon after freezing or not at all.

    Args:
        number: of the chunk of rays.
        gone: [M] bool, skipped.
        gated: [R, 3] rendered without those.
        truth: [R, 3].
        render_kept: as of `measure`.
    Returns:
        [M] bool.
    """
    with_surfaces = render_kept(number, ~gone | reference.near_surface)
    errors = [(image - truth).square().sum(dim=-1) for image in (with_surfaces, gated)]
    return (errors[0] < errors[1])[reference.intervals.ray_indices]


def excesses(
    references: list[Reference],
    truths: list[Tensor],
    render_kept: Callable[[int, Tensor], Tensor],
    threshold: float,
    config: CalibrationConfig,
) -> tuple[Tensor, Tensor]:
    """By how much single rays are beyond the bounds: a mean above 0 is a price that is too high.

    Arguments as for `measure`.

    Returns:
        Lost weight near surfaces, where it is missed, less the share that may be lost; and squared
        error of the gated image less what the bound on the price makes of the dense one's; both
        [R].
    """
    surface, image = [], []
    worse = 10.0 ** (0.1 * config.image_price_db)
    for i, (reference, truth) in enumerate(zip(references, truths)):
        gone = (reference.occupancies < threshold) & ~reference.always_kept
        gated = render_kept(i, ~gone)
        on_surface = reference.weights * reference.near_surface
        missed = is_missed(reference, i, gone, gated, truth, render_kept)
        lost = on_surface * (gone & missed)
        beyond = lost - config.lost_surface_mass * on_surface
        per_ray = beyond.new_zeros(len(truth))
        surface.append(per_ray.index_add_(0, reference.intervals.ray_indices, beyond))
        dense_error = ((reference.rgb - truth) ** 2).sum(dim=-1)
        image.append(((gated - truth) ** 2).sum(dim=-1) - worse * dense_error)
    return torch.cat(surface), torch.cat(image)


def calibrate(
    references: list[Reference],
    truths: list[Tensor],
    render_kept: Callable[[int, Tensor], Tensor],
    config: CalibrationConfig,
    below: float = 1.0,
    missed_only: bool = False,
) -> Measured:
    """The largest threshold of `THRESHOLDS` within the bounds, with what it costs.

    Arguments as for `measure`; only thresholds below `below` are tried. When none is within the
    bounds, the threshold is 0: everything is kept, which is slow and never wrong.
    """
    parts = references, truths, render_kept
    for threshold in (tried for tried in THRESHOLDS if tried < below):
        if not missed_only:
            cheap = measure(*parts, threshold, with_image=False)
            if cheap.lost_surface_mass > config.lost_surface_mass:
                continue
        measured = measure(*parts, threshold, missed_only=missed_only)
        if measured.within(config):
            return measured
    return measure(references, truths, render_kept, 0.0)
