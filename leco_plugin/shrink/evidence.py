"""What candidates along rays are worth: evidence that a smaller gate is taught by and measured on.

Only what the original keeps has a worth: the reference is the rendering that it guides. What a
smaller gate loses comes on top of what the original has lost already.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from leco_plugin.learning.calibration import near_surface
from leco_plugin.models.leco import LecoModel
from leco_plugin.models.rendering import Intervals, Rays, backdrop_of
from leco_plugin.occupancy import Occupancy
from leco_plugin.samplers import marching
from leco_plugin.samplers.marching import March, march
from leco_plugin.shrink.sources import Seen, Source

RAYS_AT_ONCE = 1024
POINTS_AT_ONCE = 1 << 16


class Evidence(NamedTuple):
    """Candidates of some rays, backdrops left out, on the CPU or the occupancy's device."""

    positions: Tensor
    """[M, 3] scene units."""
    ray_indices: Tensor
    """[M] int64."""
    kept: Tensor
    """[M] bool, by the original."""
    weights: Tensor
    """[M] rendering weights under the original's guidance, or o(x) where nothing renders; zero for
    what it skips."""
    worth: Tensor
    """[M] the same near surfaces, zero elsewhere: what lost surface mass is counted in."""
    rays: int


class Rendered(NamedTuple):
    """What it takes to render some rays again with fewer samples."""

    rays: Rays
    intervals: Intervals
    """Kept by the original, backdrops among them."""
    before_backdrop: Tensor
    """[K] bool."""
    rgb: Tensor
    """[R, 3] with all of them."""
    truth: Tensor
    """[R, 3]."""


@torch.no_grad()
def gather(
    source: Source, occupancy: Occupancy | None, seen: Seen
) -> tuple[Evidence, list[Rendered]]:
    """The candidates of some rays with their worth; no renderings where there is no model.

    Args:
        occupancy: the original; None keeps every candidate, for a model that was trained on all.
    """
    pieces, rendered = [], []
    for first in range(0, len(seen.truth), RAYS_AT_ONCE):
        part = slice(first, first + RAYS_AT_ONCE)
        rays = Rays._make(None if value is None else value[part] for value in seen.rays)
        if source.model is None:
            assert occupancy is not None
            piece = _by_decisions(occupancy, rays)
        else:
            truth = source.model.renderer_rgb.blend_background(seen.truth[part])
            piece, again = _by_rendering(source.model, occupancy, rays, truth)
            rendered.append(again)
        pieces.append(piece)
    return join(pieces), rendered


def join(pieces: Sequence[Evidence]) -> Evidence:
    """Evidence of several batches of rays, numbered through."""
    before, ray_indices = 0, []
    for piece in pieces:
        ray_indices.append(piece.ray_indices + before)
        before += piece.rays
    return Evidence(
        torch.cat([piece.positions for piece in pieces]),
        torch.cat(ray_indices),
        torch.cat([piece.kept for piece in pieces]),
        torch.cat([piece.weights for piece in pieces]),
        torch.cat([piece.worth for piece in pieces]),
        before,
    )


def middles(rays: Rays, intervals: Intervals) -> Tensor:
    """Middles of packed intervals: [M, 3] scene units."""
    ray_indices, t_starts, t_ends = intervals
    along = 0.5 * (t_starts + t_ends)
    return rays.origins[ray_indices] + rays.directions[ray_indices] * along[:, None]


def _by_rendering(
    model: LecoModel, occupancy: Occupancy | None, rays: Rays, truth: Tensor
) -> tuple[Evidence, Rendered]:
    intervals = model.intervals_of(rays, guided=False, learning=False)
    positions = middles(rays, intervals)
    is_backdrop = backdrop_of(intervals, rays)
    kept = ~is_backdrop
    if occupancy is not None:
        kept &= occupancy.occupied(positions)
    guided = Intervals(*(part[kept | is_backdrop] for part in intervals))
    shaded = model.shade(rays, guided)
    weights = torch.zeros_like(intervals.t_starts)
    weights[kept | is_backdrop] = shaded.weights.float()
    surface = torch.zeros_like(kept)
    surface[kept | is_backdrop] = near_surface(shaded, guided, is_backdrop[kept | is_backdrop])
    before = ~is_backdrop
    weights = weights[before]
    evidence = Evidence(
        positions[before],
        intervals.ray_indices[before],
        kept[before],
        weights,
        weights * surface[before],
        len(rays.origins),
    )
    return evidence, Rendered(rays, guided, ~is_backdrop[kept | is_backdrop], shaded.rgb, truth)


def _by_decisions(occupancy: Occupancy, rays: Rays) -> Evidence:
    """Without a field: every candidate that the original keeps, weighed by o(x)."""
    report = occupancy.report
    rule = March(float(report["step_size"]), float(report.get("cone_angle", 0.0)))
    intervals = Intervals(*march(marching.Rays(*rays[:4]), rule))
    positions = middles(rays, intervals)
    values = query_in_parts(occupancy, positions)
    kept = values >= occupancy.threshold_value
    worth = values * kept
    return Evidence(positions, intervals.ray_indices, kept, worth, worth, len(rays.origins))


@torch.no_grad()
def query_in_parts(occupancy: Occupancy, positions: Tensor) -> Tensor:
    """o(x) of positions [M, 3], some at a time: [M]."""
    return torch.cat([occupancy.query(part) for part in positions.split(POINTS_AT_ONCE)])


def skipped_by(occupancy: Occupancy, evidence: Evidence) -> Tensor:
    """Which candidates an occupancy skips: bool [M]."""
    return query_in_parts(occupancy, evidence.positions) < occupancy.threshold


class Loss(NamedTuple):
    """What skipping costs beyond the original, on one set of rays."""

    share: float
    """Of the worth of all candidates."""
    bound: float
    """One that the share on other rays of the scene stays below, but for the allowed few times."""
    lost_mass: float
    """Share of all rendering weight before the backdrop, haze included."""


UNLIKELY = 0.01
"""How often what is declared may lie below the share on other rays of the scene."""


def unlikely_at(look: int) -> float:
    """How often the bound of the k-th look at the same rays may be wrong; all add to `UNLIKELY`."""
    return UNLIKELY / (look * (look + 1))


def loss(evidence: Evidence, skipped: Tensor, unlikely: float = UNLIKELY) -> Loss:
    """The share of the worth that is skipped, and Bernstein's bound of a ratio of sums over rays.

    Rays count by what they are worth: n = (sum worth)^2 / sum worth^2, so that a ray of sky is no
    evidence. A loss that no ray has seen yet has no spread: the error is reckoned as if a few more
    rays of average worth were lost, so many that without any loss the bound is
    log(1 / unlikely) / n, which n rays without one do exclude.

    Args:
        skipped: bool [M].
        unlikely: how often the bound may be wrong.
    """
    lost_all, all_weight = (float((evidence.weights * m).sum()) for m in (skipped, 1.0))
    lost_mass = lost_all / max(all_weight, 1e-12)
    lost, worth = (
        torch.zeros(evidence.rays, dtype=torch.float64, device=evidence.worth.device).index_add_(
            0, evidence.ray_indices, values.double()
        )
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


def image_price(model: LecoModel, rendered: Sequence[Rendered], smaller: Occupancy) -> float:
    """PSNR with what the original keeps minus that with what both keep, in dB."""
    before = after = 0.0
    pixels = 0
    with torch.no_grad():
        for one in rendered:
            both = smaller.occupied(middles(one.rays, one.intervals)) | ~one.before_backdrop
            fewer = Intervals(*(part[both] for part in one.intervals))
            rgb = model.shade(one.rays, fewer).rgb
            before += float((one.rgb - one.truth).square().sum(dtype=torch.float64))
            after += float((rgb - one.truth).square().sum(dtype=torch.float64))
            pixels += one.truth.numel()
    floor = 1e-10 * max(pixels, 1)
    return 10.0 * math.log10((after + floor) / (before + floor))
