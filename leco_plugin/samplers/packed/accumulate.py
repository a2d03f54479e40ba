"""From weights of samples to values of rays: colour, depth and opacity of a pixel."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


def at_least_float32(values: Tensor) -> Tensor:
    """Half precision to float32, other types as they are."""
    return values.float() if values.dtype in (torch.float16, torch.bfloat16) else values


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
