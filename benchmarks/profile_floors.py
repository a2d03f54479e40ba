"""The work that each part of a step cannot do without, counted from sizes.

| part | bytes, each value once | operations |
|---|---|---|
| data | a ray: its pixel, colour, origin and direction | - |
| candidates, sampling | a kept sample: its interval and position | of the gate, for hosts |
| gate | a place: position and logits | 2 for each weight |
| encoding | a place: position, table rows, features | 2 for each value looked up |
| experts, field | a place: what goes in and comes out | 2 for each weight on its way |
| colour | a visible sample: features and colour | 2 for each weight |
| weights | a sample: density, interval, weight | - |
| loss | a ray: both colours; a sample: weight, interval | - |
| optimizer | a parameter: value, gradient and two moments read, three written | - |

A backward pass has twice the operations, reads gradients in place of results, and reads and writes
the rows of a table's gradient, which begins as zeros. Operations on a vector, such as a sine, are
not counted, nor is it that rows of a table lie apart: no machine reaches these floors.
"""

from __future__ import annotations

from typing import Any

import torch
from gpu_floor import Ceilings
from profile_parts import Work
from torch import Tensor, nn

from leco_plugin.evaluation.queries import number_of
from leco_plugin.models import rendering
from leco_plugin.models.encodings import HashEncoding

REAL = 4
"""Bytes of a float32."""
POSITION = 3 * REAL
INTERVAL = 8 + 2 * REAL
"""Number of the ray, start and end."""
CORNERS = 4
"""Rows of a level that our hash grid looks up; nerfstudio's has 8."""


def milliseconds(moved: float, operations: float, ceilings: Ceilings, calls: float) -> float:
    """The larger of both terms of the roofline, of one of so many calls."""
    by_bytes = moved / ceilings.bytes_per_second
    return 1e3 * max(by_bytes, operations / ceilings.operations_per_second) / calls


def both_ways(trained: bool, moved: float, operations: float = 0.0, **counts: int) -> Work:
    """Work whose backward pass, where there is one, moves twice the bytes with twice the
    operations: gradients of what comes in and goes out, and of the weights."""
    back = 2.0 * trained
    return Work(moved, operations, back * moved, back * operations, **counts)


def of_data(result: Any, *_: Any, **__: Any) -> Work:
    """`next_train`: a pixel of three bytes read; colour, origin and direction written."""
    bundle = result[0]
    return Work(bytes=len(bundle) * (3 + 3 * POSITION))


def of_rays(result: Any, *bundle: Any, **named: Any) -> Work:
    """A model's `forward` of a bundle, which nerfstudio gives by its name or without."""
    return Work(rays=sum(len(each) for each in (*bundle, *named.values())))


def of_samples(result: Any, *_: Any, **__: Any) -> Work:
    """What samples along rays: nerfstudio's `RaySamples` first, or packed intervals."""
    first = result[0]
    kept = len(first) if isinstance(first, Tensor) else number_of(first)
    return Work(bytes=kept * (INTERVAL + POSITION))


def of_shaded(result: Any, *_: Any, **__: Any) -> Work:
    """A rendering in one routine, which says what it has shaded and how much; no floor is known."""
    return Work(samples=len(result[1].t_starts))


def of_gate(result: Tensor, asked: Any, positions: Tensor, *_: Any, **__: Any) -> Work:
    """`Gate.forward`, or what an `Occupancy` asks its gate."""
    gate, places = getattr(asked, "gate", asked), number_of(positions)
    moved = places * POSITION + result.numel() * result.element_size()
    return both_ways(result.requires_grad, moved, 2.0 * places * linear_weights(gate))


def of_table(places: int, looked_up: int, result: Tensor, table: Tensor) -> Work:
    """A hash grid: `looked_up` values for each place."""
    rows, out = places * looked_up * REAL, result.numel() * result.element_size()
    operations = 2.0 * places * looked_up
    zeros = table.numel() * REAL
    back = result.requires_grad
    return Work(
        places * POSITION + rows + out,
        operations,
        back * (places * POSITION + out + 2 * rows + zeros),
        back * operations,
    )


def of_encoding(encoding: nn.Module) -> Any:
    """The encoding of our field; other kinds than hash grids count what goes in and comes out."""

    def work(result: Tensor, mapped: Tensor) -> Work:
        if not isinstance(encoding, HashEncoding):
            moved = len(mapped) * POSITION + result.numel() * result.element_size()
            return both_ways(result.requires_grad, moved)
        return of_table(len(mapped), encoding.out_dim * CORNERS, result, encoding.table)

    return work


def of_experts(field: Any) -> Any:
    """`HMoEField.density`: each place goes through the projection, the density head and, unless it
    is empty, one scene expert."""
    weights = linear_weights(field.projection) + linear_weights(field.density_head)

    def work(
        result: tuple[Tensor, Tensor], mapped: Tensor, routes: Tensor, *_: Any, **__: Any
    ) -> Work:
        features = result[1]
        scene = next(expert for expert in field.experts.experts[1:] if expert is not None)
        on_scene = int((routes > 0).sum())
        operations = 2.0 * (len(mapped) * weights + on_scene * linear_weights(scene))
        size = features.element_size()
        moved = len(mapped) * ((field.encoding.out_dim + features.shape[-1]) * size + REAL)
        trained = features.requires_grad
        return both_ways(trained, moved, operations, samples=len(mapped))

    return work


def of_colour(color: Any) -> Any:
    """`ColorHead.forward`."""
    weights = linear_weights(color.of_features) + linear_weights(color.out)

    def work(result: Tensor, features: Tensor, *_: Any, **__: Any) -> Work:
        moved = features.numel() * features.element_size() + result.numel() * REAL
        return both_ways(result.requires_grad, moved, 2.0 * len(features) * weights)

    return work


def of_composite(result: Tensor, color: Any, features: Tensor, weights: Tensor, *_: Any) -> Work:
    """`rendering.composite`, whose visible samples are coloured by routines in C."""
    if not color.suits_native(features, weights):
        return Work()  # `ColorHead.forward` has it
    visible = int((weights > rendering.VISIBLE).sum())
    moved = visible * features.shape[1] * features.element_size() + result.numel() * REAL
    per_sample = linear_weights(color.of_features) + linear_weights(color.out)
    return both_ways(result.requires_grad, moved, 2.0 * visible * per_sample)


def of_weights(result: tuple[Tensor, Tensor], *_: Any, **__: Any) -> Work:
    """`rendering.weigh`."""
    weights = result[0]
    moved = len(weights) * (2 * REAL + INTERVAL)
    return Work(bytes=moved, backward_bytes=moved * weights.requires_grad)


def of_loss(result: Any, outputs: Any, *_: Any, **__: Any) -> Work:
    """`get_loss_dict`."""
    intervals = outputs.get("intervals") if "shaded" in outputs else None
    samples = 0 if intervals is None else len(intervals.t_starts)
    moved = len(outputs["rgb"]) * 6 * REAL + samples * (REAL + INTERVAL)
    return Work(bytes=moved, backward_bytes=moved)


def of_adam(optimizers: Any) -> Any:
    """`optimizer_scaler_step_some` of nerfstudio's optimizers."""

    def work(result: None, scaler: Any, groups: list[str]) -> Work:
        parameters = [p for group in groups for p in optimizers.parameters[group]]
        return Work(bytes=7 * REAL * sum(p.numel() for p in parameters if p.grad is not None))

    return work


def of_places(result: Any, samples: Any, *_: Any, **__: Any) -> Work:
    """A host's field: positions and intervals in, density and colour out."""
    count = number_of(samples)
    return both_ways(torch.is_grad_enabled(), count * (POSITION + 4 * REAL), samples=count)


def of_linear(layer: nn.Linear) -> Any:
    """A layer of a host's field: its operations alone, as layers could be fused."""

    def work(result: Tensor, features: Tensor) -> Work:
        rows = features.numel() // layer.in_features
        return both_ways(result.requires_grad, 0.0, 2.0 * rows * layer.weight.numel())

    return work


def of_host_table(encoding: Any) -> Any:
    """nerfstudio's `HashEncoding`, computed in torch or by us."""

    def work(result: Tensor, positions: Tensor) -> Work:
        looked_up = 8 * encoding.num_levels * encoding.features_per_level
        return of_table(number_of(positions), looked_up, result, encoding.hash_table)

    return work


def linear_weights(module: nn.Module) -> int:
    """Weights of all linear layers in a module."""
    return sum(m.weight.numel() for m in module.modules() if isinstance(m, nn.Linear))
