"""nerfacc's grid beside ours, where it is installed and its kernels are there or are built in time.

They are built at first use, which takes minutes and may wait for ever on what a build that was
killed has left. So another process builds them, and is given up after a while.
"""

from __future__ import annotations

import functools
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from typing import Any

BUILD = "from nerfacc.cuda._backend import _C; raise SystemExit(_C is None)"
BUILD_SECONDS = 30.0
"""For nerfacc's kernels to be built or found."""
GRACE = 5.0
"""Seconds to end in, for a build that took too long: it then leaves no lock behind."""


def nerfacc_grid(ours: Any, sample: Callable[[Any], Any]) -> Any:
    """nerfacc's grid with the same cells marked, or None where it does not sample.

    On a CPU it samples by this package's functions in place of its kernels.
    """
    try:
        import nerfacc

        from leco_plugin.samplers import nerfacc_cpu

        if ours.device.type == "cuda" and (trouble := trouble_with_kernels()):
            raise RuntimeError(trouble)  # CUDA only
        nerfacc_cpu.install()
        box, resolution = ours.aabbs[0].cpu(), int(ours.resolution[0])
        grid = nerfacc.OccGridEstimator(box, resolution=resolution, levels=ours.levels)
        grid = grid.to(ours.device).eval()
        grid.binaries.copy_(ours.binaries)
        sample(grid)
    except Exception as error:  # noqa: BLE001 - the build of somebody else's kernels raises anything
        reason = next(iter(str(error).splitlines()), type(error).__name__)
        print(f"no comparison with nerfacc: {reason}")
        return None
    return grid


@functools.cache
def trouble_with_kernels() -> str | None:
    """Why nerfacc's kernels are not there, or None if they are; found out once."""
    return trouble_with([sys.executable, "-c", BUILD], BUILD_SECONDS)


def trouble_with(command: list[str], limit: float) -> str | None:
    """Runs what builds kernels, with all that it starts, for so many seconds at most.

    Returns:
        Why there are none, or None if there are.
    """
    with subprocess.Popen(
        command,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    ) as process:
        try:
            return "its kernels cannot be built" if process.wait(limit) else None
        except subprocess.TimeoutExpired:
            end(process)
    return f"its kernels are not built after {limit:g} s"


def end(process: subprocess.Popen[bytes]) -> None:
    """Ends a process and all that it has started."""
    os.killpg(process.pid, signal.SIGINT)
    try:
        process.wait(GRACE)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
