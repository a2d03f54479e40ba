"""What candidates along rays are worth, and what skipping some of them loses.

With an original, only the candidates that it keeps are worth anything: the reference is the
rendering that it guides. What a smaller gate loses then comes on top of the original's own loss.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import accumulate
from typing import NamedTuple

import torch
from torch import Tensor

from leco_plugin.capacity.sources import Seen
from leco_plugin.evaluation.inspection import in_parts
from leco_plugin.learning.calibration import EXACT, price_db
from leco_plugin.learning.dense import in_chunks, near_surface, weights_by_ray
from leco_plugin.models.mixture import Mixture
from leco_plugin.models.rendering import Intervals, Rays, backdrop_of
from leco_plugin.occupancy import Occupancy
from leco_plugin.samplers import marching
from leco_plugin.samplers.base import midpoints
from leco_plugin.scenes.learning_data import on_black

RAYS_AT_ONCE = 1024
UNLIKELY = 0.01
"""How often the true share may lie above the declared one."""


class Evidence(NamedTuple):
    """Candidates of some rays, without backdrops, on the CPU or the occupancy's device."""

    positions: Tensor
    """[M, 3] scene units."""
    ray_indices: Tensor
    """[M] int64."""
    kept: Tensor
    """[M] bool, by the original."""
    weights: Tensor
    """[M] rendering weights under the original's guidance, zero where it skips; o(x) where there is
    no model."""
    worth: Tensor
    """[M] the same near surfaces, zero elsewhere: lost surface mass is counted in it."""
    rays: int


class Rendered(NamedTuple):
    """What is needed to render some rays again with fewer samples."""

    rays: Rays
    intervals: Intervals
    """Kept by the original, with backdrops."""
    before_backdrop: Tensor
    """[K] bool."""
    rgb: Tensor
    """[R, 3] with all of them."""
    truth: Tensor
    """[R, 3]."""


class Loss(NamedTuple):
    """What skipping costs on one set of rays."""

    share: float
    """Of the worth of all candidates."""
    bound: float
    """Upper bound of that share on other rays of the scene."""
    lost_mass: float
    """Share of all rendering weight before the backdrop, haze included."""


def worst(losses: Iterable[Loss]) -> Loss:
    """The largest of each figure."""
    return Loss(*map(max, zip(*losses)))


@torch.no_grad()
def gather(
    mixture: Mixture | None, occupancy: Occupancy | None, seen: Seen
) -> tuple[Evidence, list[Rendered]]:
    """The candidates of some rays with their worth, all kept where there is no original; and their
    renderings if there is a model."""
    chunks, truths = in_chunks(seen.rays, RAYS_AT_ONCE), seen.truth.split(RAYS_AT_ONCE)
    if mixture is None:
        assert occupancy is not None
        return join([_by_decisions(occupancy, rays) for rays in chunks]), []
    pairs = zip(chunks, map(on_black, truths))
    pieces, rendered = zip(*(_by_rendering(mixture, occupancy, *pair) for pair in pairs))
    return join(pieces), [*rendered]


def join(pieces: Sequence[Evidence]) -> Evidence:
    """Several batches of rays as one, their rays numbered through."""
    before = [0, *accumulate(piece.rays for piece in pieces)]
    shifted = [p._replace(ray_indices=p.ray_indices + n) for p, n in zip(pieces, before)]
    *tensors, _ = zip(*shifted)
    return Evidence._make([*map(torch.cat, tensors), before[-1]])


def _by_rendering(
    mixture: Mixture, occupancy: Occupancy | None, rays: Rays, truth: Tensor
) -> tuple[Evidence, Rendered]:
    intervals = mixture.with_backdrops(rays, mixture.candidates(rays))
    positions = midpoints(intervals, *rays[:2])
    is_backdrop = backdrop_of(intervals, rays)
    kept = ~is_backdrop
    if occupancy is not None:
        kept &= occupancy.occupied(positions)
    drawn = kept | is_backdrop
    guided = Intervals(*(part[drawn] for part in intervals))
    shaded = mixture.shade(rays, guided)
    weights = torch.zeros_like(intervals.t_starts)
    weights[drawn] = shaded.weights.float()
    surface = torch.zeros_like(kept)
    surface[drawn] = near_surface(*weights_by_ray(shaded), guided, is_backdrop[drawn])
    per_candidate = (positions, intervals.ray_indices, kept, weights, weights * surface)
    evidence = Evidence._make([*(x[~is_backdrop] for x in per_candidate), len(rays.origins)])
    return evidence, Rendered(rays, guided, ~is_backdrop[drawn], shaded.rgb, truth)


def _by_decisions(occupancy: Occupancy, rays: Rays) -> Evidence:
    """Without a field: every candidate that the original keeps, weighed by o(x)."""
    report = occupancy.report
    rule = marching.March(float(report["step_size"]), float(report.get("cone_angle", 0.0)))
    intervals = Intervals(*marching.march(marching.Rays(*rays[:4]), rule))
    positions = midpoints(intervals, *rays[:2])
    values = in_parts(occupancy.query, positions)
    kept = values >= occupancy.threshold_value
    worth = values * kept
    return Evidence(positions, intervals.ray_indices, kept, worth, worth, len(rays.origins))


def find_skipped(occupancy: Occupancy, evidence: Evidence) -> Tensor:
    """Which candidates an occupancy skips: bool [M]."""
    return in_parts(occupancy.query, evidence.positions) < occupancy.threshold


def unlikely_at(look: int) -> float:
    """How often the bound of the k-th look at the same rays may be wrong; all add to `UNLIKELY`."""
    return UNLIKELY / (look * (look + 1))


def loss(evidence: Evidence, skipped: Tensor, unlikely: float = UNLIKELY) -> Loss:
    """The share of the worth that is skipped, and Bernstein's bound of a ratio of sums over rays.

    Rays count by their worth: n = (sum worth)^2 / sum worth^2, so that a ray of sky is no evidence.
    A loss that no ray has seen has no spread. The error therefore includes a few more lost rays of
    average worth: without any loss the bound is log(1 / unlikely) / n, which n rays do exclude. It
    may be wrong as often as is `unlikely`.
    """
    lost_all, all_weight = (float((evidence.weights * m).sum()) for m in (skipped, 1.0))
    lost_mass = lost_all / max(all_weight, 1e-12)
    lost, worth = (
        torch.bincount(evidence.ray_indices, values.double(), evidence.rays)
        for values in (evidence.worth * skipped, evidence.worth)
    )
    total = float(worth.sum())
    if total == 0.0:  # nothing is known
        return Loss(0.0, 1.0, lost_mass)
    share = float(lost.sum()) / total
    one_ray = float(worth.square().sum()) / total**2
    nepers = math.log(1.0 / unlikely)
    unseen = 2.0 / 9.0 * nepers * one_ray**2
    spread = float((lost - share * worth).square().sum()) / total**2
    bound = share + math.sqrt(2.0 * nepers * (spread + unseen)) + nepers / 3.0 * one_ray
    return Loss(share, bound, lost_mass)


@torch.no_grad()
def image_price(mixture: Mixture, rendered: Sequence[Rendered], smaller: Occupancy) -> float:
    """PSNR with what the original keeps minus that with what both keep, in dB."""
    before, after, pixels = 0.0, 0.0, 0
    for one in rendered:
        both = smaller.occupied(midpoints(one.intervals, *one.rays[:2])) | ~one.before_backdrop
        rgb = mixture.shade(one.rays, Intervals(*(part[both] for part in one.intervals))).rgb
        before += float((one.rgb - one.truth).square().sum(dtype=torch.float64))
        after += float((rgb - one.truth).square().sum(dtype=torch.float64))
        pixels += one.truth.numel()
    return price_db(after, before, EXACT * max(pixels, 1))
