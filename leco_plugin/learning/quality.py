"""Whether what was learned is worth anything: two lines say so where it is not."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from leco_plugin.evaluation.metrics import psnr
from leco_plugin.learning.calibration import in_decibels
from leco_plugin.log import by_number, counted
from leco_plugin.occupancy import CAMERAS_THAT_VOUCH
from leco_plugin.on_cpu import in_float64

if TYPE_CHECKING:
    from leco_plugin.models.mixture import Mixture

MOST_KEPT = 0.8
"""Share of the space that photographs show which an occupancy of use keeps at most."""
LEAST_GAIN_DB = 1.0
"""PSNR by which a field that has learned something is above one colour for all pixels."""
FIELD, ONE_COLOUR = "field_psnr_db", "one_colour_psnr_db"
"""Names in a report: PSNR on the calibration rays, of the field and of their mean colour."""
AT_END = "at_end"
"""Name in the report that a run leaves: the same two at its end, on test photographs if it has any;
they overrule those of freezing."""
PLACES = 1 << 14
"""Random positions at which the kept share is measured."""


def psnr_of_one_colour(truth: Tensor) -> float:
    """PSNR of the mean colour of pixels [R, 3] against them, dB; 120 where all are alike."""
    return psnr(truth.mean(dim=0), truth)


@torch.no_grad()
def kept_of_seen(mixture: Mixture, threshold: float | None = None) -> float:
    """Share of the space that training rays cross which a frozen mixture keeps, at another
    threshold if one is given; 0 where they cross none."""
    generator = torch.Generator().manual_seed(0)
    mapped = torch.rand(PLACES, 3, generator=generator).to(mixture.device) * 2.0 - 1.0
    if mixture.region.space.kind == "contraction":
        mapped *= 0.5  # the inner cube: beyond it, little is seen of much
    mapped = mapped[mixture.region.seen(mapped)]
    if len(mapped) == 0:
        return 0.0
    kept = mixture.occupancies(mapped) >= (mixture.threshold if threshold is None else threshold)
    return float(in_float64(kept).mean())


def price_in_words(report: dict[str, Any]) -> list[str]:
    """What an occupancy's report says that skipping brings and costs: a line, or none where it does
    not say it."""
    names = "empty_fraction", "image_price_db", "lost_surface_mass"
    skipped, price, lost = (report.get(name) for name in names)
    if skipped is None or price is None or lost is None:
        return []
    return [
        f"skips {skipped:.1%} of the candidates along rays, for {in_decibels(price)} and "
        f"{lost:.2%} of the surfaces, on the rays of its calibration"
    ]


def views_in_words(report: dict[str, Any]) -> str:
    """What an occupancy's report says of whole views: a line."""
    said = report.get(CAMERAS_THAT_VOUCH)
    if not isinstance(said, dict):
        return "calibrated on pixels of training photographs alone: new views may lose more"
    lose = by_number(said["count"], "loses", "lose")
    of_their = by_number(said["count"], "its", "their")
    photographs = counted(said["count"], "photograph")
    at_most = f"{lose} at most {said['worst_surface_mass']:.2%} of {of_their} surfaces"
    if said["confidence"] is None:
        return f"{photographs} {at_most}; now they teach it too, and new views may lose more"
    return (
        f"{photographs} that taught it nothing {at_most}: a new view loses at most "
        f"{said['bound']:.2%}, with {said['confidence']:.0%} confidence"
    )


def doubts_of_field(field: float, one_colour: float) -> list[str]:
    """Two lines on a field that shows hardly more than one colour, by PSNR of both on the same
    held-out pixels, dB; none on a good one, or where PSNR is not finite."""
    known = math.isfinite(field) and math.isfinite(one_colour)
    if not known or field >= one_colour + LEAST_GAIN_DB:
        return []
    return [
        f"this scene was not learned: {field:.1f} dB on unseen pixels, where one colour "
        f"for all has {one_colour:.1f} dB",
        "what helps: more photographs, poses that fit them (`leco poses PHOTOS --out SCENE`), or "
        "sparse points where the scene has none (`leco points SCENE`)",
    ]


def doubts_of_occupancy(kept: float) -> list[str]:
    """Two lines on an occupancy that keeps nearly everything, by the share that it keeps of what
    photographs show; none on one of use."""
    if kept <= MOST_KEPT:
        return []
    return [
        f"this occupancy is of little use: it keeps {kept:.0%} of the space that photographs show",
        "what helps: more photographs, more steps of learning (schedule.learn-steps), or sparse "
        "points where the scene has none (`leco points SCENE`)",
    ]
