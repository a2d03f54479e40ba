"""Routines in C for a CPU (`native.c`), compiled when first wanted.

A C compiler, where there is one, takes less than a second for them. Where there is none, and where
`LECO_KERNELS_OFF` names `native`, torch does the same work.
"""

from __future__ import annotations

import ctypes
import functools
import logging
import os
import shutil
import subprocess
import tempfile
import threading
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import torch
from torch import Tensor

from leco_plugin.samplers.kernels import kernels_off

SOURCE = Path(__file__).with_suffix(".c")
FLAGS = ("-O3", "-march=native", "-fno-math-errno", "-fno-trapping-math", "-shared", "-fPIC")
COMPILERS = ("cc", "gcc", "clang")
"""Tried in this order, after the one that the environment variable CC names."""
SECONDS = 60
"""That a compiler may take."""
FEWEST = 2048
"""Points that a thread of its own is worth."""

_log = logging.getLogger(__name__)


def has_native() -> bool:
    """Whether the routines are there, and not turned off."""
    return "native" not in kernels_off() and _library() is not None


@functools.cache
def _library() -> ctypes.CDLL | None:
    """The routines, or None with one line in the log that says why."""
    named = os.environ.get("CC", "").split()[:1]
    compiler = next(filter(None, map(shutil.which, (*named, *COMPILERS))), None)
    if compiler is None:
        _log.info("no C compiler: torch computes hash grids, some five times as slowly")
        return None
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder, "native.so")
        command = [compiler, *FLAGS, str(SOURCE), "-o", str(made), "-lm"]
        try:
            subprocess.run(command, check=True, capture_output=True, timeout=SECONDS)
            return ctypes.CDLL(str(made))
        except (OSError, subprocess.SubprocessError) as error:
            said = getattr(error, "stderr", None) or str(error).encode()
            why = (said.decode(errors="replace").strip().splitlines() or [type(error).__name__])[0]
            _log.info("%s cannot compile native.c, torch answers in its place: %s", compiler, why)
            return None


def suits(*tensors: Tensor) -> bool:
    """Whether the routines can take these: float32 on a CPU."""
    return all(one.device.type == "cpu" and one.dtype == torch.float32 for one in tensors)


def hash_sums(positions: Tensor, resolutions: Tensor, table: Tensor, corners: int) -> Tensor:
    """Features of a hash grid of L levels, without a graph.

    Args:
        positions: [N, 3] float32 in [0, 1].
        resolutions: [L] cells along the cube.
        table: [L 2^k, F] float32, level by level.
        corners: 4 interpolates over tetrahedra, 8 over cubes.
    Returns:
        [N, L F] float32.
    """
    levels, (rows, features) = len(resolutions), table.shape
    out = positions.new_empty(len(positions), levels * features)
    routine = _routine("hash_sums")
    positions, resolutions = positions.contiguous(), resolutions.float().contiguous()
    pointers = _pointers(positions, resolutions, table, out)
    sizes = (levels, _log2(rows // levels), features, corners)

    def work(begin: int, end: int) -> None:
        routine(*pointers, ctypes.c_int64(begin), ctypes.c_int64(end), *sizes)

    _in_threads(work, len(positions), len(positions) // FEWEST)
    return out


def hash_gradients(
    positions: Tensor, resolutions: Tensor, gradient: Tensor, rows: int, corners: int
) -> Tensor:
    """Gradient [rows, F] of the table, from that of `hash_sums`; no sum depends on the threads.

    Args:
        gradient: [N, L F] float32.
        rows: of the table; the others as in `hash_sums`.
    """
    levels = len(resolutions)
    features = gradient.shape[-1] // levels
    table = gradient.new_zeros(rows, features)
    routine = _routine("hash_gradients")
    positions, resolutions = positions.contiguous(), resolutions.float().contiguous()
    gradient = gradient.contiguous()
    pointers = _pointers(positions, resolutions, gradient, table)
    points, sizes = ctypes.c_int64(len(positions)), (levels, _log2(rows // levels))

    def work(begin: int, end: int) -> None:
        routine(*pointers, points, begin, end, *sizes, features, corners)

    _in_threads(work, levels, len(positions) // FEWEST)
    return table


def _routine(name: str) -> Callable[..., None]:
    library = _library()
    assert library is not None
    routine: Callable[..., None] = getattr(library, name)
    return routine


def _pointers(*tensors: Tensor) -> list[ctypes.c_void_p]:
    """Of contiguous tensors, which the caller keeps alive."""
    return [ctypes.c_void_p(one.data_ptr()) for one in tensors]


def _log2(size: int) -> int:
    return size.bit_length() - 1


def _in_threads(work: Callable[[int, int], None], count: int, most: int) -> None:
    """Calls `work` on consecutive parts of range(count), in as many threads as torch has.

    Args:
        most: threads that the work is worth.
    """
    threads = max(1, min(torch.get_num_threads(), most, count))
    cuts = [count * i // threads for i in range(threads + 1)]
    others = [threading.Thread(target=work, args=part) for part in pairwise(cuts[1:])]
    for other in others:
        other.start()
    work(cuts[0], cuts[1])
    for other in others:
        other.join()
