"""Bytes that the eager twin of a gate moves on paper: what each operation reads and writes, counted
while it runs on a CPU. On a card each is a kernel, which begins and ends in memory.
"""

from __future__ import annotations

from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from leco_plugin import occupancy
from leco_plugin.models.gate import Gate, GateConfig
from leco_plugin.occupancy import Occupancy
from leco_plugin.space import Space

POSITIONS = 4096


class Traffic(TorchDispatchMode):
    """Adds up the bytes of all tensors that operations take and give; views move nothing."""

    def __init__(self) -> None:
        super().__init__()
        self.bytes = 0

    def __torch_dispatch__(
        self, function: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        given = function(*args, **(kwargs or {}))
        if not function.is_view:
            tensors = [leaf for leaf in tree_leaves((args, kwargs, given)) if type(leaf) is Tensor]
            self.bytes += sum(tensor.numel() * tensor.element_size() for tensor in tensors)
        return given


def as_on_a_card(gate: Gate, mapped: Tensor, dtype: torch.dtype) -> Tensor:
    """What `Occupancy.query` asks on a card; a CPU is asked in fewer passes."""
    with torch.autocast("cpu", dtype):
        return gate.occupancy(mapped)


def bytes_of_twin(config: GateConfig) -> float:
    """Bytes a position that `Occupancy.occupied` moves in bfloat16 through unbounded space."""
    asked = Occupancy(Gate(config), Space("contraction"), 0.5, "bfloat16")
    counted = []
    for positions in (POSITIONS, 2 * POSITIONS):
        places = torch.zeros(positions, 3)
        with patch.object(occupancy, "occupancy_of", as_on_a_card), Traffic() as traffic:
            asked.occupied(places)
        counted.append(traffic.bytes)
    return (counted[1] - counted[0]) / POSITIONS  # without the weights
