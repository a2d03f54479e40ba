"""From rays to pixels through a Switch-NeRF field: coarse and fine samples, or packed ones."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from leco_plugin.models.color_head import ColorHead
from leco_plugin.models.compute.rows import permute_rows
from leco_plugin.models.rendering import (
    Intervals,
    Rays,
    Shaded,
    backdrop_of,
    composite,
    mapped_middles,
    sum_up,
    weigh,
)
from leco_plugin.models.switch.field import Answers
from leco_plugin.models.switch.sampling import draw, edges_around, spread, strata
from leco_plugin.samplers.base import densities_of_samples
from leco_plugin.samplers.packed import render_weight_from_density
from leco_plugin.space import Space

Ask = Callable[[Tensor], Answers]
"""What a field says of mapped positions [N, 3]."""


def coarse_and_fine(
    ask: Ask,
    space: Space,
    rays: Rays,
    stops: Tensor,
    counts: tuple[int, int],
    growing: bool,
    jittered: bool,
) -> tuple[Intervals, Answers]:
    """Spreads coarse samples, draws fine ones by their weights, and joins the two.

    One field answers for both and each point is asked once: fine samples stand between coarse
    ones, as in Switch-NeRF, and each stands for the stretch that is nearest to it.

    Args:
        stops: [R] where these samples end; one more follows in the middle of what is left of the
            ray, its backdrop.
        counts: coarse and fine samples of a ray.
        growing: distances between coarse samples grow with distance.
        jittered: stratified sampling.
    Returns:
        Intervals of all rays, as many on each, and what the field says of them.
    """
    num_rays, device = len(rays.origins), rays.origins.device
    num_coarse, num_fine = counts
    shares = strata(num_rays, num_coarse, jittered, device)
    coarse = spread(rays.t_mins, stops, shares, growing)
    last = 0.5 * (stops + rays.t_maxs)[:, None]
    of_coarse = ask(mapped_points(space, rays, torch.cat([coarse, last], dim=-1)))
    with torch.no_grad():
        edges = edges_around(coarse, rays.t_mins, stops)
        scaled = edges / space.half_extent
        sigmas = of_coarse.sigmas.view(num_rays, num_coarse + 1)[:, :-1]
        weights, _, _ = render_weight_from_density(scaled[:, :-1], scaled[:, 1:], sigmas)
        fine = draw(edges, weights, strata(num_rays, num_fine, jittered, device))
    of_fine = ask(mapped_points(space, rays, fine))
    points, order = torch.cat([coarse, last, fine], dim=-1).sort(dim=-1, stable=True)
    edges = edges_around(points[:, :-1], rays.t_mins, stops)
    numbers = torch.arange(num_rays, device=device).repeat_interleave(points.shape[1])
    ends = torch.cat([edges[:, 1:], rays.t_maxs[:, None]], dim=-1)
    intervals = Intervals(numbers, edges.flatten(), ends.flatten())
    return intervals, _in_order(of_coarse, of_fine, order, num_coarse + 1)


def _in_order(first: Answers, second: Answers, order: Tensor, num_first: int) -> Answers:
    """Answers of two batches, along each ray in the order [R, S] of their points together."""
    num_rays, together = order.shape
    numbers = torch.arange(num_rays, device=order.device)[:, None]
    of_second = num_rays * num_first + numbers * (together - num_first) + order - num_first
    rows = torch.where(order < num_first, numbers * num_first + order, of_second).flatten()
    back = torch.empty_like(rows).scatter_(0, rows, torch.arange(len(rows), device=rows.device))
    sigmas, features, logits, routes = (torch.cat(parts) for parts in zip(first, second))
    return Answers(
        sigmas.index_select(0, rows),
        permute_rows(features, rows, back),
        permute_rows(logits, rows, back),
        routes.index_select(0, rows),
    )


def kept_by(
    estimator: Any,
    rays: Rays,
    step_size: float,
    cone_angle: float,
    jittered: bool,
    density_fn: Callable[[Tensor], Tensor] | None,
    early_stop_eps: float,
) -> Intervals:
    """What an estimator keeps of the candidates along rays.

    Args:
        estimator: anything with nerfacc's `sampling`.
        step_size, cone_angle: of the march.
        jittered: stratified sampling.
        density_fn: scene positions [N, 3] to densities per scene unit [N, 1]; None asks none.
        early_stop_eps: transmittance below which a sample is left out.
    """
    sigma_fn = None
    if density_fn is not None:
        sigma_fn = densities_of_samples(density_fn, rays.origins, rays.directions)
    return Intervals(
        *estimator.sampling(
            rays.origins,
            rays.directions,
            sigma_fn=sigma_fn,
            t_min=rays.t_mins,
            t_max=rays.t_maxs,
            render_step_size=step_size,
            early_stop_eps=early_stop_eps,
            stratified=jittered,
            cone_angle=cone_angle,
        )
    )


def mapped_points(space: Space, rays: Rays, points: Tensor) -> Tensor:
    """Points [R, S] along rays as a field takes them: [R * S, 3] in [-1, 1]."""
    places = points.flatten()
    numbers = torch.arange(len(points), device=points.device)
    at = Intervals(numbers.repeat_interleave(points.shape[1]), places, places)
    return mapped_middles(space, rays, at)


def render(
    color: ColorHead, answers: Answers, rays: Rays, intervals: Intervals, half_extent: Tensor
) -> Shaded:
    """Pixels of packed intervals; the backdrop gives its colour and counts as nothing met.

    Args:
        half_extent: scalar, scene units.
    """
    is_backdrop = backdrop_of(intervals, rays)
    weights, packed_info = weigh(
        answers.sigmas, is_backdrop, intervals, half_extent, len(rays.origins)
    )
    rgb = composite(color, answers.features, weights, rays, intervals)
    met = weights.masked_fill(is_backdrop, 0.0)
    accumulation, depth = sum_up(met, rays, intervals)
    sigmas, _, logits, routes = answers
    return Shaded(rgb, accumulation, depth, met, sigmas, logits, routes, packed_info)
