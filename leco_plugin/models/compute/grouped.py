"""All scene experts at once: points sorted by expert, one grouped product of matrices a layer.

Nothing waits for the device: where an expert's points begin and end stays there. The plain twin is
`dispatch.dispatch`, which waits once to learn the sizes and then runs expert by expert.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, cast

import torch
from torch import Tensor, nn

from leco_plugin.models.compute.grouped_trial import grouped_product, serves
from leco_plugin.models.compute.rows import permute_rows
from leco_plugin.samplers.kernels import kernels_off


class Layered(Protocol):
    """What is asked of an expert: `hmoe.Expert`."""

    layers: nn.ModuleList
    skip: int | None
    residual: bool


def grouped_dispatch(features: Tensor, routes: Tensor, experts: Sequence[Layered]) -> Tensor:
    """Each point through the expert that it is routed to.

    Args:
        features: [N, width], in a type that `grouped_mm` multiplies on its device.
        routes: [N] int64 in [0, n]; 0 is no expert, i is `experts[i - 1]`. All experts are alike.

    Returns:
        [N, width] in the type of the features; zero where the route is 0.
    """
    n = len(experts)
    groups = (routes - 1).remainder(n + 1)  # points of no expert come last, in no group
    groups, order = groups.sort(stable=True)
    places = torch.arange(len(order), device=order.device)
    inverse = torch.empty_like(order).scatter_(0, order, places)
    numbers = torch.arange(n, device=order.device)
    ends = torch.searchsorted(groups, numbers, right=True).to(torch.int32)
    taken = (groups < n)[:, None]
    groups = groups.clamp(max=n - 1)
    points = permute_rows(features, order, inverse).masked_fill(~taken, 0.0)
    hidden, first = points, experts[0]
    last = len(first.layers) - 1
    for i in range(len(first.layers)):
        if i == first.skip:
            hidden = torch.cat([points, hidden], dim=-1)
        layers = [cast(nn.Linear, expert.layers[i]) for expert in experts]
        weights = torch.stack([layer.weight for layer in layers]).to(points.dtype)
        biases = torch.stack([layer.bias for layer in layers]).to(points.dtype)
        hidden = grouped_product(hidden, weights, ends)
        # rows beyond the last group hold anything, and so do their gradients
        hidden = torch.where(taken, hidden + biases.index_select(0, groups), 0.0)
        if i < last or not first.residual:
            hidden = torch.relu(hidden)
    hidden = points + hidden if first.residual else hidden
    return permute_rows(hidden, inverse, order)


def may_group(features: Tensor, n: int, width: int) -> bool:
    """Whether `grouped_dispatch` serves: bfloat16 on CUDA where a trial finds it right and faster.

    Rows must be multiples of 16 bytes, and there must be some.

    Args:
        features: [N, width].
        n: number of experts.
        width: of their layers.
    """
    device = features.device.type
    if device != "cuda" or width % 8 or not len(features):
        return False
    return (
        hasattr(nn.functional, "grouped_mm")
        and "experts" not in kernels_off()
        and torch.get_autocast_dtype(device) == torch.bfloat16
        and (features.dtype == torch.bfloat16 or torch.is_autocast_enabled(device))
        and serves(features.device, n, width)
    )
