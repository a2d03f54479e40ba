"""Held-out rays rendered with all their candidates: the reference for each price of skipping."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

import torch
from torch import Tensor, nn

from leco_plugin.models.gate import occupancy_from_logits
from leco_plugin.models.mixture import Mixture
from leco_plugin.models.rendering import Intervals, Rays, Shaded, backdrop_of, mapped_middles
from leco_plugin.samplers.packed import accumulate_along_rays, inclusive_sum

SURFACE_STEPS = 2.0
"""Weight within this many steps of a ray's median depth counts as surface, the rest as haze. Of a
ray whose median depth lies in the backdrop, all of it is haze."""
FEWEST_SURFACES = 0.02
"""Share of the rays that meet a surface by that rule; with fewer, haze counts too, so that a field
that has not found its surfaces yet does not pass for one that has nothing to lose."""


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

    @property
    def surface_weights(self) -> Tensor:
        """[M] the weights near surfaces, 0 elsewhere."""
        return self.weights * self.near_surface

    def skipped(self, threshold: float) -> Tensor:
        """[M] bool: what skipping below a threshold leaves out."""
        return (self.occupancies < threshold) & ~self.always_kept


def reference_of(shaded: Shaded, intervals: Intervals, rays: Rays) -> Reference:
    """The reference made of a rendering of all candidates of rays."""
    is_backdrop = backdrop_of(intervals, rays)
    return Reference(
        intervals,
        shaded.weights,
        occupancy_from_logits(shaded.logits),
        near_surface(*weights_by_ray(shaded), intervals, is_backdrop),
        shaded.rgb,
        is_backdrop,
    )


def weights_by_ray(shaded: Shaded) -> tuple[Tensor, Tensor, Tensor]:
    """Rendering weights [M], their sums [R], and start and count of each ray [R, 2]."""
    return shaded.weights, shaded.accumulation, shaded.packed_info


def near_surface(
    weights: Tensor,
    accumulation: Tensor,
    packed_info: Tensor,
    intervals: Intervals,
    is_backdrop: Tensor,
) -> Tensor:
    """Which samples lie within `SURFACE_STEPS` steps of their ray's surface: [M] bool.

    A ray whose median depth lies in the backdrop has no surface, unless fewer than
    `FEWEST_SURFACES` of the rays have one. Thin things before the sky have less than half of their
    ray's weight: the image price alone guards them.

    Args:
        weights, accumulation, packed_info: see `weights_by_ray`.
        is_backdrop: [M] bool.
    """
    if len(is_backdrop) == 0:
        return is_backdrop
    medians = _medians(weights, accumulation, packed_info, intervals)
    meets = ~is_backdrop[medians] & (packed_info[:, 1] > 0)
    if int(meets.sum()) < FEWEST_SURFACES * len(meets):
        meets = torch.ones_like(meets)
    return _near(medians, intervals) & meets[intervals.ray_indices]


def near_median_depth(shaded: Shaded, intervals: Intervals) -> Tensor:
    """Which samples lie within `SURFACE_STEPS` steps of the depth that halves their ray's weight:
    [M] bool."""
    return _near(_medians(*weights_by_ray(shaded), intervals), intervals)


def _near(medians: Tensor, intervals: Intervals) -> Tensor:
    median = medians[intervals.ray_indices]
    middles = 0.5 * (intervals.t_starts + intervals.t_ends)
    steps = (intervals.t_ends - intervals.t_starts)[median]
    return (middles - middles[median]).abs() <= SURFACE_STEPS * steps * 1.001


def _medians(
    weights: Tensor, accumulation: Tensor, packed_info: Tensor, intervals: Intervals
) -> Tensor:
    """The sample of each ray that halves its weight: [R], any for a ray without samples."""
    below_half = (
        inclusive_sum(weights, packed_info=packed_info) < 0.5 * accumulation[intervals.ray_indices]
    )
    ahead = accumulate_along_rays(
        below_half.float(), None, intervals.ray_indices, len(packed_info)
    )[:, 0].long()
    starts, counts = packed_info.unbind(dim=-1)
    median = starts + torch.minimum(ahead, (counts - 1).clamp(min=0))
    return median.clamp(max=max(len(weights) - 1, 0))


class DenseRendering(NamedTuple):
    """Held-out rays in chunks, rendered densely, and a way to render them with less."""

    references: list[Reference]
    truths: list[Tensor]
    """True pixels, [R, 3] each."""
    render_kept: Callable[[int, Tensor], Tensor]
    """The colours [R, 3] of a chunk, by its number, from the samples of a bool mask [M] alone."""


@contextmanager
def evaluating(model: nn.Module) -> Iterator[None]:
    """A module in evaluation mode for a while; then in the mode that it was in."""
    was_training = model.training
    model.eval()
    try:
        yield
    finally:
        model.train(was_training)


def dense_reference(mixture: Mixture, rays: Rays) -> Reference:
    """All candidates of some rays rendered, as the reference that skipping is measured against."""
    intervals = mixture.with_backdrops(rays, mixture.candidates(rays))
    reference = reference_of(mixture.shade(rays, intervals), intervals, rays)
    if mixture.small is None or mixture.scene().gate is mixture.small:
        return reference  # the gate that skips has answered
    mapped = mapped_middles(mixture.region.space, rays, intervals)
    return reference._replace(occupancies=mixture.occupancies(mapped))


@torch.no_grad()
def dense_rendering(
    mixture: Mixture,
    rays: Rays,
    truth: Tensor,
    rays_at_once: int,
    refer: Callable[[Mixture, Rays], Reference] = dense_reference,
) -> DenseRendering:
    """All candidates of rays, cut to the mixture's region, rendered in chunks, with their true
    colours [R, 3]; `refer` makes the reference of a chunk."""
    chunks = in_chunks(rays, rays_at_once)
    references = [refer(mixture, chunk) for chunk in chunks]

    @torch.no_grad()  # it is called later
    def render_kept(number: int, mask: Tensor) -> Tensor:
        kept = Intervals(*(part[mask] for part in references[number].intervals))
        return mixture.shade(chunks[number], kept).rgb

    return DenseRendering(references, list(truth.split(rays_at_once)), render_kept)


def in_chunks(rays: Rays, at_once: int) -> list[Rays]:
    """Rays, so many at a time; of none an empty part."""
    return [
        Rays._make(None if part is None else part[first : first + at_once] for part in rays)
        for first in range(0, max(1, len(rays.origins)), at_once)
    ]
