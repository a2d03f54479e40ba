"""Routines in C for a CPU (the `.c` files beside this one), compiled when first wanted.

A C compiler, where there is one, takes some four seconds for them, once for a machine (see
`compiling.py`). Where there is none, and where `LECO_KERNELS_OFF` names `native`, torch does the
same work.
"""

from __future__ import annotations

import ctypes
import functools
import logging
import os
import shlex
import shutil
import subprocess
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from leco_plugin.models.compute.compiling import compiled
from leco_plugin.samplers.kernels import kernels_off

SOURCES = sorted(Path(__file__).parent.glob("*.c"))
FLAGS = (
    *("-O3", "-march=native", "-fno-math-errno", "-fno-trapping-math", "-fopenmp-simd"),
    *("-shared", "-fPIC"),
)
COMPILERS = ("cc", "gcc", "clang")
"""Tried in this order, after the one that the environment variable CC names."""
WIDEST = 512
"""Features of a layer, at most: `networks.c` has room for so many."""
FEWEST = 2048
"""Points that a thread of its own is worth."""
RAYS_AT_ONCE = 512
"""Rays that a thread renders before it takes others: some take longer than others."""

Values = dict[str, Tensor | Sequence[Tensor | None] | int | float | None]
"""Of a structure in C: pointers, arrays of pointers, ints, floats; None is a null pointer."""

_log = logging.getLogger(__name__)


def has_native() -> bool:
    """Whether the routines are there, and not turned off."""
    return "native" not in kernels_off() and _library() is not None


@functools.cache
def _library() -> ctypes.CDLL | None:
    """The routines, or None with one line in the log that says why."""
    named = shlex.split(os.environ.get("CC", ""))
    known = ([name] for name in COMPILERS if shutil.which(name))
    compiler = named if named and shutil.which(named[0]) else next(known, None)
    if compiler is None:
        _log.info("no C compiler: torch does all the work, some twice as slowly")
        return None
    try:
        return compiled([*compiler, *FLAGS], SOURCES)
    except (OSError, subprocess.SubprocessError) as error:
        said = getattr(error, "stderr", None) or str(error).encode()
        why = (said.decode(errors="replace").strip().splitlines() or [type(error).__name__])[0]
        _log.warning("%s fails: torch does all the work, more slowly: %s", compiler[0], why)
        return None


def suits(*tensors: Tensor) -> bool:
    """Whether the routines can take these, and are there: float32 on a CPU."""
    known = all(one.device.type == "cpu" and one.dtype == torch.float32 for one in tensors)
    return known and has_native()


def suits_networks(points: Sequence[Tensor], parts: Sequence[Tensor | None]) -> bool:
    """Whether networks of these weights and biases may be asked about points in C, and learn: as
    `suits`, weights are contiguous, and nobody wants products in halves."""
    known = [part for part in parts if part is not None]
    readable = all(part.is_contiguous() for part in known)
    return readable and not torch.is_autocast_enabled("cpu") and suits(*points, *known)


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
    positions, table = positions.contiguous(), table.contiguous()
    resolutions = resolutions.float().contiguous()
    pointers = pointers_to(positions, resolutions, table, out)
    sizes = (levels, log2_of(rows // levels), features, corners)
    of_points("hash_sums", pointers, len(positions), sizes)
    return out


def of_points(name: str, before: Sequence[Any], count: int, after: Sequence[Any]) -> None:
    """Calls a routine on parts of so many points; where a part begins and ends stands between its
    other arguments."""
    routine = routine_of(name)

    def work(begin: int, end: int) -> None:
        routine(*before, ctypes.c_int64(begin), ctypes.c_int64(end), *after)

    in_threads(work, count, count // FEWEST)


def hash_gradients(
    positions: Tensor, resolutions: Tensor, gradient: Tensor, rows: int, corners: int
) -> Tensor:
    """Gradient [rows, F] of the table, from that of `hash_sums`, [N, L F] float32; other arguments
    as there. No sum depends on the threads."""
    levels = len(resolutions)
    features = gradient.shape[-1] // levels
    table = gradient.new_zeros(rows, features)
    routine = routine_of("hash_gradients")
    positions, resolutions = positions.contiguous(), resolutions.float().contiguous()
    gradient = gradient.contiguous()
    pointers = pointers_to(positions, resolutions, gradient, table)
    points, sizes = ctypes.c_int64(len(positions)), (levels, log2_of(rows // levels))

    def work(begin: int, end: int) -> None:
        routine(*pointers, points, begin, end, *sizes, features, corners)

    in_threads(work, levels, len(positions) // FEWEST)
    return table


def call_along_rays(name: str, rooms: Tensor, *given: Values) -> list[slice]:
    """Calls a routine on parts of a batch of rays: `front_to_back`, or `march_cells`.

    Args:
        rooms: [R] int64, where the samples of each ray have room.
        given: what the structures hold that the routine is given, in the same order: `Scene` and
            `Batch` of front_to_back.c, or `March` of march.c. Tensors are contiguous.
    Returns:
        Where in the tensors of samples those lie that the routine wrote, in the order of the rays.
    """
    routine = routine_of(name)
    routine.restype = ctypes.c_int64  # type: ignore[attr-defined]
    structures = [_structure(values) for values in given]
    pointers = [ctypes.byref(one) for one in structures]
    found: dict[int, Any] = {}

    def work(begin: int, end: int) -> None:
        found[begin] = routine(*pointers, ctypes.c_int64(begin), ctypes.c_int64(end))

    in_threads(work, len(rooms), len(rooms) // RAYS_AT_ONCE, RAYS_AT_ONCE)
    if min(found.values()) < 0:
        raise MemoryError("no memory for a batch of rays")
    firsts = rooms[sorted(found)].tolist()
    return [slice(first, first + found[ray]) for first, ray in zip(firsts, sorted(found))]


def _structure(values: Values) -> ctypes.Structure:
    """In C, of values that the caller keeps alive."""
    made: dict[str, tuple[Any, Any]] = {}
    for name, value in values.items():
        if value is None or isinstance(value, Tensor):
            made[name] = ctypes.c_void_p, None if value is None else value.data_ptr()
        elif isinstance(value, Sequence):
            made[name] = ctypes.POINTER(ctypes.c_void_p), addresses_of(value)
        else:
            made[name] = ctypes.c_int if isinstance(value, int) else ctypes.c_float, value
    fields = [(name, kind) for name, (kind, _) in made.items()]
    structure = type("Values", (ctypes.Structure,), {"_fields_": fields})
    return structure(**{name: value for name, (_, value) in made.items()})


def addresses_of(parts: Sequence[Tensor | None]) -> ctypes.Array[ctypes.c_void_p]:
    """Of contiguous tensors, which the caller keeps alive."""
    return (ctypes.c_void_p * len(parts))(
        *(None if one is None else one.data_ptr() for one in parts)
    )


def routine_of(name: str) -> Callable[..., None]:
    library = _library()
    assert library is not None
    routine: Callable[..., None] = getattr(library, name)
    return routine


def pointers_to(*tensors: Tensor) -> list[ctypes.c_void_p]:
    """Of contiguous tensors, which the caller keeps alive."""
    return [ctypes.c_void_p(one.data_ptr()) for one in tensors]


def log2_of(size: int) -> int:
    """Of a power of two, as a level of a hash table has rows."""
    return size.bit_length() - 1


def in_threads(
    work: Callable[[int, int], None], count: int, most: int, at_once: int | None = None
) -> None:
    """Calls `work` on consecutive parts of range(count), in as many threads as torch has.

    Args:
        most: threads that the work is worth.
        at_once: size of a part; None is one part for each thread.
    """
    threads = max(1, min(torch.get_num_threads(), most, count))
    parts = threads if at_once is None else max(1, -(-count // at_once))
    cuts = [count * i // parts for i in range(parts + 1)]
    left = iter(list(pairwise(cuts)))

    def take() -> None:
        for part in left:
            work(*part)

    if threads == 1:
        take()
        return
    # leaving waits for all: nothing is freed that a thread still writes
    with ThreadPoolExecutor(threads - 1) as pool:
        others = [pool.submit(take) for _ in range(threads - 1)]
        take()
    for other in others:
        other.result()
