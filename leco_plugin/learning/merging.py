"""Drops scene experts that no region needs, when the gate is frozen.

The expert with the least surface mass is tried first. Its points go to the best remaining expert,
and held-out rays are rendered again. If the image price of all dropped experts is within its bound,
the next expert is tried. The first failure, or the last expert, ends this. The gate does not
change, so o(x) and the skipped space stay the same.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from leco_plugin.learning.calibration import EXACT, price_db
from leco_plugin.learning.dense import evaluating, in_chunks, near_median_depth
from leco_plugin.models.mixture import Mixture
from leco_plugin.models.rendering import Intervals, Rays
from leco_plugin.on_cpu import in_float64
from leco_plugin.scenes.input_error import require


@dataclass(frozen=True)
class MergingConfig:
    """Which scene experts are left when the gate is frozen."""

    image_price_db: float | None = 0.01
    """Largest loss of PSNR on held-out rays for which scene experts are dropped, all together, dB.
    It comes on top of `calibration.image_price_db`, beyond which a price may lie by a standard
    error. None drops none; below 0 the image must gain as much by it."""
    rays: int = 2048
    """Held-out training rays to measure with."""

    def __post_init__(self) -> None:
        price = self.image_price_db
        known = price is None or not math.isnan(price)
        require(known, "merging.image-price-db", price, "a number, or None to drop none")
        require(self.rays >= 1, "merging.rays", self.rays, "at least 1")


class Trial(NamedTuple):
    """What the image loses without some scene experts."""

    expert: int
    """The last that was taken out, in [1, n]."""
    share: float
    """Of the surface mass that it held."""
    price_db: float
    """Of all that had been taken out by then."""


class Merging(NamedTuple):
    """What was tried, in this order."""

    dropped: list[Trial]
    refused: Trial | None
    """None where one expert is left."""


@torch.no_grad()
def find_unneeded(
    mixture: Mixture, rays: Rays, truth: Tensor, bound: float, rays_at_once: int
) -> Merging:
    """Tries scene experts as this module says, for an image price of at most `bound` dB on held-out
    rays, cut to the mixture's region, of pixels [R, 3]; the mixture is left as it was."""
    with evaluating(mixture):
        kept = [
            (some, mixture.with_backdrops(some, mixture.kept(some)))
            for some in in_chunks(rays, rays_at_once)
        ]
        truths = truth.split(rays_at_once)
        experts, reachable = mixture.field.experts, mixture.gate.config.scene_experts
        shares, before = _surface_and_error(mixture, kept, truths)
        out: list[tuple[int, torch.nn.Module]] = []
        dropped: list[Trial] = []
        refused = None
        try:
            while int(experts.left.sum()) > 1 and refused is None:
                held = shares[1:].masked_fill(~experts.left.cpu(), torch.inf)
                held[reachable:] -= 1.0  # what no gate sends points to leaves first
                expert = int(held.argmin()) + 1
                share = float(shares[expert])
                out.append((expert, experts.drop(expert)))
                shares, error = _surface_and_error(mixture, kept, truths)
                trial = Trial(expert, share, price_db(float(error), float(before), EXACT))
                if trial.price_db <= bound:
                    dropped.append(trial)
                else:
                    refused = trial
        finally:
            for expert, module in out:
                experts.put_back(expert, module)
    return Merging(dropped, refused)


def _surface_and_error(
    mixture: Mixture, kept: list[tuple[Rays, Intervals]], truths: Sequence[Tensor]
) -> tuple[Tensor, Tensor]:
    """Share of the surface mass at each expert [1 + n], and the mean squared error of the image."""
    mass = torch.zeros(1 + len(mixture.field.experts.left), dtype=torch.float64)
    error, values = torch.zeros((), dtype=torch.float64), 0
    for (rays, intervals), truth in zip(kept, truths, strict=True):
        shaded = mixture.shade(rays, intervals)
        on_surface = in_float64(shaded.weights * near_median_depth(shaded, intervals))
        mass += torch.bincount(
            shaded.routes.to(on_surface.device), on_surface, minlength=len(mass)
        ).cpu()
        error += in_float64((shaded.rgb - truth).square()).sum().cpu()
        values += truth.numel()
    return mass / mass.sum().clamp(min=1e-12), error / max(values, 1)


def line_of(found: Merging, left: int) -> str:
    """What came out, for the log."""
    parts = []
    if found.dropped:
        names = " and ".join(
            f"{trial.expert} ({trial.share:.1%} of the surface mass)" for trial in found.dropped
        )
        price = found.dropped[-1].price_db
        parts.append(f"dropped: {names}, for {price:+.3f} dB; their points go to those left")
    if found.refused is not None:
        trial = found.refused
        parts.append(
            f"without {trial.expert} ({trial.share:.1%}) the image would lose {trial.price_db:.3f} "
            "dB"
        )
    return f"scene experts: {left} left; " + "; ".join(parts)
