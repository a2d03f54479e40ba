"""All scene experts at once: points sorted by expert, one grouped product of matrices a layer.

Nothing waits for the device: where an expert's points begin and end stays there. The plain twin is
`dispatch.dispatch`, which waits once to learn the sizes and then runs expert by expert.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Protocol, cast

import torch
from torch import Tensor, nn

from leco_plugin.models.rows import permute_rows


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
        hidden = nn.functional.grouped_mm(hidden, weights.mT, offs=ends)
        # rows beyond the last group hold anything, and so do their gradients
        hidden = torch.where(taken, hidden + biases.index_select(0, groups), 0.0)
        if i < last or not first.residual:
            hidden = torch.relu(hidden)
    hidden = points + hidden if first.residual else hidden
    return permute_rows(hidden, inverse, order)


def may_group(features: Tensor, width: int) -> bool:
    """Whether `grouped_dispatch` serves: bfloat16 on a CUDA device on which a small trial agrees.

    Rows must be multiples of 16 bytes.
    """
    device = features.device.type
    if device != "cuda" or width % 8 or not hasattr(nn.functional, "grouped_mm"):
        return False
    return (
        torch.get_autocast_dtype(device) == torch.bfloat16
        and (features.dtype == torch.bfloat16 or torch.is_autocast_enabled(device))
        and works_on(features.device)
    )


@functools.cache
def works_on(device: torch.device, dtype: torch.dtype = torch.bfloat16) -> bool:
    """Whether grouped products, forward and backward, are right on this device; tried once.

    The trial has what routes have: a group of an odd size, one without rows, and rows in no group.
    """
    sizes, width, beyond = [5, 0, 27], 16, 3
    with (
        torch.inference_mode(False),
        torch.enable_grad(),
        torch.autocast(device.type, enabled=False),
    ):
        count, n = sum(sizes) + beyond, len(sizes)
        rows = torch.linspace(-1.0, 1.0, count * width, device=device).view(count, width)
        matrices = torch.linspace(1.0, -1.0, n * width**2, device=device).view(n, width, width)
        given = rows.to(dtype), matrices.to(dtype)
        ends = torch.tensor(sizes, device=device).cumsum(0).to(torch.int32)

        def answers(grouped: bool) -> list[Tensor]:
            points, weights = (value.clone().requires_grad_() for value in given)
            if grouped:
                product = nn.functional.grouped_mm(points, weights.mT, offs=ends)[:-beyond]
            else:
                parts = points[:-beyond].split(sizes)
                product = torch.cat([part @ one.mT for part, one in zip(parts, weights)])
            of_points, of_weights = torch.autograd.grad(
                product, [points, weights], given[0][:-beyond]
            )
            return [product, of_points[:-beyond], of_weights]

        try:
            found, wanted = answers(True), answers(False)
            return all(
                torch.allclose(one, other, rtol=0.05, atol=0.05)
                for one, other in zip(found, wanted, strict=True)
            )
        except (RuntimeError, TypeError, ValueError):
            return False
