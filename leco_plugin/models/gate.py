"""The gating network: an MLP from a mapped position to logits of emptiness and the scene experts.

Torch only, so that a frozen gate can be used without nerfstudio.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from typing import get_args

import torch
from torch import Tensor, nn

from leco_plugin.models.compute import native
from leco_plugin.models.compute.dispatch import pad_to_steady_size
from leco_plugin.models.compute.learned import GateLogits
from leco_plugin.models.encodings import (
    FRESH,
    EncodingConfig,
    FrequencyEncoding,
    Kind,
    build_encoding,
)

EMPTY = 0
"""Index of the empty-space expert in logits, probabilities and routes."""


@dataclass(frozen=True)
class GateConfig:
    """The shape of a gate."""

    encoding: EncodingConfig = field(default_factory=EncodingConfig)
    """Encoding of the mapped position."""
    width: int = 64
    """Units of each hidden layer."""
    layers: int = 3
    """Hidden layers."""
    scene_experts: int = 4
    """n: logits beside the one of the empty-space expert."""
    normed: bool = True
    """Whether a layer norm gives the features of the last layer one length. False only takes their
    mean off, by a norm of a huge epsilon: cheaper to ask on a CPU, in a file of the same format."""

    def to_dict(self) -> dict[str, object]:
        return asdict(self)

    @staticmethod
    def from_dict(values: dict[str, object]) -> GateConfig:
        """Inverse of `to_dict`.

        Raises:
            TypeError: for unknown or missing fields.
        """
        encoding = values["encoding"]
        if not isinstance(encoding, dict):
            raise TypeError(f"the gate's encoding must be a mapping, got {type(encoding).__name__}")
        return GateConfig(**{**values, "encoding": EncodingConfig(**encoding)})  # type: ignore[arg-type]


NO_LENGTH = 2.0**26
"""Epsilon of a norm that leaves lengths as they are: the features' variance is nothing beside it,
and its root, by which the norm's scale begins, is exact. Whoever computes the norm as it is defined
has the same logits."""

MOST_VALUES = 15 * 2**20
"""Learned values of the largest gate: 60 MiB, which `occupancy.LARGEST_FILE` has room for."""
LARGEST_SIZES = {
    "width": 2**12,
    "layers": 64,
    "scene_experts": 64,
    "octaves": 64,
    "levels": 64,
    "features": 64,
    "components": 64,
    "log2_table": 24,
    "coarsest": 2**20,
    "finest": 2**20,
    "plane_cells": 2**12,
}


def check_sizes(config: GateConfig) -> None:
    """ValueError, in one line and before anything is allocated, for a gate that cannot be built or
    saved: an unknown kind of encoding, a size that is no whole number or out of range, a norm that
    is neither there nor not, or more than `MOST_VALUES` learned values."""
    if config.encoding.kind not in get_args(Kind):
        raise ValueError(f"the gate's encoding is of an unknown kind {config.encoding.kind!r}")
    if type(config.normed) is not bool:
        raise ValueError(f"the gate's normed is {config.normed!r}, neither true nor false")
    check_ranges("gate", {**vars(config), **vars(config.encoding)}, LARGEST_SIZES)
    with torch.device("meta"):
        values = sum(parameter.numel() for parameter in Gate(config).parameters())
    if values > MOST_VALUES:
        raise ValueError(
            f"a gate on {config.encoding.kind} features of these sizes holds {values} values; "
            f"at most {MOST_VALUES} fit its file"
        )


def check_ranges(owner: str, sizes: dict[str, object], most: dict[str, int]) -> None:
    """ValueError unless sizes are whole numbers from 1 to what they are at most."""
    for name, largest in most.items():
        size = sizes[name]
        if type(size) is not int or not 0 < size <= largest:
            raise ValueError(f"the {owner}'s {name} is {size!r}, not in 1 to {largest}")


class Gate(nn.Module):
    """G(x) = softmax(W LN(MLP(gamma_g(x)))), returned as logits."""

    def __init__(self, config: GateConfig) -> None:
        super().__init__()
        self.config = config
        self.encoding = build_encoding(config.encoding)
        widths = [self.encoding.out_dim] + [config.width] * config.layers
        self.hidden = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(widths))
        self.norm = nn.LayerNorm(widths[-1], eps=1e-5 if config.normed else NO_LENGTH)
        if not config.normed:
            nn.init.constant_(self.norm.weight, math.sqrt(NO_LENGTH))
        self.head = nn.Linear(widths[-1], 1 + config.scene_experts)

    def forward(self, mapped: Tensor) -> Tensor:
        """Mapped positions [N, 3] in [-1, 1] to logits [N, 1 + n] float32; 0 is emptiness."""
        if self.suits_native(mapped):
            scales: Tensor = self.encoding.scales  # type: ignore[union-attr, assignment]
            given = mapped, scales, FRESH[torch.float32], self.norm.eps, *self.native_parts()
            logits: Tensor = GateLogits.apply(*given)
            return logits
        features = self.encoding(pad_to_steady_size(mapped))
        for layer in self.hidden:
            features = torch.relu(layer(features))
        return logits_of(features, self.norm, self.head)[: len(mapped)]

    def suits_native(self, mapped: Tensor) -> bool:
        """Whether `networks.c` is asked about these positions, which get no gradient."""
        widest = max(self.encoding.out_dim, self.config.width, 1 + self.config.scene_experts)
        known = isinstance(self.encoding, FrequencyEncoding) and widest <= native.WIDEST
        without = not (torch.is_grad_enabled() and mapped.requires_grad)
        return known and without and native.suits_networks([mapped], self.native_parts())

    def native_parts(self) -> list[Tensor]:
        """Weights and biases as `networks.c` takes them."""
        parts = [part for layer in self.hidden for part in layer.parameters()]
        return [*parts, *self.norm.parameters(), *self.head.parameters()]

    def occupancy(self, mapped: Tensor) -> Tensor:
        """o(x) = 1 - G_0(x): mapped positions [N, 3] to [N] float32 in [0, 1]."""
        return occupancy_from_logits(self(mapped))

    def decides_as(self, other: Gate) -> bool:
        """Whether another gate has the same sizes and values, on whatever device."""
        values = zip(self.parameters(), other.parameters())
        return self.config == other.config and all(
            torch.equal(one.cpu(), its.cpu()) for one, its in values
        )


def logits_of(features: Tensor, norm: nn.LayerNorm, head: nn.Linear) -> Tensor:
    """Normed features [N, width] through the last layer, to float32 whatever the precision is.

    A decision at a threshold, or between two experts, needs more digits than bf16 has.
    """
    with torch.autocast(features.device.type, enabled=False):
        normed = norm(features.float())
        return nn.functional.linear(normed, head.weight.float(), head.bias.float())


def occupancy_from_logits(logits: Tensor) -> Tensor:
    """1 - softmax(logits)[:, 0], [N, 1 + n] to [N] float in [0, 1], computed as a sigmoid so that
    neither end loses digits."""
    return torch.sigmoid(occupancy_logit(logits))


def occupancy_logit(logits: Tensor) -> Tensor:
    """The logit of o(x): log-sum-exp of the scene logits minus the empty one; [N, 1 + n] to [N]."""
    return logits[:, 1:].logsumexp(dim=-1) - logits[:, EMPTY]


def route(logits: Tensor, empty_below: float | None) -> Tensor:
    """Top-1 routing: which expert each point is sent to.

    Args:
        logits: [N, 1 + n].
        empty_below: a point goes to the empty-space expert when o(x) is below this; None is the
            argmax over all experts (the paper's rule).
    Returns:
        [N] int64 in [0, n].
    """
    if empty_below is None:
        return logits.argmax(dim=-1)
    best_scene_expert = logits[:, 1:].argmax(dim=-1) + 1
    return torch.where(occupancy_from_logits(logits) < empty_below, EMPTY, best_scene_expert)
