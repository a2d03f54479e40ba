"""Checks of sizes: contradictory counts, and more memory than the device has."""

from __future__ import annotations

from pathlib import Path

import psutil
import torch

from leco_plugin.models.field import HMoEField
from leco_plugin.models.gate import LARGEST_SIZES, Gate, check_sizes
from leco_plugin.models.sizing.sizes import CLI, Sizes

BYTES_PER_VALUE = 16
"""A float32 weight, its gradient, and the two moments of Adam."""
LARGEST_IN_FIELD = {**LARGEST_SIZES, "log2_table": 28}
"""Of the field, which no file has to hold."""


def values_of(sizes: Sizes, images: int) -> int:
    """Learned values of gate and field together.

    Args:
        images: training photographs, which have codes of their own.
    """
    with torch.device("meta"):
        modules = Gate(sizes.gate), HMoEField(sizes.field, images)
    return sum(p.numel() for module in modules for p in module.parameters())


def state_bytes(sizes: Sizes, images: int) -> int:
    """What training gate and field takes for weights and optimizer."""
    return BYTES_PER_VALUE * values_of(sizes, images)


def check(sizes: Sizes) -> None:
    """Refuses what cannot be built, before anything of it is allocated.

    Raises:
        ValueError: in one line, what does not go together and what to change.
    """
    check_sizes(sizes.gate)
    _check_field(sizes)
    for name in ("candidates", "learn_candidates"):
        if getattr(sizes, name) < 1:
            raise ValueError(f"{CLI}.{name.replace('_', '-')} is {getattr(sizes, name)}, below 1")
    if sizes.gate.scene_experts > sizes.field.experts.scene_experts:
        raise ValueError(
            f"the gate sends points to {sizes.gate.scene_experts} scene experts and the field has "
            f"{sizes.field.experts.scene_experts}: set {CLI}.gate.scene-experts and "
            f"{CLI}.field.experts.scene-experts alike, or only one of them"
        )


def check_memory(sizes: Sizes, images: int, memory: int) -> None:
    """Refuses what cannot be trained, before anything of it is allocated.

    Args:
        images: training photographs.
        memory: bytes of the device.
    Raises:
        ValueError: in one line, what is needed and what there is.
    """
    needed = state_bytes(sizes, images)
    if needed > memory:
        raise ValueError(
            f"training gate and field of these sizes takes {needed / 1e9:.1f} GB for weights and "
            f"optimizer alone, and the device has {memory / 1e9:.1f}: lower "
            f"{CLI}.field.encoding.log2-table"
        )


def _check_field(sizes: Sizes) -> None:
    encoding, experts = sizes.field.encoding, sizes.field.experts
    parts = {**vars(encoding), **{k: getattr(experts, k) for k in ("width", "layers")}}
    parts["scene_experts"] = experts.scene_experts
    for name, largest in LARGEST_IN_FIELD.items():
        if type(parts[name]) is not int or not 0 < parts[name] <= largest:
            raise ValueError(f"the field's {name} is {parts[name]!r}, not in 1 to {largest}")
    if encoding.kind == "hash":
        if encoding.finest < encoding.coarsest:
            raise ValueError(
                f"the field's finest level has {encoding.finest} cells and its coarsest "
                f"{encoding.coarsest}: raise {CLI}.field.encoding.finest"
            )
        if encoding.levels << encoding.log2_table >= 2**31:
            raise ValueError(
                f"{encoding.levels} levels of 2^{encoding.log2_table} entries are more than rows "
                f"can be numbered: lower {CLI}.field.encoding.log2-table"
            )


def memory_of(device: torch.device | str, group: Path = Path("/sys/fs/cgroup")) -> int | None:
    """Total bytes of a device's memory, used or free; on a CPU within a container's limit.

    None where it is not known.
    """
    device = torch.device(device)
    if device.type == "cuda":
        return int(torch.cuda.get_device_properties(device).total_memory)
    if device.type != "cpu":
        return None
    memory = int(psutil.virtual_memory().total)
    try:
        return min(memory, int((group / "memory.max").read_text()))
    except (OSError, ValueError):  # no container, or one without a limit
        return memory
