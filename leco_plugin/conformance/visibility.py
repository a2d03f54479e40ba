"""The rule for what estimators leave out because it cannot be seen."""

from __future__ import annotations

from functools import partial
from typing import Any

import torch
from torch import Tensor

from leco_plugin.conformance.estimators import EstimatorCase
from leco_plugin.conformance.rules import checks, require
from leco_plugin.conformance.scene import EVERYTHING, SLAB, STEP, Rays, among, crossing, in_order
from leco_plugin.samplers.marching import Samples
from leco_plugin.samplers.packed import render_transmittance_from_density

SLACK = 1e-3
"""Relative distance from a threshold at which a rounding does not decide."""
LOWEST_CAP = 0.1
"""Of the mean opacity of all samples: the least that an opacity threshold may be lowered to."""


@checks("visibility-pruning", "estimator")
def visibility_pruning(case: EstimatorCase) -> None:
    rays, sampler = crossing(), case.shared(EVERYTHING)
    for training in (False, True):
        sampler.train(training)
        plain = in_order(case.sample(sampler, rays, stratified=False))
        for limits in ((0.0, 0.0), (1e-2, 0.0), (0.0, 1e-2), (1e-2, 1e-2)):
            _check_pruned(case, sampler, rays, plain, *limits)


def _check_pruned(
    case: EstimatorCase, sampler: Any, rays: Rays, plain: Samples, eps: float, alpha_thre: float
) -> None:
    ray_indices, t_starts, t_ends = plain
    densities = _wall(rays, t_starts, t_ends, ray_indices)
    light, alphas = render_transmittance_from_density(
        t_starts, t_ends, densities, ray_indices=ray_indices, n_rays=len(rays.origins)
    )
    visible = light >= eps * (1.0 + SLACK)
    visible &= alphas >= alpha_thre * (1.0 + SLACK)
    dark = light < eps * (1.0 - SLACK)
    faint = alphas < min(alpha_thre, LOWEST_CAP * float(alphas.mean())) * (1.0 - SLACK)
    limits = {"early_stop_eps": eps, "alpha_thre": alpha_thre}

    def alpha_fn(t_starts: Tensor, t_ends: Tensor, ray_indices: Tensor) -> Tensor:
        return 1.0 - torch.exp(-_wall(rays, t_starts, t_ends, ray_indices) * (t_ends - t_starts))

    for name, function in (("sigma_fn", partial(_wall, rays)), ("alpha_fn", alpha_fn)):
        options: dict[str, Any] = {name: function, "stratified": False, **limits}
        kept = among(plain, case.sample(sampler, rays, **options))
        given = f"with {name}, early_stop_eps {eps} and alpha_thre {alpha_thre}"
        lost = int((visible & ~kept).sum())
        require(lost == 0, f"{given}: {lost} of {int(visible.sum())} visible samples are dropped")
        for kind, dropped in (("in the dark", dark), ("too faint to be seen", faint)):
            left, count = int((dropped & kept).sum()), int(dropped.sum())
            require(left == 0, f"{given}: {left} of {count} samples {kind} are kept")


def _wall(rays: Rays, t_starts: Tensor, t_ends: Tensor, ray_indices: Tensor) -> Tensor:
    """A thin fog with an opaque slab in it: density of samples, [N]."""
    positions = rays.at(ray_indices, (t_starts + t_ends) / 2.0)
    return 0.05 + SLAB.density(positions)[:, 0] / STEP
