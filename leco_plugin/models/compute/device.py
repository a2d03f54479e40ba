"""A device: its fastest precision, its memory, and how freed memory is kept."""

from __future__ import annotations

import ctypes
import os
from pathlib import Path

import torch

from leco_plugin.models.compute.native import has_native
from leco_plugin.occupancy import Precision

GROUP = Path("/sys/fs/cgroup")
"""Where a container's limits stand."""


def fast_precision(device: torch.device | str) -> Precision:
    """bfloat16 where the hardware multiplies it faster than float32.

    On CUDA that is Ampere and later. On x86 it is what has AMX (9 times faster in torch), and what
    has AVX-512 with bfloat16 (2.7 times) unless routines in C do the work: those are faster still,
    in float32. Elsewhere it is emulated and slower.
    """
    kind = torch.device(device).type
    if kind == "cuda":
        return "bfloat16" if torch.cuda.is_bf16_supported(including_emulation=False) else "float32"
    if kind == "cpu":
        half = _has("amx_tile") or (_has("avx512_bf16") and not has_native())
        return "bfloat16" if half else "float32"
    return "float32"


def _has(feature: str) -> bool:
    # private in torch, so it may go; without it the answer is the safe one
    supported = getattr(torch.cpu, f"_is_{feature}_supported", lambda: False)
    return bool(supported())


def keep_freed_memory(device: torch.device | str = "cpu") -> None:
    """On a CPU, tells glibc to keep large freed blocks for the next step instead of unmapping them.

    A step allocates and frees the same few large tensors; mapping them anew costs a page fault for
    each 4 kB. All threads share one arena: that of another thread holds no large blocks, and the
    viewer, which draws in one, spent half of its time on page faults.

    Acts on this process; does nothing where the C library is not glibc.
    """
    if torch.device(device).type != "cpu":
        return
    try:
        mallopt = ctypes.CDLL("libc.so.6").mallopt
    except (OSError, AttributeError):
        return
    m_trim_threshold, m_mmap_threshold, m_arena_max = -1, -3, -8
    mallopt(m_mmap_threshold, 1 << 30)
    mallopt(m_trim_threshold, (1 << 31) - 1)
    mallopt(m_arena_max, 1)


def memory_of(device: torch.device | str, group: Path = GROUP) -> int | None:
    """Total bytes of a device's memory, used or free; on a CPU within a container's limit.

    None where it is not known.
    """
    device = torch.device(device)
    if device.type == "cuda":
        return int(torch.cuda.get_device_properties(device).total_memory)
    if device.type != "cpu":
        return None
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    limit = _number_in(group / "memory.max")
    return memory if limit is None else min(memory, limit)


def free_memory(meminfo: Path = Path("/proc/meminfo"), group: Path = GROUP) -> int | None:
    """Bytes that this process may still take, a container's limit included; None if unknown."""
    limits = [1024 * kilobytes for kilobytes in _fields_of(meminfo, "MemAvailable:")]
    most, taken = _number_in(group / "memory.max"), _number_in(group / "memory.current")
    if most is not None and taken is not None:
        # the system takes back the cache of files when asked
        cached = sum(_fields_of(group / "memory.stat", "active_file", "inactive_file"))
        limits.append(most - taken + cached)
    return min(limits, default=None)


def _number_in(file: Path) -> int | None:
    """What a file says; None where it is not there, or says `max`, which is no limit."""
    try:
        return int(file.read_text())
    except (OSError, ValueError):
        return None


def _fields_of(file: Path, *names: str) -> list[int]:
    """Of a file with a name and a number in each line; none where it cannot be read."""
    try:
        rows = [line.split() for line in file.read_text().splitlines()]
        return [int(row[1]) for row in rows if row and row[0] in names]
    except (OSError, ValueError, IndexError):
        return []
