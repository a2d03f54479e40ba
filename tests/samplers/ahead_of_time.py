"""Compiling kernels as their launches would, for a device that is not here.

A launch of the package's own code goes through to Triton's compiler and its assembler, with the
types and alignments of the tensors it is given, and ends before anything runs.
"""

from __future__ import annotations

import os
import re
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

CAPABILITIES = (80, 90)
"""A100 and H100."""
AT_HOME = (86, 89, 120)
"""RTX 30, 40 and 50."""
SHARED = {80: 163 << 10, 90: 227 << 10} | dict.fromkeys(AT_HOME, 99 << 10)
"""Bytes of shared memory that one program may have."""


class Compiled(NamedTuple):
    """What the assembler says of a kernel."""

    registers: int
    """Of each thread."""
    spilled: int
    """Bytes of each thread that found no register."""
    shared: int
    """Bytes of a program."""


class Device:
    """What Triton asks of a driver before it launches."""

    def __init__(self, capability: int) -> None:
        self.capability = capability

    def get_current_target(self) -> Any:
        from triton.backends.compiler import GPUTarget

        return GPUTarget("cuda", self.capability, 32)

    def get_current_device(self) -> int:
        return self.capability

    def get_current_stream(self, device: int) -> int:
        return 0


class Launches:
    """Stands where a kernel is: compiles what is launched and launches nothing."""

    def __init__(self, kernel: Any) -> None:
        self.kernel, self.compiled = kernel, list[Compiled]()

    def __getitem__(self, grid: tuple[int, ...]) -> Callable[..., None]:
        def launch(*arguments: object, **constants: object) -> None:
            self.compiled.append(measured(self.kernel.warmup(*arguments, grid=grid, **constants)))

        return launch


@contextmanager
def compiling(module: Any, name: str, capability: int, cache: Path) -> Iterator[list[Compiled]]:
    """Within it launches of a kernel are compiled for a capability; what came of each."""
    import triton
    from triton.runtime.driver import driver

    kernel, active, folder = getattr(module, name), driver._active, triton.knobs.cache.dir
    launches = Launches(kernel)
    driver.set_active(Device(capability))
    triton.knobs.cache.dir = str(cache)
    setattr(module, name, launches)
    try:
        yield launches.compiled
    finally:
        setattr(module, name, kernel)
        triton.knobs.cache.dir = folder
        driver._active = active


def measured(kernel: Any) -> Compiled:
    """What the assembler says of a compiled kernel."""
    import triton

    tool = Path(triton.__file__).parent / "backends" / "nvidia" / "bin" / "cuobjdump"
    with tempfile.TemporaryDirectory() as folder:
        binary = Path(folder) / "kernel.cubin"
        binary.write_bytes(kernel.asm["cubin"])
        command = [os.fspath(tool), "-res-usage", os.fspath(binary)]
        said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    used = {name: int(value) for name, value in re.findall(r"(REG|STACK|LOCAL):(\d+)", said)}
    return Compiled(used["REG"], max(used["STACK"], used["LOCAL"]), kernel.metadata.shared)
