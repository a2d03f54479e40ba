"""Intervals along rays, packed: what is in order, what is covered, which are the same."""

from __future__ import annotations

import torch
from torch import Tensor

from leco_plugin.conformance.kit.scene import STEP, Rays, box
from leco_plugin.conformance.rule import Broken, require
from leco_plugin.samplers.base import DenseEstimator
from leco_plugin.samplers.marching import Samples

PARTS = ("ray_indices", "t_starts", "t_ends")
"""Of packed samples, in this order."""

ROUNDING = 1e-4
"""World units that two ways to compute an edge may differ by."""


def dense(rays: Rays, cone_angle: float = 0.0) -> Samples:
    """Every candidate in the box, by the one ray-marching rule."""
    return DenseEstimator(box()).sampling(
        rays.origins,
        rays.directions,
        t_min=rays.t_min,
        t_max=rays.t_max,
        render_step_size=STEP,
        cone_angle=cone_angle,
    )


def by_ray(samples: Samples) -> Samples:
    """Samples with rays in order; the samples of a ray stay in theirs."""
    order = samples[0].argsort(stable=True)
    ray_indices, t_starts, t_ends = (part[order] for part in samples)
    return ray_indices, t_starts, t_ends


def in_order(samples: Samples) -> Samples:
    """Samples sorted by ray, then by where they begin."""
    order = _keys(samples[0], samples[1]).argsort()
    ray_indices, t_starts, t_ends = (part[order] for part in samples)
    return ray_indices, t_starts, t_ends


def among(wanted: Samples, samples: Samples, tolerance: float = 1e-3 * STEP) -> Tensor:
    """Which of the wanted samples are there, with both ends within a tolerance: bool [n_wanted]."""
    if len(samples[0]) == 0:
        return torch.zeros_like(wanted[0], dtype=torch.bool)
    keys, order = _keys(samples[0], samples[1]).sort()
    ends = samples[2][order]
    sought = _keys(wanted[0], wanted[1])
    at = torch.searchsorted(keys, sought - tolerance).clamp(max=len(keys) - 1)
    return ((keys[at] - sought).abs() <= tolerance) & ((ends[at] - wanted[2]).abs() <= tolerance)


def covered(ray_indices: Tensor, t: Tensor, samples: Samples) -> Tensor:
    """Which points (ray, t) [N] lie in a sample's interval: bool [N]."""
    if len(samples[0]) == 0:
        return torch.zeros_like(ray_indices, dtype=torch.bool)
    keys, order = _keys(samples[0], samples[1]).sort()
    rays, ends = samples[0][order], samples[2][order]
    at = (torch.searchsorted(keys, _keys(ray_indices, t), right=True) - 1).clamp(min=0)
    return (rays[at] == ray_indices) & (ends[at] >= t) & (keys[at] <= _keys(ray_indices, t))


def same(first: Samples, second: Samples) -> bool:
    """Whether two sets of samples are equal to the last bit."""
    return all(map(torch.equal, first, second))


def check_intervals(rays: Rays, samples: Samples) -> None:
    """Raises unless samples are sorted and disjoint along each ray, and inside its ends."""
    check_order(samples)
    check_inside(rays, samples)


def check_order(samples: Samples) -> None:
    """Raises unless samples follow one another along each ray."""
    require(len(samples[0]) > 0, "there are no samples on rays that cross what is occupied")
    _, t_starts, t_ends = samples = by_ray(samples)
    _hold(t_ends > t_starts, samples, "does not end behind its beginning")
    follows = torch.ones_like(t_starts, dtype=torch.bool)
    follows[1:] = t_starts[1:] >= t_ends[:-1] - ROUNDING
    follows[1:] |= samples[0][1:] != samples[0][:-1]
    _hold(follows, samples, "overlaps the one before it, or lies before it")


def check_inside(rays: Rays, samples: Samples) -> None:
    """Raises unless samples begin and have their middles between the ends of their rays."""
    ray_indices, t_starts, t_ends = samples
    begins = t_starts >= rays.t_min[ray_indices] - ROUNDING
    _hold(begins, samples, "begins before the ray's near end")
    ends = (t_starts + t_ends) / 2.0 <= rays.t_max[ray_indices] + ROUNDING
    _hold(ends, samples, "has its middle beyond the ray's far end")


def _hold(holds: Tensor, samples: Samples, problem: str) -> None:
    """Raises unless something holds for all samples; the message shows the first of the others."""
    for at in holds.logical_not().nonzero()[:1, 0].tolist():
        ray, start, end = (part[at].item() for part in samples)
        raise Broken(f"ray {ray}: the sample [{start:.4f}, {end:.4f}] {problem}")


def _keys(ray_indices: Tensor, t: Tensor) -> Tensor:
    """One number for ray and distance that sorts by both."""
    return ray_indices.double() * 1e3 + t.double()
