"""What a device leaves to the CPU: small values that decide, and sums where it has no float64."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.utils.weak import WeakIdKeyDictionary

_known = WeakIdKeyDictionary()
"""For each tensor: how many writes torch had counted, and its values then, on the CPU."""


def on_cpu(tensor: Tensor) -> Tensor:
    """The values of a small buffer, to be read only. They are copied, which waits for its device,
    only if torch has counted a write since the last copy; `samplers.base.Snapshot` names the writes
    that it does not count."""
    if tensor.device.type == "cpu":
        return tensor
    if tensor.is_inference():  # no write is counted
        return tensor.cpu()
    known = _known.get(tensor)
    if known is None or known[0] != tensor._version:
        known = _known[tensor] = tensor._version, tensor.cpu()
    values: Tensor = known[1]
    return values


def has_float64(device: torch.device) -> bool:
    """Whether a device computes in float64; Apple's GPUs do not."""
    return device.type != "mps"


def in_float64(tensor: Tensor) -> Tensor:
    """A tensor in float64, on the CPU where its device has none."""
    return tensor.double() if has_float64(tensor.device) else tensor.cpu().double()
