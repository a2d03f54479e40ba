"""Samples that no light reaches the camera from need no shading: pruning by transmittance.

Two ways to the same answer. `prune` asks the density of all samples at once, as nerfacc does.
`front_to_back` asks it in slabs and stops a ray when its transmittance falls below the threshold,
so that nothing behind an opaque surface is ever asked.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from leco_plugin.samplers.marching import NearFn, OccupiedFn, Samples, join, keep
from leco_plugin.samplers.packed import (
    render_transmittance_from_alpha,
    render_transmittance_from_density,
)
from leco_plugin.samplers.rays import Candidates

HELD_AT_ONCE = 1 << 20
"""Candidates that `front_to_back` holds at once, if it is told nothing else."""

SampleFn = Callable[[Tensor, Tensor, Tensor], Tensor]
"""t_starts [N], t_ends [N], ray_indices [N] to densities or opacities [N]."""

AlphaCapFn = Callable[[Tensor], Tensor]
"""Opacities [N] to the highest opacity threshold that may be asked for, a scalar tensor."""


@torch.no_grad()
def prune(
    samples: Samples,
    n_rays: int,
    *,
    sigma_fn: SampleFn | None = None,
    alpha_fn: SampleFn | None = None,
    early_stop_eps: float = 1e-4,
    alpha_thre: float = 0.0,
    alpha_cap: AlphaCapFn | None = None,
) -> Samples:
    """Samples with T >= early_stop_eps and alpha >= alpha_thre.

    Args:
        samples: as `march` returns them.
        n_rays: number of rays.
        sigma_fn, alpha_fn: densities or opacities of samples; one of the two.
        alpha_cap: keeps `alpha_thre` from rejecting everything, see `Estimator.alpha_cap`.

    Returns:
        The samples that are left, in the same order.

    Raises:
        ValueError: a function's answer is not one number for each sample.
    """
    ray_indices, t_starts, t_ends = samples
    if ray_indices.numel() == 0:
        return samples
    query = alpha_fn if sigma_fn is None else sigma_fn
    assert query is not None
    answers = query(t_starts, t_ends, ray_indices)
    if answers.shape != t_starts.shape:
        raise ValueError(
            f"sigma_fn or alpha_fn must answer {list(t_starts.shape)}, got {list(answers.shape)}"
        )
    if sigma_fn is None:
        trans = render_transmittance_from_alpha(answers, ray_indices=ray_indices, n_rays=n_rays)
        alphas = answers
    else:
        trans, alphas = render_transmittance_from_density(
            t_starts, t_ends, answers, ray_indices=ray_indices, n_rays=n_rays
        )
    visible = trans >= early_stop_eps
    if alpha_thre > 0.0:
        threshold = alphas.new_tensor(alpha_thre)
        if alpha_cap is not None:
            threshold = threshold.minimum(alpha_cap(alphas).to(threshold))
        visible &= alphas >= threshold
    return _select(samples, visible)


def _select(samples: Samples, wanted: Tensor) -> Samples:
    """The samples of which bool [n_samples] is true."""
    left = wanted.nonzero()[:, 0]
    ray_indices, t_starts, t_ends = (tensor.index_select(0, left) for tensor in samples)
    return ray_indices, t_starts, t_ends


@torch.no_grad()
def front_to_back(
    candidates: Candidates,
    n_steps: int,
    occupied: OccupiedFn | None,
    near_occupied: NearFn | None = None,
    *,
    sigma_fn: SampleFn,
    early_stop_eps: float,
    slab: int = 64,
    chunk_size: int | None = None,
) -> Samples:
    """The samples of `march` with T >= early_stop_eps, asking densities only as far as light goes.

    Args:
        candidates, n_steps: as `plan` returns them: of which rays, and the most of any ray.
        occupied, near_occupied: as for `march`.
        sigma_fn: densities of samples; `ray_indices` are those of the rays in `candidates`.
        early_stop_eps: transmittance in (0, 1) below which a ray is given up; the colour of a
            pixel changes by no more than this.
        slab: candidates by which each ray advances between two looks at its transmittance.
        chunk_size: most candidates held at once (a slab of one ray at least); None is a million.

    Returns:
        Samples sorted by ray, then t.

    Raises:
        ValueError: `early_stop_eps` is not in (0, 1).
    """
    if not 0.0 < early_stop_eps < 1.0:
        raise ValueError(f"front-to-back needs early_stop_eps in (0, 1), got {early_stop_eps}")
    opaque, depths = -math.log(early_stop_eps), torch.zeros_like(candidates.t_mins)
    kept: list[Samples] = []
    every_ray = torch.arange(len(depths), device=depths.device)
    for alive in every_ray.split(max(1, (chunk_size or HELD_AT_ONCE) // slab)):
        for first_step in range(0, n_steps, slab):
            ahead = candidates.counts.index_select(0, alive) > first_step
            ahead &= depths.index_select(0, alive) <= opaque
            alive = alive.index_select(0, ahead.nonzero()[:, 0])
            if alive.numel() == 0:
                break
            part = candidates.of_rays(alive).window(first_step, slab)
            of_alive, t_starts, t_ends = keep(part, slab, occupied, near_occupied)
            if of_alive.numel() == 0:
                continue
            samples = alive.index_select(0, of_alive), t_starts, t_ends
            sigmas = sigma_fn(t_starts, t_ends, samples[0])
            trans, _ = render_transmittance_from_density(
                t_starts, t_ends, sigmas, ray_indices=of_alive, n_rays=len(alive)
            )
            trans = trans * torch.exp(-depths.index_select(0, samples[0]))
            kept.append(_select(samples, trans >= early_stop_eps))
            depths.index_add_(0, samples[0], (sigmas * (t_ends - t_starts)).to(depths.dtype))
    ray_indices, t_starts, t_ends = join(kept, candidates.t_mins)
    ray_indices, order = ray_indices.sort(stable=True)
    return ray_indices, t_starts.index_select(0, order), t_ends.index_select(0, order)
