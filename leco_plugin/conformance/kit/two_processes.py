"""Two processes that train side by side on a CPU, as `--machine.num-devices 2` starts them."""

from __future__ import annotations

import os
import socket
import tempfile
import time
from collections.abc import Callable, Sequence
from datetime import timedelta
from pathlib import Path
from typing import Any

import torch
import torch.multiprocessing

from leco_plugin.conformance.rule import Broken, require

PATIENCE, PATIENCE_OF_A_RANK = 280.0, 120.0
"""Seconds in all, and seconds that a rank waits for the other: a busy machine takes a minute for
what an idle one does in five seconds."""

SERVER = "forkserver"
"""Starts processes that share what it has imported, and so takes those seconds only once."""


def on_two_ranks(work: Callable[[int], Any], imports: Sequence[str] = ("torch",)) -> list[Any]:
    """What a function returns on each of two ranks, which a process group connects meanwhile.

    Args:
        work: takes the rank; can be pickled, and returns what `torch.load` reads without unpickling
            foreign types.
        imports: modules that it needs and that take time to import.

    Raises:
        Broken: a rank failed, or the two wait for each other.
    """
    with tempfile.TemporaryDirectory() as folder:
        ranks = _started(work, imports, folder)
        deadline = time.monotonic() + PATIENCE
        try:
            while not ranks.join(timeout=1.0):
                require(time.monotonic() < deadline, f"the ranks hang: no end after {PATIENCE:g} s")
        except torch.multiprocessing.ProcessRaisedException as error:
            raise Broken(f"a rank failed: {str(error).strip().splitlines()[-1]}") from error
        finally:
            for process in ranks.processes:
                process.kill()
        return [torch.load(_left_by(rank, folder), weights_only=True) for rank in range(2)]


def _started(work: Callable[[int], Any], imports: Sequence[str], folder: str) -> Any:
    """Both processes, at their work."""
    methods = torch.multiprocessing.get_all_start_methods()
    if SERVER in methods:
        torch.multiprocessing.set_forkserver_preload(list(imports))
    before = os.environ.get("PYTHONWARNINGS")
    os.environ["PYTHONWARNINGS"] = "ignore"  # what they import has said its own in this process
    try:
        return torch.multiprocessing.start_processes(
            _rank,
            args=(work, folder),
            nprocs=2,
            join=False,
            start_method=SERVER if SERVER in methods else "spawn",
        )
    finally:
        del os.environ["PYTHONWARNINGS"]
        if before is not None:
            os.environ["PYTHONWARNINGS"] = before


def _left_by(rank: int, folder: str) -> Path:
    return Path(folder) / f"rank-{rank}.pt"


def _rank(rank: int, work: Callable[[int], Any], folder: str) -> None:
    """What each process does, with its own random numbers."""
    torch.set_num_threads(1)
    torch.manual_seed(rank)
    loopback = {"lo", "lo0"} & {interface for _, interface in socket.if_nameindex()}
    for interface in loopback:  # a machine need not be able to look up its own name
        os.environ.setdefault("GLOO_SOCKET_IFNAME", interface)
    torch.distributed.init_process_group(
        "gloo",
        init_method=(Path(folder) / "store").as_uri(),
        rank=rank,
        world_size=2,
        timeout=timedelta(seconds=PATIENCE_OF_A_RANK),
    )
    torch.save(work(rank), _left_by(rank, folder))
    torch.distributed.destroy_process_group()
