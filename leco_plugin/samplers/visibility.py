"""Samples that no light reaches the camera from need no shading: pruning by transmittance.

The density of all samples is asked at once, as nerfacc does.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from leco_plugin.samplers.marching import Samples
from leco_plugin.samplers.packed import (
    render_transmittance_from_alpha,
    render_transmittance_from_density,
)

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
