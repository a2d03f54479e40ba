"""Top-1 dispatch: each point through the one expert it is routed to, and back in its place."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from leco_plugin.models.rows import permute_rows

Expert = Callable[[Tensor], Tensor]
"""Features [M, width] to [M, width]."""


def dispatch(features: Tensor, routes: Tensor, experts: Sequence[Expert | None]) -> Tensor:
    """Applies the experts, each to the points that are routed to it.

    Args:
        features: [N, width].
        routes: [N] int64, numbers of experts.
        experts: None stands for one that answers zero.
    Returns:
        [N, width] in the dtype of the last expert that has points.
    """
    order = routes.argsort(stable=True)
    inverse = torch.empty_like(order).scatter_(
        0, order, torch.arange(len(order), device=order.device)
    )
    counts = torch.bincount(routes, minlength=len(experts)).tolist()  # one synchronisation
    ordered = permute_rows(features, order, inverse)
    parts = []
    dtype = features.dtype
    for expert, part in zip(experts, ordered.split(counts)):
        if expert is None:
            parts.append(torch.zeros_like(part))
        elif len(part):
            parts.append(expert(part))
            dtype = parts[-1].dtype
        else:
            parts.append(part)
    return permute_rows(torch.cat([part.to(dtype) for part in parts]), inverse, order)


@torch.no_grad()
def within_capacity(
    routes: Tensor, gate_values: Tensor, num_experts: int, capacity_factor: float
) -> Tensor:
    """Which points find a place where each expert takes a limited number (GShard, section 2.2).

    An expert takes floor(capacity_factor ceil(N / num_experts)) points, those with the highest
    gate values first: the batch-prioritised routing with which Switch-NeRF is trained.

    Args:
        routes: [N] int64 in [0, num_experts).
        gate_values: [N], the gate's probability of the chosen expert.
        num_experts: number of experts.
        capacity_factor: places, as a multiple of an equal share of the points.
    Returns:
        bool [N].
    """
    capacity = int(capacity_factor * -(-len(routes) // num_experts))
    by_value = gate_values.argsort(descending=True, stable=True)
    order = by_value.index_select(0, routes.index_select(0, by_value).argsort(stable=True))
    counts = torch.bincount(routes, minlength=num_experts)
    firsts = counts.cumsum(0) - counts
    places = torch.arange(len(routes), device=routes.device)
    within = places - firsts.index_select(0, routes.index_select(0, order)) < capacity
    return torch.empty_like(within).scatter_(0, order, within)
