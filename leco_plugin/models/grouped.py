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
    """Whether grouped products, forward and backward, are right on this device; tried once."""
    with torch.enable_grad(), torch.autocast(device.type, enabled=False):
        rows = torch.linspace(-1.0, 1.0, 32 * 16, device=device).view(32, 16).to(dtype)
        matrices = torch.linspace(1.0, -1.0, 2 * 16 * 16, device=device).view(2, 16, 16).to(dtype)
        ends = torch.tensor([8, 32], dtype=torch.int32, device=device)
        try:
            inputs = [rows.clone().requires_grad_(), matrices.clone().requires_grad_()]
            product = nn.functional.grouped_mm(inputs[0], inputs[1].mT, offs=ends)
            found = [product, *torch.autograd.grad(product, inputs, product.detach())]
        except (RuntimeError, NotImplementedError):
            return False
        wanted_inputs = [rows.clone().requires_grad_(), matrices.clone().requires_grad_()]
        parts = [wanted_inputs[0][:8] @ wanted_inputs[1][0].mT]
        parts.append(wanted_inputs[0][8:] @ wanted_inputs[1][1].mT)
        wanted = torch.cat(parts)
        answers = [wanted, *torch.autograd.grad(wanted, wanted_inputs, wanted.detach())]
        return all(
            torch.allclose(one, other, rtol=0.05, atol=0.05) for one, other in zip(found, answers)
        )
