"""From rays to pixels through a Switch-NeRF field: coarse and fine samples, or packed ones."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from leco_plugin.models.compute.dispatch import permute_rows
from leco_plugin.models.losses import balance_loss, expert_shares
from leco_plugin.models.rendering import Answers, Intervals, Rays, Shaded, mapped_middles
from leco_plugin.samplers.packed import render_weight_from_density
from leco_plugin.space import Space

PADDING = 1e-5
"""Added to the weight of each stretch, so that a ray that meets nothing is sampled all over."""


def strata(num_rays: int, count: int, jittered: bool, device: torch.device) -> Tensor:
    """One share in each of `count` equal parts of [0, 1), [num_rays, count] ascending: at random in
    its part if `jittered` (stratified sampling), else in its middle."""
    offsets = torch.rand(num_rays, count, device=device) if jittered else 0.5
    steps = torch.arange(count, dtype=torch.float32, device=device).expand(num_rays, count)
    return (steps + offsets) / count


def spread(t_mins: Tensor, t_maxs: Tensor, shares: Tensor, growing: bool) -> Tensor:
    """Points at shares [R, S] of each ray's way from t_min to t_max, both [R] and positive; if
    `growing`, distances between them grow with distance, as an unbounded scene is marched."""
    starts, ends = t_mins[:, None], t_maxs[:, None]
    if not growing:
        return torch.lerp(starts, ends, shares)
    return starts * (ends / starts) ** shares


def edges_around(points: Tensor, t_mins: Tensor, t_maxs: Tensor) -> Tensor:
    """Edges [R, S + 1], from t_min to t_max, of the stretches that points [R, S] stand for: the
    part of the ray that is nearest to each."""
    between = 0.5 * (points[:, :-1] + points[:, 1:])
    return torch.cat([t_mins[:, None], between, t_maxs[:, None]], dim=-1)


def draw(edges: Tensor, weights: Tensor, shares: Tensor) -> Tensor:
    """Points with the distribution of weights: the inverse of its cumulative sum at given shares.

    Args:
        edges: [R, S + 1] of the stretches.
        weights: [R, S], not negative.
        shares: [R, F] in [0, 1], ascending.
    Returns:
        [R, F] ascending points between the first and the last edge.
    """
    weights = weights + PADDING
    sums = torch.nn.functional.pad(weights.cumsum(dim=-1), (1, 0))
    wanted = shares * sums[:, -1:]
    stretches = (torch.searchsorted(sums, wanted, right=True) - 1).clamp(0, weights.shape[-1] - 1)
    inside = (wanted - sums.gather(1, stretches)) / weights.gather(1, stretches)
    return torch.lerp(
        edges.gather(1, stretches), edges.gather(1, stretches + 1), inside.clamp(0.0, 1.0)
    )


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


def mapped_points(space: Space, rays: Rays, points: Tensor) -> Tensor:
    """Points [R, S] along rays as a field takes them: [R * S, 3] in [-1, 1]."""
    places = points.flatten()
    numbers = torch.arange(len(points), device=points.device)
    at = Intervals(numbers.repeat_interleave(points.shape[1]), places, places)
    return mapped_middles(space, rays, at)


def switch_losses(shaded: Shaded, truth: Tensor, balance: float) -> dict[str, Tensor]:
    """Colour loss, of pixels [R, 3], and weighted balanced gate loss (Switch-NeRF, section 3.3)."""
    losses = {"rgb_loss": torch.nn.functional.mse_loss(shaded.rgb, truth)}
    if balance > 0.0 and len(shaded.routes) > 0:
        probabilities = shaded.logits.softmax(dim=-1)
        losses["gate_loss"] = balance * balance_loss(probabilities, shaded.routes)
    return losses


@torch.no_grad()
def switch_statistics(shaded: Shaded, truth: Tensor) -> dict[str, Tensor]:
    """PSNR of the batch, its number of samples, and the share of points of each expert from 1."""
    error = torch.nn.functional.mse_loss(shaded.rgb, truth)
    figures = {
        "psnr": -10.0 * torch.log10(error.clamp(min=1e-12)),
        "num_samples_per_batch": shaded.packed_info[:, 1].sum().float(),
    }
    shares = expert_shares(shaded.routes, shaded.logits.shape[-1])
    return figures | {f"share_expert_{i + 1}": share for i, share in enumerate(shares)}
