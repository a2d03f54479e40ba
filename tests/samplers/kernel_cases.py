"""What the tests of kernels share: where they run, and occupancies with gates of every size.

In Triton's interpreter on a CPU when TRITON_INTERPRET=1 stands in the environment, which
`test_kernels_interpreted.py` sees to; else compiled, on a GPU.
"""

from __future__ import annotations

import os

import pytest
import torch

from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.gate import Gate, GateConfig
from leco_plugin.occupancy import Occupancy
from leco_plugin.samplers.kernels.fused import _why_not
from leco_plugin.space import Space

INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"
DEVICE = "cpu" if INTERPRETED else "cuda"
ON_KERNELS = (
    # numpy says so of the interpreter's arithmetic on places that no scene has
    pytest.mark.filterwarnings("ignore:(overflow|invalid value) encountered:RuntimeWarning")
    if INTERPRETED
    else pytest.mark.gpu
)
"""The mark of a file whose tests need kernels."""

PLACES = 160 if INTERPRETED else 300
"""Two blocks of a kernel, the second one ragged; the interpreter takes milliseconds for each."""

NEAR_THRESHOLD = {"float32": 2e-4, "bfloat16": 2e-2}
"""How far from the threshold o may lie where a kernel decides otherwise than its twin."""


def occupancy(
    kind: str = "box",
    precision: str = "bfloat16",
    *,
    width: int = 32,
    layers: int = 2,
    octaves: int = 4,
    experts: int = 4,
    seed: int = 0,
    walls: list[float] | None = None,
    unseen: bool = False,
) -> Occupancy:
    """A gate of random weights, twice the usual size, whose threshold halves what is inside.

    Args:
        unseen: whether no ray has crossed half of its cells.
    """
    torch.manual_seed(seed)
    gate = Gate(GateConfig(EncodingConfig(octaves=octaves), width, layers, experts))
    with torch.no_grad():
        for parameter in gate.parameters():
            parameter.mul_(2.0)
        gate.norm.weight.add_(torch.randn(width) * 0.3)
        gate.norm.bias.add_(torch.randn(width) * 0.3)
    space = Space(kind, (0.1, 0.2, -0.3), 1.5)
    made = Occupancy(
        gate, space, 0.0, precision, walls=None if walls is None else torch.tensor(walls)
    )
    if unseen:
        made.seen.cells.bernoulli_(0.5)
    made = made.to(DEVICE).eval()
    values = made.query(positions(2000))
    made.threshold_value.copy_(values[values > 0.0].median())
    return made


def left_to_torch(asked: Occupancy) -> str | None:
    """Why this device gets no kernel for a gate; the interpreter takes them all."""
    return None if INTERPRETED else _why_not(asked, torch.device(DEVICE))


def positions(count: int, spread: float = 1.5, seed: int = 1) -> torch.Tensor:
    """Scene positions inside and outside of the space above, [count, 3]."""
    generator = torch.Generator().manual_seed(seed)
    return (torch.randn(count, 3, generator=generator) * spread).to(DEVICE)
