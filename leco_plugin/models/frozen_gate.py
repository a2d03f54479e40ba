"""Inference of a gate on a CPU: the answers of `Gate` in fewer passes over memory.

On a CPU a gate spends more time between its matrix products than in them: on casts, biases, ReLU
and the layer norm. Here weights are cast once, a layer is one pass where oneDNN supports it, and
the norm is folded into the last layer. That layer returns only what decides: how far each scene
expert's logit lies above the empty-space logit.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import NamedTuple, cast
from weakref import WeakKeyDictionary

import torch
from torch import Tensor, nn

from leco_plugin.models.compute.dispatch import filled_size
from leco_plugin.models.encodings import FrequencyEncoding
from leco_plugin.models.gate import EMPTY, Gate
from leco_plugin.samplers.base import Snapshot

LARGEST_LOGIT = 80.0
"""Sums of exponentials of up to this stay finite; o is 1 in float32 long before."""

UNITS_AT_ONCE = 1 << 18
"""Units that the last layer takes to float32, multiplies and measures while they lie in the cache
of a core, for each thread: a megabyte. All at once takes twice as long."""

LayerFn = Callable[[Tensor, Tensor, Tensor], Tensor]
"""Rows [N, inputs], weight [width, inputs] and bias [width] to relu(W x + b), [N, width]."""


class FoldedGate(NamedTuple):
    """A gate's weights as they are asked, its norm folded into the last layer."""

    snapshot: Snapshot
    """What they were made from."""
    layers: list[tuple[Tensor, Tensor]]
    """Weight and bias of each hidden layer, in the type of the products."""
    head: Tensor
    """float32 [n + 1, width], or [n, width] without a norm: scene logits above the empty one, of
    features less their mean and over the length of what is left; in the last row the mean, as a
    part of the features' length."""
    shift: Tensor
    """float32 [n, 1]: what is added to those logits."""


def occupancy_of(gate: Gate, mapped: Tensor, dtype: torch.dtype) -> Tensor:
    """o(x) = 1 - G_0(x), as `Gate.occupancy` has it under autocast to `dtype`.

    Args:
        mapped: [N, 3] in [-1, 1] on a CPU; cheapest with strides (1, N).
        dtype: type of the hidden layers' products.
    Returns:
        [N] float32 in [0, 1].
    """
    with torch.no_grad(), torch.autocast("cpu", enabled=False):
        if dtype == torch.float32 and gate.suits_native(mapped):
            return gate.occupancy(mapped)
        count = len(mapped)
        if filling := filled_size(count) - count:
            mapped = torch.nn.functional.pad(mapped.T, (0, filling)).T
        folded = folded_gate(gate, dtype)
        encoding = gate.encoding
        is_known = isinstance(encoding, FrequencyEncoding)
        features = encoding(mapped, dtype) if is_known else encoding(mapped).to(dtype)
        for weight, bias in folded.layers:
            features = _layer(features, weight, bias)
        return _occupancy(_logits(folded, features, gate))[:count]


def _layer(features: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    one_pass = _one_pass(features.dtype)
    if one_pass is None or not features.is_contiguous():  # columns would be made rows first
        return torch.addmm(bias, features, weight.T).relu_()
    return one_pass(features, weight, bias)


def _logits(folded: FoldedGate, features: Tensor, gate: Gate) -> Tensor:
    """How far scene experts lie above emptiness: features [N, width] to float32 [n, N]."""
    count, width = features.shape
    sums = features.new_empty(len(folded.head), count, dtype=torch.float32)
    lengths = sums.new_empty(count)
    rows_at_once = max(1, UNITS_AT_ONCE * torch.get_num_threads() // width)
    for first in range(0, count, rows_at_once):
        part = slice(first, first + rows_at_once)
        some = features[part].float()
        if gate.config.normed:
            torch.mm(folded.head, some.T, out=sums[:, part])
            torch.linalg.vector_norm(some, dim=1, out=lengths[part])
        else:
            torch.addmm(folded.shift, folded.head, some.T, out=sums[:, part])
    if not gate.config.normed:
        return sums
    above, mean = sums[:-1], sums[-1]
    square = lengths.square_().addcmul_(mean, mean, value=-1.0)
    square.clamp_(min=0.0).add_(width * gate.norm.eps)
    return torch.addcmul(folded.shift, above, square.rsqrt_())


def _occupancy(logits: Tensor) -> Tensor:
    """1 - softmax of what `_logits` returns, [N]."""
    if len(logits) == 1:
        return logits[0].sigmoid_()
    odds = logits.clamp_(max=LARGEST_LOGIT).exp_().sum(dim=0)
    return odds / (odds + 1.0)


_folded: WeakKeyDictionary[Gate, dict[torch.dtype, FoldedGate]] = WeakKeyDictionary()


def folded_gate(gate: Gate, dtype: torch.dtype) -> FoldedGate:
    """The weights of a gate as they are now, made anew only where one has changed."""
    found = _folded.setdefault(gate, {})
    if dtype not in found or not found[dtype].snapshot.matches(gate):
        hidden = [cast(nn.Linear, layer) for layer in gate.hidden]
        layers = [(layer.weight.to(dtype), layer.bias.to(dtype)) for layer in hidden]
        weight = gate.head.weight.float()
        constant = weight @ gate.norm.bias.float() + gate.head.bias.float()
        head = _above_empty(weight * gate.norm.weight.float())
        head = head - head.mean(dim=1, keepdim=True)
        length = math.sqrt(head.shape[1])
        if gate.config.normed:
            head = torch.cat([head * length, torch.full_like(head[:1], 1.0 / length)])
        else:
            head = head / math.sqrt(gate.norm.eps)
        shift = _above_empty(constant[:, None])
        found[dtype] = FoldedGate(Snapshot(gate), layers, head, shift)
    return found[dtype]


def _above_empty(rows: Tensor) -> Tensor:
    """What a row of each expert [1 + n, ...] has more than that of emptiness, [n, ...]."""
    return rows[EMPTY + 1 :] - rows[EMPTY]


@functools.cache
def _one_pass(dtype: torch.dtype) -> LayerFn | None:
    """oneDNN's layer, which torch keeps private; None where it is missing or errs."""
    rows, weight = torch.linspace(-1.0, 1.0, 32 * 48).view(48, 32).to(dtype).split([32, 16])
    bias = weight[:, 0].contiguous()

    def layer(rows: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        answer: Tensor = torch.ops.mkldnn._linear_pointwise(rows, weight, bias, "relu", [], "")
        return answer

    try:
        answer = layer(rows, weight, bias)
    except (AttributeError, NotImplementedError, RuntimeError):
        return None
    expected = (rows.double() @ weight.double().T + bias.double()).relu()
    return layer if torch.allclose(answer.double(), expected, rtol=0.02, atol=0.02) else None
