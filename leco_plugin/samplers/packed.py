"""Volume rendering of packed samples: weights, transmittance, visibility, accumulation.

nerfacc's names and argument order, on any device and in plain torch. Samples lie flat, [n_samples]
with `ray_indices`, or batched, [n_rays, n_samples]. With tau_i = sigma_i (t_end - t_start):
alpha_i = 1 - exp(-tau_i), T_i = exp(-sum_{j<i} tau_j), w_i = T_i alpha_i (Max 1995; NeRF eq. 3).
Half-precision inputs are taken to float32 first: results never have less.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from leco_plugin.samplers.scan import (
    Segments,
    exclusive_prod,
    exclusive_sum,
    inclusive_prod,
    inclusive_sum,
    pack_info,
    segment_scan,
    segments,
)

__all__ = [
    "accumulate_along_rays",
    "exclusive_prod",
    "exclusive_sum",
    "inclusive_prod",
    "inclusive_sum",
    "pack_info",
    "render_transmittance_from_alpha",
    "render_transmittance_from_density",
    "render_visibility_from_alpha",
    "render_visibility_from_density",
    "render_weight_from_alpha",
    "render_weight_from_density",
]

OPAQUE = 1e3
"""Optical depth beyond which exp(-tau) is zero in float64 too: clamping there changes no result
and keeps an infinite density from reaching the other rays through the global scan."""


class _DensityWeights(torch.autograd.Function):
    """(T alpha, T, alpha) from optical depths; one scan forward, one backward.

    dL/dtau_j = (g^w_j T_j + g^alpha_j)(1 - alpha_j) - sum_{i>j} (g^w_i w_i + g^T_i T_i).
    Left to autograd, the gathers and the difference of scans would be differentiated one by one.
    """

    @staticmethod
    def forward(ctx: Any, depths: Tensor, rays: Segments | None) -> tuple[Tensor, Tensor, Tensor]:
        bounded = depths.clamp(-OPAQUE, OPAQUE).nan_to_num(nan=0.0)
        trans = _exclusive(bounded, rays).to(depths.dtype).neg_().exp_()
        alphas = -torch.expm1(-depths)
        weights = trans * alphas
        ctx.rays = rays
        ctx.set_materialize_grads(False)  # a host that uses the weights alone pays for them alone
        ctx.save_for_backward(weights, trans, alphas)
        return weights, trans, alphas

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor, None]:
        weights, trans, alphas = ctx.saved_tensors
        grad_weights, grad_trans, grad_alphas = grads
        own, flow = torch.zeros_like(weights), torch.zeros_like(weights)
        if grad_weights is not None:
            own, flow = grad_weights * trans, grad_weights * weights
        if grad_trans is not None:
            flow = torch.addcmul(flow, grad_trans, trans)
        if grad_alphas is not None:
            own = own + grad_alphas
        # what is no number shows in its own sample; here it would reach all rays
        flow = flow.nan_to_num(nan=0.0, posinf=0.0, neginf=0.0)
        later = _exclusive(flow, ctx.rays, reverse=True).to(flow.dtype)
        return torch.addcmul(own, own, alphas, value=-1.0) - later, None


def _exclusive(values: Tensor, rays: Segments | None, reverse: bool = False) -> Tensor:
    if rays is not None:
        return segment_scan(values, rays, exclusive=True, reverse=reverse)
    # Few samples lie on one ray: a shifted sum needs no wider type, as a difference of sums would.
    ahead = values.flip(-1) if reverse else values
    sums = torch.nn.functional.pad(ahead[..., :-1], (1, 0)).cumsum(dim=-1)
    return sums.flip(-1) if reverse else sums


def at_least_float32(values: Tensor) -> Tensor:
    """Half precision to float32, other types as they are."""
    return values.float() if values.dtype in (torch.float16, torch.bfloat16) else values


def _depths(t_starts: Tensor, t_ends: Tensor, sigmas: Tensor) -> Tensor:
    """Optical depth of each sample, at least float32."""
    if not t_starts.shape == t_ends.shape == sigmas.shape:
        raise ValueError(
            "t_starts, t_ends and sigmas must have one shape, got "
            f"{tuple(t_starts.shape)}, {tuple(t_ends.shape)}, {tuple(sigmas.shape)}"
        )
    return at_least_float32(sigmas) * (at_least_float32(t_ends) - at_least_float32(t_starts))


def render_weight_from_density(
    t_starts: Tensor,
    t_ends: Tensor,
    sigmas: Tensor,
    packed_info: Tensor | None = None,
    ray_indices: Tensor | None = None,
    n_rays: int | None = None,
    prefix_trans: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Rendering weights of samples with a density.

    Args:
        t_starts, t_ends: interval of each sample along its ray, world units, [n_samples] with
            one of the descriptions of the rays below, else batched [n_rays, n_samples].
        sigmas: density, 1 / world unit, of the same shape.
        packed_info: int64 [n_rays, 2] of (start, count).
        ray_indices: int64 [n_samples], non-decreasing; `n_rays` goes with it.
        prefix_trans: transmittance already lost in front of each sample, like `sigmas`.

    Returns:
        weights, transmittance in front of each sample, opacities, each like `sigmas`. A NaN
        density makes its own sample NaN and no other.

    Raises:
        ValueError: shapes do not fit.
    """
    depths = _depths(t_starts, t_ends, sigmas)
    rays = segments(depths.shape[-1], packed_info, ray_indices, n_rays)
    if rays is None and depths.shape[-1] == 0:
        return depths, depths, depths
    weights, trans, alphas = _DensityWeights.apply(depths, rays)
    if prefix_trans is not None:
        weights, trans = weights * prefix_trans, trans * prefix_trans
    return weights, trans, alphas


def render_transmittance_from_density(
    t_starts: Tensor,
    t_ends: Tensor,
    sigmas: Tensor,
    packed_info: Tensor | None = None,
    ray_indices: Tensor | None = None,
    n_rays: int | None = None,
    prefix_trans: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Transmittance and opacities; arguments as for `render_weight_from_density`."""
    return render_weight_from_density(
        t_starts, t_ends, sigmas, packed_info, ray_indices, n_rays, prefix_trans
    )[1:]


def render_transmittance_from_alpha(
    alphas: Tensor,
    packed_info: Tensor | None = None,
    ray_indices: Tensor | None = None,
    n_rays: int | None = None,
    prefix_trans: Tensor | None = None,
) -> Tensor:
    """T_i = prod_{j<i} (1 - alpha_j), with the exact gradient also where an alpha is 1.

    Args:
        alphas: opacity in [0, 1], [n_samples] or batched [n_rays, n_samples].
        Others as for `render_weight_from_density`.

    Returns:
        Transmittance in front of each sample, like `alphas`.
    """
    alphas = at_least_float32(alphas)
    if ray_indices is not None and packed_info is None:
        packed_info = pack_info(ray_indices, n_rays)
    trans = exclusive_prod(1.0 - alphas, packed_info, ray_indices)
    return trans if prefix_trans is None else trans * prefix_trans


def render_weight_from_alpha(
    alphas: Tensor,
    packed_info: Tensor | None = None,
    ray_indices: Tensor | None = None,
    n_rays: int | None = None,
    prefix_trans: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Weights T alpha and transmittance T; arguments as above."""
    trans = render_transmittance_from_alpha(alphas, packed_info, ray_indices, n_rays, prefix_trans)
    return trans * alphas, trans


@torch.no_grad()
def render_visibility_from_density(
    t_starts: Tensor,
    t_ends: Tensor,
    sigmas: Tensor,
    packed_info: Tensor | None = None,
    ray_indices: Tensor | None = None,
    n_rays: int | None = None,
    early_stop_eps: float = 1e-4,
    alpha_thre: float = 0.0,
    prefix_trans: Tensor | None = None,
) -> Tensor:
    """Which samples are worth shading: T >= early_stop_eps and alpha >= alpha_thre, bool."""
    trans, alphas = render_transmittance_from_density(
        t_starts, t_ends, sigmas, packed_info, ray_indices, n_rays, prefix_trans
    )
    return _visible(trans, alphas, early_stop_eps, alpha_thre)


@torch.no_grad()
def render_visibility_from_alpha(
    alphas: Tensor,
    packed_info: Tensor | None = None,
    ray_indices: Tensor | None = None,
    n_rays: int | None = None,
    early_stop_eps: float = 1e-4,
    alpha_thre: float = 0.0,
    prefix_trans: Tensor | None = None,
) -> Tensor:
    """Which samples are worth shading: T >= early_stop_eps and alpha >= alpha_thre, bool."""
    trans = render_transmittance_from_alpha(alphas, packed_info, ray_indices, n_rays, prefix_trans)
    return _visible(trans, alphas, early_stop_eps, alpha_thre)


def _visible(trans: Tensor, alphas: Tensor, early_stop_eps: float, alpha_thre: float) -> Tensor:
    visible = trans >= early_stop_eps
    return visible & (alphas >= alpha_thre) if alpha_thre > 0 else visible


def accumulate_along_rays(
    weights: Tensor,
    values: Tensor | None = None,
    ray_indices: Tensor | None = None,
    n_rays: int | None = None,
) -> Tensor:
    """Sum of w_i v_i along each ray, for colours, depths and, without values, opacity.

    Args:
        weights: [n_samples] with `ray_indices`, else batched [n_rays, n_samples].
        values: [n_samples, D] or [n_rays, n_samples, D]; None stands for ones, D = 1.
        ray_indices: int64 [n_samples], in any order.
        n_rays: number of rays, required with `ray_indices`.

    Returns:
        [n_rays, D]; rays without samples are zero. Differentiable to weights and values.

    Raises:
        ValueError: shapes do not fit, or `n_rays` is missing.
    """
    if values is not None and values.shape[:-1] != weights.shape:
        raise ValueError(f"values {tuple(values.shape)} do not fit weights {tuple(weights.shape)}")
    weights = at_least_float32(weights)
    if ray_indices is None:
        if values is None:
            return weights.sum(dim=-1, keepdim=True)
        return (weights[..., None] * values).sum(dim=-2)
    if n_rays is None or weights.dim() != 1 or ray_indices.shape != weights.shape:
        raise ValueError(
            f"packed weights {tuple(weights.shape)} need ray_indices {tuple(ray_indices.shape)} "
            f"of the same length and n_rays (got {n_rays})"
        )
    if values is None:
        return weights.new_zeros(n_rays).index_add(0, ray_indices, weights)[:, None]
    return _WeightedSum.apply(weights, at_least_float32(values), ray_indices, n_rays)


class _WeightedSum(torch.autograd.Function):
    """Packed sum of w_i v_i; autograd's own backward takes several times as long on a CPU, where
    reducing over a last dimension of 3 is slow and a product with a vector of ones is not."""

    @staticmethod
    def forward(
        ctx: Any, weights: Tensor, values: Tensor, ray_indices: Tensor, n_rays: int
    ) -> Tensor:
        ctx.save_for_backward(weights, values, ray_indices)
        weighted = weights[:, None] * values
        return weighted.new_zeros(n_rays, values.shape[-1]).index_add_(0, ray_indices, weighted)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, Tensor | None, None, None]:
        weights, values, ray_indices = ctx.saved_tensors
        grad = grad.index_select(0, ray_indices)
        grad_weights = grad_values = None
        if ctx.needs_input_grad[0]:
            grad_weights = (grad * values).mv(grad.new_ones(grad.shape[-1])).to(weights.dtype)
        if ctx.needs_input_grad[1]:
            grad_values = (grad * weights[:, None]).to(values.dtype)
        return grad_weights, grad_values, None, None
