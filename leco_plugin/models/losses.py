"""All losses of gate and field; each says what it teaches. And the likely cause of one that is not
finite.

The gate is taught by the paper's two losses, or by the same two in logit form. All are computed in
float32 and do not grow with the batch: they are means over points or rays, or sums that the caller
divides.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn

from leco_plugin.models.gate import EMPTY, occupancy_logit
from leco_plugin.models.rendering import Intervals
from leco_plugin.samplers.packed import exclusive_sum


def expert_shares(routes: Tensor, num_experts: int) -> Tensor:
    """f_i: the share of points sent to each expert; routes [N] int64 to [num_experts] float32."""
    counts = routes.new_zeros(num_experts)  # `bincount` would wait for a GPU
    return counts.scatter_add_(0, routes, torch.ones_like(routes)).float() / max(len(routes), 1)


def expert_statistics(routes: Tensor, sigmas: Tensor, num_experts: int) -> tuple[Tensor, Tensor]:
    """`expert_shares`, and the mean density of each expert's points in the unit of `sigmas` [N], 0
    of none; both [num_experts] float32."""
    shares = expert_shares(routes, num_experts)
    sums = torch.zeros_like(shares).index_add_(0, routes, sigmas.float())
    return shares, sums / (shares * len(routes)).clamp(min=1.0)


def imbalanced_gate_loss(probabilities: Tensor, routes: Tensor, empty_ratio: float) -> Tensor:
    """L_g = sum_i w_i f_i P_i with w_0 = 1 / rho and w_i = n / (1 - rho), P_i = mean_x G_i(x).

    Stationary where f_0 = rho and f_i = (1 - rho) / n, so rho is the target empty ratio;
    rho = 1 / (1 + n) gives back the balanced loss of Switch-NeRF, whose value at balance is one.

    Args:
        probabilities: [N, 1 + n] softmax of the gate.
        routes: [N] int64, where each point was sent.
        empty_ratio: rho, in (0, 1).
    Returns:
        Scalar; one at the stationary point.
    """
    num_experts = probabilities.shape[-1]
    weights = torch.full(
        (num_experts,), (num_experts - 1) / (1.0 - empty_ratio), device=probabilities.device
    )
    weights[EMPTY] = 1.0 / empty_ratio
    means = probabilities.sum(dim=0) / max(len(probabilities), 1)
    return (weights * expert_shares(routes, num_experts) * means).sum()


def balance_loss(probabilities: Tensor, routes: Tensor) -> Tensor:
    """The balanced loss of Switch-NeRF: m sum_i f_i P_i over m experts; one when all get the same.

    Args:
        probabilities: [N, m] softmax over the experts to be balanced.
        routes: [N] int64 in [0, m).
    """
    num_experts = probabilities.shape[-1]
    return num_experts * (expert_shares(routes, num_experts) * probabilities.mean(dim=0)).sum()


HUE_WEIGHT = 8.0
"""Of squared errors in hue, beside those in brightness. Brightness varies far more in photographs:
with equal weights its errors drown what hue teaches the features (docs/decisions.md)."""


def color_loss(rgb: Tensor, truth: Tensor) -> Tensor:
    """Mean squared error of colours, both [R, 3]; its part in hue, a colour less its grey, has a
    weight. Any weight leaves the mean of the seen colours the best one."""
    errors = rgb - truth
    in_hue = errors - errors.mean(dim=-1, keepdim=True)
    return errors.square().mean() + (HUE_WEIGHT - 1.0) * in_hue.square().mean()


def adjoining(intervals: Intervals) -> Tensor:
    """Whether each sample but the first lies on the ray of the one before it, with no gap of half a
    step between them: bool [M - 1]."""
    rays, starts, ends = intervals
    return (rays[1:] == rays[:-1]) & (2.0 * starts[1:] < 3.0 * ends[:-1] - starts[:-1])


def widen(weights: Tensor, adjoin: Tensor) -> Tensor:
    """The largest of each sample's weight and those of its two neighbours on the ray: [M] to [M].

    A surface that is taught with a margin of one step is found again by rays whose steps fall
    elsewhere.

    Args:
        weights: [M] in the order of rays, then distance.
        adjoin: bool [M - 1], whether a sample and the one before it are neighbours.
    """
    factors = adjoin.to(weights.dtype)
    widened = weights.clone()
    widened[1:] = torch.maximum(widened[1:], weights[:-1] * factors)
    widened[:-1] = torch.maximum(widened[:-1], weights[1:] * factors)
    return widened


def density_loss(empty_probability: Tensor, alphas: Tensor) -> Tensor:
    """L_d = mean[G_0 stop_gradient(alpha)]: the gate must not call a dense point empty.

    Args:
        empty_probability: [N] G_0(x).
        alphas: [N] opacity 1 - exp(-sigma delta) of each sample.
    """
    return (empty_probability * alphas.detach()).sum() / max(len(alphas), 1)


def contribution_loss(
    logits: Tensor, weights: Tensor, weight_at_full: float, emphasis: float
) -> Tensor:
    """Both forces in logit form: mean[-k y log(1 - G_0) - (1 - y) log G_0], y = min(w / w_0, 1).

    The field teaches the gate what each sample contributes to its ray. Unlike the paper's form its
    gradient does not die when the gate saturates, and no empty ratio has to be guessed.

    Args:
        logits: [N, 1 + n] of the gate.
        weights: [N] rendering weight T alpha of each sample.
        weight_at_full: w_0, the weight that makes a sample fully occupied.
        emphasis: k, how much dearer a lost contribution is than a needless sample.
    """
    target = (weights.detach() / weight_at_full).clamp(max=1.0)
    occupied = occupancy_logit(logits)
    losses = emphasis * target * torch.nn.functional.softplus(-occupied)
    losses = losses + (1.0 - target) * torch.nn.functional.softplus(occupied)
    return losses.sum() / max(len(losses), 1)


def agreement_loss(weights: Tensor, occupancies: Tensor, empty_below: float) -> Tensor:
    """Rendering weight where the gate says empty: sum of w max(0, 1 - o / empty_below).

    It teaches the field alone, to give up single specks of density that explain single pixels: a
    smooth gate does not follow them. The caller divides the sum by the number of rays.

    Args:
        weights: [N] rendering weights.
        occupancies: [N] o(x).
        empty_below: o(x) from which weight costs nothing.
    """
    doubt = (1.0 - occupancies.detach() / empty_below).clamp(min=0.0)
    return (weights * doubt).sum()


def termination_loss(
    weights: Tensor, intervals: Intervals, distances: Tensor, floor: float = 0.03
) -> Tensor:
    """Rays with a known distance end there: mean of -log(weight within one step of it + floor).

    After the ray termination loss of DS-NeRF (Deng et al. 2022, eq. 6). Some points are seen
    through what hides them: the floor bounds the gradient of rays that end long before.

    Args:
        weights: [M] rendering weights.
        intervals: [M] packed, scene units.
        distances: [R] of each ray, scene units; 0 where it is not known.
    Returns:
        Scalar, -log(1 + floor) at least; zero when no distance is known.
    """
    known = distances.index_select(0, intervals.ray_indices)
    middles = 0.5 * (intervals.t_starts + intervals.t_ends)
    near = (middles - known).abs() <= intervals.t_ends - intervals.t_starts
    there = torch.zeros_like(distances).index_add_(0, intervals.ray_indices, weights * near)
    likelihoods = -torch.log(there.clamp(min=0.0) + floor)
    return (likelihoods * (distances > 0)).sum() / (distances > 0).sum().clamp(min=1)


def backdrop_loss(
    weights: Tensor, is_backdrop: Tensor, ray_indices: Tensor, wanted: Tensor, counts: Tensor
) -> Tensor:
    """Squared difference of each backdrop's weight from a wanted one, mean over all rays.

    Args:
        weights: [M] rendering weights.
        is_backdrop: bool [M].
        ray_indices: [M] int64.
        wanted: [R] in [0, 1]: 1 - a behind a pixel of opacity a, 0 where the ray meets ground.
        counts: [R] in [0, 1], how much each ray counts. Rays without a backdrop add nothing.
    """
    last = is_backdrop.nonzero()[:, 0]
    rays = ray_indices.index_select(0, last)
    wrong = weights.index_select(0, last) - wanted.index_select(0, rays)
    return (counts.index_select(0, rays) * wrong.square()).sum() / max(len(wanted), 1)


def distortion_loss(
    weights: Tensor, t_starts: Tensor, t_ends: Tensor, packed_info: Tensor
) -> Tensor:
    """Distortion of packed samples (mip-NeRF 360, eq. 15): mean over rays, in linear time.

    Args:
        weights, t_starts, t_ends: [M] samples sorted by ray; near to far is one unit of t.
        packed_info: [R, 2] start and count of each ray.
    """
    middles = 0.5 * (t_starts + t_ends)
    weight_before = exclusive_sum(weights, packed_info)
    moment_before = exclusive_sum(weights * middles, packed_info)
    # pairs (i, j < i) counted twice, which is the full double sum because it is symmetric
    between = 2.0 * weights * (middles * weight_before - moment_before)
    within = weights**2 * (t_ends - t_starts) / 3.0
    return (between + within).sum() / max(len(packed_info), 1)


def first_non_finite(losses: dict[str, Tensor]) -> str | None:
    """Name of the first loss that is not finite, or None; waits for the device once. Losses are of
    any shapes; hosts also give plain numbers."""
    tensors = [torch.as_tensor(loss).detach() for loss in losses.values()]
    device = next((loss.device for loss in tensors if loss.device.type != "cpu"), "cpu")
    values = torch.stack([loss.float().sum().to(device) for loss in tensors]).tolist()
    return next((name for name, value in zip(losses, values) if not math.isfinite(value)), None)


def require_finite(
    losses: dict[str, Tensor], model: nn.Module, outputs: dict[str, Any], image: Tensor
) -> None:
    """FloatingPointError for losses that are not finite, before a step is taken: which one, and the
    likely cause, the first thing on its way that is not finite, in one line. `image` is what the
    batch was compared with; `rays` and `shaded`, where outputs hold them, are suspects too."""
    name = first_non_finite(losses)
    if name is None:
        return
    rays, shaded = outputs.get("rays"), outputs.get("shaded")
    suspects = [("the training image holds values that are not finite", image)]
    if rays is not None:
        of_rays = rays.directions, rays.origins
        suspects += [("a ray is not finite: check the camera poses", each) for each in of_rays]
    suspects += [
        (f"parameter {key} is not finite: the learning rate is probably too high", value)
        for key, value in model.named_parameters()
        if value.numel()
    ]
    if shaded is not None:
        suspects += [
            ("the gate's logits overflowed", shaded.logits),
            ("a density overflowed: the learning rate is probably too high", shaded.sigmas),
            ("a colour overflowed", shaded.rgb),
        ]
    cause = next(
        (text for text, value in suspects if not bool(torch.isfinite(value).all())),
        "all inputs and parameters are finite; the loss itself overflowed",
    )
    raise FloatingPointError(f"{name} is not finite: {cause}.")
