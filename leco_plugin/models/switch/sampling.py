"""Coarse and fine samples along rays (NeRF, section 5.2), as points and the stretches around them.

All tensors are batched, [R, S], in scene units; a ray of no length has all its points in one place.
"""

from __future__ import annotations

import torch
from torch import Tensor

PADDING = 1e-5
"""Added to the weight of each stretch, so that a ray that meets nothing is sampled all over."""


def strata(num_rays: int, count: int, jittered: bool, device: torch.device) -> Tensor:
    """One share in each of `count` equal parts of [0, 1), [num_rays, count] ascending.

    Args:
        jittered: at random in its part (stratified sampling), else in its middle.
    """
    offsets = torch.rand(num_rays, count, device=device) if jittered else 0.5
    steps = torch.arange(count, dtype=torch.float32, device=device).expand(num_rays, count)
    return (steps + offsets) / count


def spread(t_mins: Tensor, t_maxs: Tensor, shares: Tensor, growing: bool) -> Tensor:
    """Points at shares [R, S] of each ray's way from t_min to t_max, both [R] and positive.

    Args:
        growing: distances between points grow with distance, as an unbounded scene is marched.
    """
    starts, ends = t_mins[:, None], t_maxs[:, None]
    if not growing:
        return torch.lerp(starts, ends, shares)
    return starts * (ends / starts) ** shares


def edges_around(points: Tensor, t_mins: Tensor, t_maxs: Tensor) -> Tensor:
    """The stretch that each point [R, S] stands for: the part of the ray that is nearest to it.

    Returns:
        [R, S + 1] edges, from t_min to t_max.
    """
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
