"""Dispatch by grouped products of matrices, where a device has them and they are faster."""

from __future__ import annotations

import functools
import logging
import statistics
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, cast

import torch
from torch import Tensor, nn

from leco_plugin.models.compute.dispatch import permute_rows
from leco_plugin.samplers.kernels import kernels_off
from leco_plugin.scenes.input_error import first_line

if TYPE_CHECKING:
    from leco_plugin.models.hmoe import Expert

Product = Callable[[Tensor, Tensor], Tensor]

_log = logging.getLogger(__name__)

ROWS, ROUNDS = 1 << 15, 5
"""Points of the race, and how often each of the two runs in it."""


@functools.cache
def is_grouping_faster(device: torch.device, n: int, width: int) -> bool:
    """Whether grouped products, of n experts, are right and faster on this device; tried once, said
    in one line."""
    with (
        torch.inference_mode(False),
        torch.enable_grad(),
        torch.autocast(device.type, enabled=False),
    ):
        try:
            if not is_right(device):
                _log.warning("no grouped products: they are wrong on %s", device)
                return False
            grouped, plain = race(device, n, width)
        except (RuntimeError, TypeError, ValueError) as error:  # running out of memory among them
            reason = first_line(error)
            _log.warning("no grouped products, one for each expert in their place: %s", reason)
            return False
    _log.info(
        "experts: %d of width %d on %s: %.3f ms a layer grouped, %.3f ms one by one",
        *(n, width, device, 1e3 * grouped, 1e3 * plain),
    )
    return grouped <= plain


def is_right(device: torch.device) -> bool:
    """Whether grouped products, forward and backward, are those of each group by itself.

    The trial has what routes have: a group of an odd size, one without rows, and rows in no group.
    """
    sizes, width, beyond = [5, 0, 27], 16, 3
    count, n = sum(sizes) + beyond, len(sizes)
    rows = torch.linspace(-1.0, 1.0, count * width, device=device).view(count, width)
    matrices = torch.linspace(1.0, -1.0, n * width**2, device=device).view(n, width, width)
    given, ends = (rows.bfloat16(), matrices.bfloat16()), _ends(sizes, device)

    def answers(product_of: Product) -> list[Tensor]:
        points, weights = (value.clone().requires_grad_() for value in given)
        product = product_of(points, weights)[: sum(sizes)]
        of_points, of_weights = torch.autograd.grad(product, [points, weights], given[0][:-beyond])
        return [product, of_points[: sum(sizes)], of_weights]

    return all(
        torch.allclose(one, other, rtol=0.05, atol=0.05)
        for one, other in zip(
            answers(lambda points, weights: grouped_product(points, weights, ends)),
            answers(lambda points, weights: one_by_one(points, weights, sizes)),
            strict=True,
        )
    )


def race(device: torch.device, n: int, width: int) -> tuple[float, float]:
    """Seconds of a layer forward and backward, grouped and one by one, medians of a few rounds.

    One by one is not charged for its wait: the sizes are known here.
    """
    sizes = [ROWS // n] * n
    points = torch.randn(sum(sizes), width, device=device).bfloat16().requires_grad_()
    weights = torch.randn(n, width, width, device=device).bfloat16().requires_grad_()

    ends = _ends(sizes, device)

    def seconds(product_of: Product) -> float:
        _wait(device)
        started = time.perf_counter()
        product = product_of(points, weights)
        torch.autograd.grad(product, [points, weights], product.detach())
        _wait(device)
        return time.perf_counter() - started

    grouped: list[float] = []
    plain: list[float] = []
    for _ in range(ROUNDS + 1):
        grouped.append(seconds(lambda points, weights: grouped_product(points, weights, ends)))
        plain.append(seconds(lambda points, weights: one_by_one(points, weights, sizes)))
    return statistics.median(grouped[1:]), statistics.median(plain[1:])  # the first warms up


def grouped_product(points: Tensor, weights: Tensor, ends: Tensor) -> Tensor:
    """Rows [N, width] times the transposed matrix [n, width, width] of their group, [N, width];
    groups end at `ends`, int32 [n], and rows beyond the last come back as anything."""
    return nn.functional.grouped_mm(points, weights.mT, offs=ends)


def one_by_one(points: Tensor, weights: Tensor, sizes: list[int]) -> Tensor:
    """The slow twin of `grouped_product`, without the rows beyond the last group."""
    parts = points[: sum(sizes)].split(sizes)
    return torch.cat([part @ one.mT for part, one in zip(parts, weights)])


def _ends(sizes: list[int], device: torch.device) -> Tensor:
    return torch.tensor(sizes, device=device).cumsum(0).to(torch.int32)


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def grouped_dispatch(features: Tensor, routes: Tensor, experts: Sequence[Expert]) -> Tensor:
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
    """Whether `grouped_dispatch` of features [N, width] to n experts serves: bfloat16 on CUDA where
    a trial finds it right and faster. There must be rows, in multiples of 16 bytes."""
    device = features.device.type
    if device != "cuda" or width % 8 or not len(features):
        return False
    return (
        hasattr(nn.functional, "grouped_mm")
        and "experts" not in kernels_off()
        and torch.get_autocast_dtype(device) == torch.bfloat16
        and (features.dtype == torch.bfloat16 or torch.is_autocast_enabled(device))
        and is_grouping_faster(features.device, n, width)
    )
