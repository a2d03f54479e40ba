"""A gate's weights as its fused kernel reads them: three flat tensors and a few sizes.

Torch only. The layer norm's scale and shift are folded into the last layer, so that the kernel
multiplies the raw features and corrects for their mean and spread afterwards.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

MOST_COLUMNS = 64
"""Widest padded encoding, of sines and of cosines each, so that 20 octaves fit."""
MOST_WIDTH = 256
MOST_WIDTH_BUT_HOPPER = 128
"""Compiled for compute capability 8, a wider gate spills its registers by tens of kilobytes; 9 was
looked at, later ones were not."""
MOST_WIDTH_FLOAT32 = 64
"""Float32 products are no matrix instructions: compiled, a wider gate takes minutes and spills."""
MOST_LAYERS = 8
MOST_LOGITS = 64
READ = 4
"""Fields of `GateWeights` that a kernel reads; it is compiled for the others."""


class GateWeights(NamedTuple):
    """What the kernel is given beside positions.

    A matrix [in, out] stands row by row, padded with zeros to powers of two of at least 16.
    """

    facts: Tensor
    """float32 [12]: centre, half extent, walls (min, max), threshold, epsilon of the layer norm."""
    matrices: Tensor
    """bfloat16 or float32, flat: the first layer (for cosines, then for sines and coordinates), the
    other hidden layers, the last layer, and in bfloat16 what its rounding left over."""
    vectors: Tensor
    """float32, flat: the bias of each hidden layer, then the column sums and the bias of the last
    layer with the norm folded in."""
    seen: Tensor
    """uint8, flat: whether training rays cross each cell of `SeenSpace`."""
    octaves: int
    columns: int
    """Columns of the padded encoding, once for sines and once for cosines."""
    width: int
    padded_width: int
    layers: int
    logits: int
    padded_logits: int
    contracted: bool
    half: bool
    """Whether it multiplies in bfloat16."""

    @property
    def values(self) -> tuple[Tensor | int, ...]:
        """What a kernel reads, in the order of its parameters."""
        return self[:READ]

    @property
    def sizes(self) -> dict[str, Any]:
        """The constants that a kernel is compiled for, by name."""
        return {name.upper(): size for name, size in zip(self._fields[READ:], self[READ:])}


def why_not(occupancy: Any, most_width: int = MOST_WIDTH) -> str | None:
    """Why the kernel cannot hold the gate of a `cache.OccupancyLike`, or None if it can; the device
    takes none wider than `most_width`."""
    config = getattr(getattr(occupancy, "gate", None), "config", None)
    if config is None or not hasattr(occupancy, "precision"):
        return "it has no gate of this package"
    if occupancy.precision not in ("bfloat16", "float32"):
        return f"its gate is asked in {occupancy.precision}"
    if config.encoding.kind != "frequency":
        return f"its gate has {config.encoding.kind} features; the kernel knows frequencies only"
    for name, size, most in (
        ("frequency features", _columns(config.encoding.octaves), MOST_COLUMNS),
        ("width", config.width, most_width),
        ("layers", config.layers, MOST_LAYERS),
        ("logits", 1 + config.scene_experts, MOST_LOGITS),
    ):
        if size > most:
            return f"its gate has {name} {size}; the kernel holds {most}"
    return None


@torch.no_grad()
def gate_weights(occupancy: Any) -> GateWeights:
    """The weights of an occupancy for which `why_not` finds nothing, on its device."""
    with torch.autocast(occupancy.threshold_value.device.type, enabled=False):  # the host may be
        return _pack(occupancy)


def _pack(occupancy: Any) -> GateWeights:
    gate, space = occupancy.gate, occupancy.space
    config, half = gate.config, occupancy.precision == "bfloat16"
    octaves = config.encoding.octaves
    width, logits, columns = config.width, 1 + config.scene_experts, power_of_two(_columns(octaves))
    padded, padded_logits = power_of_two(width), power_of_two(logits)
    first, *others = (layer.weight.float().T for layer in gate.hidden)
    coordinates, sines, cosines = first.split([3, 3 * octaves, 3 * octaves])
    last = (gate.head.weight.float() * gate.norm.weight.float()).T
    matrices = [
        _pad(cosines, columns, padded),
        _pad(torch.cat([sines, coordinates]), columns, padded),
        *(_pad(matrix, padded, padded) for matrix in others),
    ]
    last = _pad(last, padded, padded_logits)
    rounded = last.to(torch.bfloat16).float()
    # a bfloat16 feature times a float32 weight, as two exact products of bfloat16
    matrices += [rounded, last - rounded] if half else [last]
    biases = [layer.bias.float() for layer in gate.hidden]
    biases = [bias.to(torch.bfloat16).float() if half else bias for bias in biases]
    constant = gate.head.weight.float() @ gate.norm.bias.float() + gate.head.bias.float()
    vectors = [
        *(_pad(bias[None], 1, padded) for bias in biases),
        last.sum(dim=0),
        _pad(constant[None], 1, padded_logits),
    ]
    facts = [space.center, space.half_extent, occupancy.walls, occupancy.threshold_value]
    facts.append(torch.full_like(space.half_extent, gate.norm.eps))
    return GateWeights(
        facts=torch.cat([fact.reshape(-1).float() for fact in facts]),
        matrices=_flat(matrices).to(torch.bfloat16 if half else torch.float32),
        vectors=_flat(vectors),
        seen=occupancy.seen.cells.reshape(-1).view(torch.uint8),
        octaves=octaves,
        columns=columns,
        width=width,
        padded_width=padded,
        layers=config.layers,
        logits=logits,
        padded_logits=padded_logits,
        contracted=space.kind == "contraction",
        half=half,
    )


def _columns(octaves: int) -> int:
    """Sines and coordinates of a position; of cosines there are three fewer."""
    return 3 * octaves + 3


def power_of_two(size: int) -> int:
    """The least power of two that is no less than `size` and 16, the least a tile may have."""
    return max(16, 1 << (size - 1).bit_length())


def _pad(matrix: Tensor, rows: int, columns: int) -> Tensor:
    height, width = matrix.shape
    return torch.nn.functional.pad(matrix, (0, columns - width, 0, rows - height))


def _flat(parts: list[Tensor]) -> Tensor:
    return torch.cat([part.reshape(-1) for part in parts])
