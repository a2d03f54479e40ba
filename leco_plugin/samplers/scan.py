"""Sums and products along rays whose samples lie ragged in one flat tensor, in plain torch.

One scan over *all* samples costs one call on any device, so a sum along a ray is the difference
of two entries of a global prefix sum. The scan runs in float64: the difference then loses about
1e-16 of the grand total, which is below float32's own rounding up to tens of millions of
samples, whereas a float32 scan of ten million samples keeps few correct digits. Devices without
float64 scan rays side by side in a padded matrix instead.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from leco_plugin.on_cpu import has_float64


class Segments(NamedTuple):
    """Which samples of a flat tensor belong to which ray; samples of a ray are contiguous."""

    ray_indices: Tensor
    """Ray of each sample, int64 [n_samples], non-decreasing."""
    starts: Tensor
    """Position of the first sample of each ray, int64 [n_rays]."""
    counts: Tensor
    """Number of samples of each ray, int64 [n_rays]."""


@torch.no_grad()
def pack_info(ray_indices: Tensor, n_rays: int | None = None) -> Tensor:
    """Start and count of each ray's samples (nerfacc's function of that name).

    Args:
        ray_indices: ray of each sample, int64 [n_samples], non-decreasing.
        n_rays: number of rays. When None it is read from the last index, which waits for the
            device; hosts know it and should pass it.

    Returns:
        int64 [n_rays, 2] of (start, count); rays without samples have count 0.

    Raises:
        ValueError: `ray_indices` is not one-dimensional.
    """
    if ray_indices.dim() != 1:
        raise ValueError(f"ray_indices must be [n_samples], got {tuple(ray_indices.shape)}")
    if n_rays is None:
        n_rays = int(ray_indices[-1]) + 1 if ray_indices.numel() else 0
    # Sorted indices make this a binary search per ray, with no atomics and no pass over samples.
    rays = torch.arange(n_rays + 1, device=ray_indices.device, dtype=ray_indices.dtype)
    bounds = torch.searchsorted(ray_indices.contiguous(), rays)
    return torch.stack([bounds[:-1], bounds[1:] - bounds[:-1]], dim=-1)


def segments(
    n_samples: int,
    packed_info: Tensor | None = None,
    ray_indices: Tensor | None = None,
    n_rays: int | None = None,
) -> Segments | None:
    """Complete whichever description of the rays is given; None when the input is batched.
    ValueError if it does not fit `n_samples`, by shape only, so that no device is waited for."""
    if ray_indices is not None and ray_indices.shape != (n_samples,):
        raise ValueError(f"ray_indices {tuple(ray_indices.shape)} does not fit {n_samples} samples")
    if packed_info is None:
        if ray_indices is None:
            return None
        packed_info = pack_info(ray_indices, n_rays)
    if packed_info.dim() != 2 or packed_info.shape[-1] != 2:
        raise ValueError(f"packed_info must be [n_rays, 2], got {tuple(packed_info.shape)}")
    starts, counts = packed_info[:, 0], packed_info[:, 1]
    if ray_indices is None:
        rays = torch.arange(len(counts), device=counts.device)
        ray_indices = torch.repeat_interleave(rays, counts, output_size=n_samples)
    return Segments(ray_indices, starts, counts)


def segment_scan(
    values: Tensor, rays: Segments, exclusive: bool = False, reverse: bool = False
) -> Tensor:
    """Sum of each sample's predecessors on its ray (successors when `reverse`), no gradient.

    Args:
        values: finite, [n_samples, ...], any floating or integer type.
        exclusive: leave the sample itself out.

    Returns:
        Like `values`, float64 (float32 on devices without it, int64 for integer values).
    """
    if values.numel() == 0:
        return values.to(_scan_dtype(values))
    values = values.to(_scan_dtype(values))
    if values.dtype == torch.float32:
        return _padded_scan(values, rays, exclusive, reverse)
    inclusive = torch.cumsum(values, dim=0)
    before = inclusive - values  # everything in front of a sample, on all rays
    if not reverse:
        # Rays without samples may start one past the end; their entry is never gathered.
        base = before.index_select(0, rays.starts.clamp(max=len(values) - 1))
        own = before if exclusive else inclusive
        return own - base.index_select(0, rays.ray_indices)
    last = (rays.starts + rays.counts - 1).clamp(min=0)
    total = inclusive.index_select(0, last).index_select(0, rays.ray_indices)
    return total - (inclusive if exclusive else before)


def scan_of_any(
    values: Tensor, rays: Segments, exclusive: bool = False, reverse: bool = False
) -> Tensor:
    """`segment_scan` of floating values that need not be finite; what is not stays on its ray."""
    sums = segment_scan(values.masked_fill(~values.isfinite(), 0.0), rays, exclusive, reverse)
    # A global scan would carry one ray's inf into all later rays: count infinities apart,
    # +inf in the low half of an int64, -inf in the high half, NaN as both.
    positive = ((values == torch.inf) | values.isnan()).long()
    negative = ((values == -torch.inf) | values.isnan()).long()
    met = segment_scan(positive + (negative << 31), rays, exclusive, reverse)
    met_positive, met_negative = (met & (2**31 - 1)) > 0, (met >> 31) > 0
    sums = sums.masked_fill(met_positive, torch.inf).masked_fill(met_negative, -torch.inf)
    return sums.masked_fill(met_positive & met_negative, torch.nan)


def _padded_scan(values: Tensor, rays: Segments, exclusive: bool, reverse: bool) -> Tensor:
    """`segment_scan` over a [n_rays, longest] matrix: its width waits for the device once."""
    places = torch.arange(len(values), device=values.device)
    places = places - rays.starts.index_select(0, rays.ray_indices)
    longest = int(rays.counts.max())
    rows = values.new_zeros(len(rays.counts), longest, *values.shape[1:])
    rows[rays.ray_indices, places] = values
    sums = rows.flip(1).cumsum(dim=1).flip(1) if reverse else rows.cumsum(dim=1)
    return (sums - rows if exclusive else sums)[rays.ray_indices, places]


def _scan_dtype(values: Tensor) -> torch.dtype:
    if not values.is_floating_point():
        return torch.int64
    return torch.float64 if has_float64(values.device) else torch.float32


class _PackedSum(torch.autograd.Function):
    """Packed prefix sum; its gradient is the same scan from the other end."""

    @staticmethod
    def forward(ctx: Any, inputs: Tensor, rays: Segments, exclusive: bool) -> Tensor:
        ctx.rays, ctx.exclusive = rays, exclusive
        if not inputs.is_floating_point():
            return segment_scan(inputs, rays, exclusive)
        return scan_of_any(inputs, rays, exclusive).to(inputs.dtype)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, None, None]:
        return scan_of_any(grad, ctx.rays, ctx.exclusive, reverse=True).to(grad.dtype), None, None


class _PackedProduct(torch.autograd.Function):
    """Packed prefix product: exp of summed logarithms, with zeros, NaN and signs counted apart.

    Counting the zeros makes the gradient exact at a factor 0 (an opacity of exactly 1), where
    dividing the product by the factor would give 0/0. The gradient itself has none: torch says so
    where one is asked for.
    """

    @staticmethod
    def forward(ctx: Any, inputs: Tensor, rays: Segments, exclusive: bool) -> Tensor:
        wide = inputs.to(_scan_dtype(inputs))
        zero, negative, bad = wide == 0, wide < 0, wide.isnan()
        # of the negative ones only the last bit is asked for: the rest may run over
        each = zero.long() + (bad.long() << 31) + (negative.long() << 62)
        counts = segment_scan(each, rays, exclusive)
        zeros, sign = counts & (2**31 - 1), 1 - 2 * ((counts >> 62) & 1)
        met_bad = ((counts >> 31) & (2**31 - 1)) > 0
        logs = wide.masked_fill(zero | bad, 1.0).abs().log()
        # exp(1e3) is already infinite and exp(-1e3) zero: clamping keeps rays apart, and loses
        # nothing but a product of infinity with what is nearly zero.
        logs = logs.clamp(-1e3, 1e3)
        nonzero_product = segment_scan(logs, rays, exclusive).exp() * sign
        outputs = nonzero_product.masked_fill(zeros > 0, 0.0).masked_fill(met_bad, torch.nan)
        ctx.rays, ctx.exclusive = rays, exclusive
        ctx.save_for_backward(wide, zero, outputs, nonzero_product.masked_fill(zeros != 1, 0.0))
        return outputs.to(inputs.dtype)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, None, None]:
        inputs, zero, outputs, outputs_but_for_one_zero = ctx.saved_tensors
        wide = grad.to(inputs.dtype)
        later = scan_of_any(wide * outputs, ctx.rays, ctx.exclusive, reverse=True)
        at_zero = scan_of_any(
            wide * outputs_but_for_one_zero, ctx.rays, ctx.exclusive, reverse=True
        )
        grads = torch.where(zero, at_zero, later / inputs.masked_fill(zero, 1.0))
        return grads.to(grad.dtype), None, None


def _scan(
    inputs: Tensor,
    packed_info: Tensor | None,
    indices: Tensor | None,
    exclusive: bool,
    product: bool,
) -> Tensor:
    rays = segments(len(inputs) if inputs.dim() else 0, packed_info, indices)
    if rays is not None:
        return (_PackedProduct if product else _PackedSum).apply(inputs, rays, exclusive)
    if exclusive:
        first = torch.full_like(inputs[..., :1], 1 if product else 0)
        inputs = torch.cat([first, inputs[..., :-1]], dim=-1)
    return inputs.cumprod(dim=-1) if product else inputs.cumsum(dim=-1)


def inclusive_sum(
    inputs: Tensor, packed_info: Tensor | None = None, indices: Tensor | None = None
) -> Tensor:
    """y_i = sum of x_j over j <= i on the same ray.

    Args:
        inputs: [n_samples, ...] with one of the two arguments below, else batched
            [..., n_samples].
        packed_info: int64 [n_rays, 2] of (start, count), as `pack_info` gives it.
        indices: ray of each sample, int64 [n_samples], non-decreasing.

    Returns:
        Tensor like `inputs`; a non-finite value reaches later samples of its own ray only. A finite
        one 1e16 times as large as others drowns them on every ray.
    """
    return _scan(inputs, packed_info, indices, exclusive=False, product=False)


def exclusive_sum(
    inputs: Tensor, packed_info: Tensor | None = None, indices: Tensor | None = None
) -> Tensor:
    """y_i = sum of x_j over j < i on the same ray; arguments as for `inclusive_sum`."""
    return _scan(inputs, packed_info, indices, exclusive=True, product=False)


def inclusive_prod(
    inputs: Tensor, packed_info: Tensor | None = None, indices: Tensor | None = None
) -> Tensor:
    """y_i = product of x_j over j <= i on the same ray; arguments as for `inclusive_sum`."""
    return _scan(inputs, packed_info, indices, exclusive=False, product=True)


def exclusive_prod(
    inputs: Tensor, packed_info: Tensor | None = None, indices: Tensor | None = None
) -> Tensor:
    """y_i = product of x_j over j < i on the same ray; arguments as for `inclusive_sum`."""
    return _scan(inputs, packed_info, indices, exclusive=True, product=True)
