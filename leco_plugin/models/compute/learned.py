"""Small networks that learn on a CPU: forward by `networks.c`, backward by `gradients.c`.

Each function stands for what torch does in `models/gate.py`, `models/field.py` and
`models/rendering.py`, in a half to a third of the time. A gradient of a gradient is refused.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from leco_plugin.models.compute import native

PADDED = 16
"""Rows of matrices and features are padded to a multiple of this, as `gradients.c` has it."""

Parts = Sequence[Tensor | None]


def _room(part: Tensor) -> list[int]:
    """Rows and columns of a part that is `_padded`."""
    return [size + -size % PADDED for size in torch.atleast_2d(part).shape]


def _padded(part: Tensor) -> Tensor:
    """A matrix, or a vector as one of a single row, with zeros in new rows and columns."""
    matrix, (rows, columns) = torch.atleast_2d(part), _room(part)
    more = 0, columns - matrix.shape[1], 0, rows - matrix.shape[0]
    return torch.nn.functional.pad(matrix, more)


def _layers(parts: Parts) -> list[Tensor | None]:
    """Weights, the same turned and biases of layers, padded; from weights and biases."""
    made: list[Tensor | None] = []
    for weight, bias in zip(parts[::2], parts[1::2], strict=True):
        if weight is None or bias is None:
            made += [None] * 3
            continue
        whole = _padded(weight)
        made += [whole, whole.t().contiguous(), _padded(bias)[0]]
    return made


def _run(
    name: str, parts: Parts, call: Callable[[Any, list[Tensor | None], int, int], int], count: int
) -> list[Tensor | None]:
    """Calls a routine on some of its points at a time; returns the gradients of weights and biases,
    None for a part that is None. Each thread adds to sums of its own, by where it begins."""
    routine = native.routine_of(name)
    sums: dict[int, list[Tensor | None]] = {}
    failed: list[int] = []

    def work(begin: int, end: int) -> None:
        own = [None if part is None else part.new_zeros(_room(part)) for part in parts]
        sums[begin] = own
        failed.append(call(routine, own, begin, end))

    native.in_threads(work, count, count // native.FEWEST)
    if any(failed):
        raise MemoryError("no memory for the gradients of a batch")
    in_order = [own for _, own in sorted(sums.items())]  # whichever thread was first
    return [_total(part, found) for part, *found in zip(parts, *in_order)]


def _total(part: Tensor | None, found: Sequence[Tensor | None]) -> Tensor | None:
    """The sum of what threads have found, shaped as the part."""
    if part is None:
        return None
    whole = torch.stack(found).sum(dim=0)  # type: ignore[arg-type]
    rows, columns = torch.atleast_2d(part).shape
    return whole[:rows, :columns].contiguous().view_as(part)


def _strides(positions: Tensor) -> tuple[ctypes.c_int64, ctypes.c_int64]:
    """Of positions [N, 3]: from one coordinate to the next, and from one position to the next."""
    return ctypes.c_int64(positions.stride(1)), ctypes.c_int64(positions.stride(0))


class GateLogits(torch.autograd.Function):
    """Logits [N, 1 + n] of a gate on frequencies; positions receive no gradient.

    Args of `apply`:
        mapped: [N, 3] float32 in [-1, 1], in any strides.
        scales: [octaves] float32, what positions are multiplied by.
        fresh: each so many octaves, sines are computed anew rather than doubled.
        epsilon: of the norm.
        parts: weights and biases of the hidden layers, scale and shift of the norm, weights and
            biases of the last layer.
    """

    @staticmethod
    def forward(
        ctx: Any, mapped: Tensor, scales: Tensor, fresh: int, epsilon: float, *parts: Tensor
    ) -> Tensor:
        ctx.save_for_backward(mapped, scales, *parts)
        layers, width, outputs = len(parts) // 2 - 2, len(parts[0]), len(parts[-1])
        ctx.sizes = len(scales), fresh, layers, width, outputs, ctypes.c_float(epsilon)
        logits = mapped.new_empty(len(mapped), outputs)
        whole = native.addresses_of(parts)
        given = *native.pointers_to(mapped, scales), whole, *native.pointers_to(logits)
        native.of_points("gate_logits", given, len(mapped), (*_strides(mapped), *ctx.sizes))
        return logits

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, given: Tensor) -> tuple[Tensor | None, ...]:
        mapped, scales, *parts = ctx.saved_tensors
        given = given.contiguous()
        of_norm = [_padded(each)[0] for each in parts[-4:-2]]
        whole = [*_layers(parts[:-4]), *of_norm, *_layers(parts[-2:])]
        read = *native.pointers_to(mapped, scales), native.addresses_of(whole)
        after = *_strides(mapped), *ctx.sizes  # what is kept may have others than what was given

        def call(routine: Any, found: list[Tensor | None], begin: int, end: int) -> int:
            part = ctypes.c_int64(begin), ctypes.c_int64(end)
            places = *native.pointers_to(given), native.addresses_of(found)
            made: int = routine(*read, *places, *part, *after)
            return made

        found = _run("gate_gradients", parts, call, len(mapped))
        return (None, None, None, None, *found)


class FieldDensities(torch.autograd.Function):
    """Hidden features [N, width] and raw densities [N] of a field of experts.

    Args of `apply`:
        features: [N, inputs] float32 of the encoding.
        routes: [N] int64, the expert of each point.
        factors: [N] float32 of the hidden features.
        layers: of an expert.
        parts: weights and biases of the projection and of the density, then those of each expert's
            layers; None for those of an expert that adds nothing.
    """

    @staticmethod
    def forward(
        ctx: Any, features: Tensor, routes: Tensor, factors: Tensor, layers: int, *parts: Tensor
    ) -> tuple[Tensor, Tensor]:
        routes = routes.long().contiguous()
        order = routes.argsort()
        features, factors = features.contiguous(), factors.contiguous()
        ctx.save_for_backward(features, order, routes, factors, *parts)
        width = len(parts[1])
        ctx.sizes = features.shape[1], width, layers
        hidden, raw = features.new_empty(len(features), width), features.new_empty(len(features))
        pointers = native.pointers_to(features, order, routes, factors)
        given = *pointers, native.addresses_of(parts), *native.pointers_to(hidden, raw)
        native.of_points("field_densities", given, len(features), ctx.sizes)
        return hidden, raw

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, of_hidden: Tensor, of_raw: Tensor) -> tuple[Tensor | None, ...]:
        features, order, routes, factors, *parts = ctx.saved_tensors
        of_features, of_factors = torch.empty_like(features), torch.empty_like(factors)
        kept = _layers(parts)
        points = native.pointers_to(features, order, routes, factors)
        given = of_hidden.contiguous(), of_raw.contiguous()
        rest = native.pointers_to(*given, of_features, of_factors)
        read = *points, native.addresses_of(kept), *rest

        def call(routine: Any, found: list[Tensor | None], begin: int, end: int) -> int:
            part = ctypes.c_int64(begin), ctypes.c_int64(end)
            made: int = routine(*read, native.addresses_of(found), *part, *ctx.sizes)
            return made

        asked, each = set(routes.unique().tolist()), 2 * ctx.sizes[-1]
        for expert in range((len(parts) - 4) // each):
            if expert not in asked:  # no gradient, rather than one of zeros that Adam acts on
                parts[4 + each * expert : 4 + each * (expert + 1)] = [None] * each
        found = _run("field_gradients", parts, call, len(order))
        return (of_features, None, of_factors, None, *found)


class Colors(torch.autograd.Function):
    """Colours of rays [R, 3] from samples that are seen, summed up by weight.

    Args of `apply`:
        hidden: [M, width] features. weights: [M]. ray_indices: [M] int64, in order.
        chosen: [V] int64, the samples that are seen, in order.
        of_rays: [R, units], what direction and code of rays add to the hidden layer.
        parts: weights and biases of the hidden layer, and of the last before the sigmoid.
    """

    @staticmethod
    def forward(
        ctx: Any,
        hidden: Tensor,
        weights: Tensor,
        ray_indices: Tensor,
        chosen: Tensor,
        of_rays: Tensor,
        *parts: Tensor,
    ) -> Tensor:
        hidden, weights, of_rays = (each.contiguous() for each in (hidden, weights, of_rays))
        parts = tuple(each.contiguous() for each in parts)
        rays, numbers = ray_indices.contiguous(), chosen.to(torch.int32)
        ctx.save_for_backward(hidden, weights, rays, numbers, of_rays, *parts)
        rgb = hidden.new_zeros(len(of_rays), 3)
        routine, addresses = native.routine_of("add_colors"), native.addresses_of(parts)
        read, written = native.pointers_to(hidden, weights, rays), native.pointers_to(of_rays)
        sizes = hidden.shape[1], of_rays.shape[1]
        of_chosen = ray_indices.index_select(0, chosen)

        def work(begin: int, end: int) -> None:
            some = _of_rays(numbers, of_chosen, begin, end)
            routine(*read, *native.pointers_to(some), len(some), *written, addresses,
                    *native.pointers_to(rgb), *sizes)  # fmt: skip

        native.in_threads(work, len(of_rays), len(chosen) // native.FEWEST)
        return rgb

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, of_rgb: Tensor) -> tuple[Tensor | None, ...]:
        hidden, weights, rays, numbers, of_rays, *parts = ctx.saved_tensors
        of_hidden, of_weights = torch.zeros_like(hidden), torch.zeros_like(weights)
        of_of_rays = torch.zeros_like(of_rays)
        of_rgb, kept = of_rgb.contiguous(), _layers(parts)
        whole = native.addresses_of(kept)
        read, added = native.pointers_to(hidden, weights, rays), native.pointers_to(of_rays)
        rest = native.pointers_to(of_rgb, of_hidden, of_weights, of_of_rays)
        sizes = hidden.shape[1], of_rays.shape[1]
        of_chosen = rays.index_select(0, numbers.long())

        def call(routine: Any, found: list[Tensor | None], begin: int, end: int) -> int:
            some = _of_rays(numbers, of_chosen, begin, end)
            places = *native.pointers_to(some), len(some), *added, whole, *rest
            made: int = routine(*read, *places, native.addresses_of(found), *sizes)
            return made

        found = _run("color_gradients", parts, call, len(of_rays))
        return (of_hidden, of_weights, None, None, of_of_rays, *found)


def _of_rays(chosen: Tensor, of_chosen: Tensor, begin: int, end: int) -> Tensor:
    """Those of the chosen samples that lie on rays `begin` to `end`; rays are in order."""
    ends = torch.searchsorted(of_chosen, torch.tensor([begin, end], device=of_chosen.device))
    first, last = ends.tolist()
    return chosen[first:last]
