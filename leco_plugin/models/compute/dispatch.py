"""Top-1 dispatch: each point through the one expert it is routed to, and back in its place."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from leco_plugin.samplers.scan import pack_info

SIZES_PER_OCTAVE = 16
"""Steady sizes between a power of two and the next: on average 3% of the rows are filling."""


def steady_size(count: int, device_type: str) -> int:
    """How many rows to compute for `count` of them: a few more on a CPU under autocast,
    where oneDNN compiles a product for each new number of rows."""
    if device_type != "cpu" or not torch.is_autocast_enabled("cpu"):
        return count
    return filled_size(count)


def filled_size(count: int) -> int:
    """The least of the few sizes that is no less than `count`."""
    step = max(1, 2 ** max(count - 1, 0).bit_length() // (2 * SIZES_PER_OCTAVE))
    return -(-count // step) * step


def pad_to_steady_size(rows: Tensor) -> Tensor:
    """Rows [N, ...] padded with zeros to the steady size; the caller cuts them off again."""
    missing = steady_size(len(rows), rows.device.type) - len(rows)
    if missing == 0:
        return rows
    return torch.cat([rows, rows.new_zeros(missing, *rows.shape[1:])])


def permute_rows(
    rows: Tensor, order: Tensor, inverse: Tensor, filling: Sequence[slice] = ()
) -> Tensor:
    """Rows [N, D] in another order; `inverse` undoes `order`, both [N] int64. Rows of `filling`,
    which `order` leaves out, have no gradient."""
    moved: Tensor = _Permute.apply(rows, order, inverse, filling)
    return moved


def select_rows(rows: Tensor, chosen: Tensor) -> Tensor:
    """Rows [M, D] of [N, D]; the chosen numbers [M] int64 must differ from each other."""
    selected: Tensor = _Select.apply(rows, chosen)
    return selected


class _Permute(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, rows: Tensor, order: Tensor, inverse: Tensor, filling: Sequence[slice]
    ) -> Tensor:
        ctx.inverse, ctx.filling = inverse, filling
        return rows.index_select(0, order)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None, None]:
        moved = gradient.index_select(0, ctx.inverse)
        for part in ctx.filling:
            moved[part] = 0.0
        return moved, None, None, None


class _Select(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rows: Tensor, chosen: Tensor) -> Tensor:
        ctx.chosen, ctx.count = chosen, len(rows)
        return rows.index_select(0, chosen)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        whole = gradient.new_zeros(ctx.count, *gradient.shape[1:])
        return whole.index_copy_(0, ctx.chosen, gradient), None


class Places:
    """Where rows go that are sorted by keys [N] int64, each key's rows up to a steady size."""

    sizes: list[int]
    """Rows of each key, filling included; they sum up to P."""

    def __init__(self, keys: Tensor, num_keys: int) -> None:
        device = keys.device
        ordered, sources = keys.sort(stable=True)
        counts = pack_info(ordered, num_keys)[:, 1].tolist()  # one synchronisation
        self.sizes = [steady_size(count, device.type) for count in counts]
        numbers = torch.arange(len(keys), device=device)
        self.filling: list[slice] = []
        if self.sizes == counts:
            self.sources, slots = sources, numbers
        else:
            filled = [size - count for size, count in zip(self.sizes, counts)]
            ends = torch.tensor(self.sizes).cumsum(0).tolist()
            self.filling = [slice(end - rows, end) for end, rows in zip(ends, filled) if rows]
            before = (torch.tensor(filled).cumsum(0) - torch.tensor(filled)).to(device)
            slots = numbers + before.index_select(0, ordered)
            self.sources = sources.new_zeros(ends[-1]).scatter_(0, slots, sources)
        self.slots = torch.empty_like(sources).scatter_(0, sources, slots)

    def gather(self, rows: Tensor) -> Sequence[Tensor]:
        """Rows [N, D] as one [size, D] for each key; filling holds copies of any row."""
        return permute_rows(rows, self.sources, self.slots).split(self.sizes)

    def put_back(self, rows: Tensor) -> Tensor:
        """Placed rows [P, D] as [N, D], in the order of the keys; filling is left out."""
        return permute_rows(rows, self.slots, self.sources, self.filling)


def dispatch(
    features: Tensor, routes: Tensor, experts: Sequence[Callable[[Tensor], Tensor] | None]
) -> Tensor:
    """Applies the experts, each to the points that are routed to it.

    Args:
        features: [N, width].
        routes: [N] int64, numbers of experts.
        experts: features [M, width] to as many; None stands for one that answers zero.
    Returns:
        [N, width] in the dtype of the last expert that has points.
    """
    places = Places(routes, len(experts))
    parts = []
    dtype = features.dtype
    for expert, part in zip(experts, places.gather(features)):
        if expert is None:
            parts.append(torch.zeros_like(part))
        elif len(part):
            parts.append(expert(part))
            dtype = parts[-1].dtype
        else:
            parts.append(part)
    return places.put_back(torch.cat([part.to(dtype) for part in parts]))


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
        capacity_factor: places, as a multiple of an equal share of the points.
    Returns:
        bool [N].
    """
    capacity = int(capacity_factor * -(-len(routes) // num_experts))
    by_value = gate_values.argsort(descending=True, stable=True)
    experts, order = routes.index_select(0, by_value).sort(stable=True)
    order, firsts = by_value.index_select(0, order), pack_info(experts, num_experts)[:, 0]
    places = torch.arange(len(routes), device=routes.device)
    within = places - firsts.index_select(0, experts) < capacity
    return torch.empty_like(within).scatter_(0, order, within)
