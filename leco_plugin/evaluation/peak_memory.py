"""The highest memory that a process and its CUDA allocator have held."""

from __future__ import annotations

import sys
from pathlib import Path

import torch

STATUS = Path("/proc/self/status")


def peak_process_bytes() -> int:
    """Highest resident memory of this process so far.

    The kernel's own mark where there is one: `getrusage` goes on counting from the process that
    started this one.
    """
    try:
        for line in STATUS.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass
    import resource

    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def peak_allocator_bytes() -> int | None:
    """Highest memory that tensors on CUDA have held; None without CUDA."""
    return int(torch.cuda.max_memory_allocated()) if torch.cuda.is_available() else None
