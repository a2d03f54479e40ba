"""Two processes that train side by side on a CPU, as `--machine.num-devices 2` starts them."""

from __future__ import annotations

import os
import socket
import tempfile
import time
from datetime import timedelta
from pathlib import Path

import torch
import torch.multiprocessing
from torch import nn

from leco_plugin.conformance.rule import Broken, require
from leco_plugin.conformance.sampler_case import SamplerCase
from leco_plugin.conformance.scene import SLAB, Field, Rays, crossing
from leco_plugin.samplers.marching import Samples

PATIENCE, PATIENCE_OF_A_RANK = 280.0, 120.0
"""Seconds in all, and seconds that a rank waits for the other: a busy machine takes a minute for
what an idle one does in five seconds."""


def on_two_ranks(case: SamplerCase) -> list[Samples]:
    """Samples of the same rays in evaluation, of each rank, after a training step.

    Each process finds the sampler anew by its name.

    Raises:
        Broken: a rank failed, or the two wait for each other.
    """
    with tempfile.TemporaryDirectory() as folder:
        ranks = torch.multiprocessing.spawn(
            _rank, args=(type(case), case.name, folder), nprocs=2, join=False
        )
        require(ranks is not None, "no processes could be started")
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


def _left_by(rank: int, folder: str) -> Path:
    return Path(folder) / f"rank-{rank}.pt"


def _rank(rank: int, kind: type[SamplerCase], name: str, folder: str) -> None:
    """What each process does: one step on its own rays with its own random numbers."""
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
    case, rays = kind(name), crossing()
    sampler = case.shared(SLAB).train()
    own = Rays(*(tensor[rank::2] for tensor in rays))
    case.colours(sampler, own, Field()).sum().backward()
    _share(sampler)
    samples = case.sample(sampler.eval(), rays, seed=rank)
    torch.save(samples, _left_by(rank, folder))
    torch.distributed.destroy_process_group()


def _share(sampler: nn.Module) -> None:
    """What data-parallel training does before each step: all ranks take what rank 0 holds."""
    for tensor in (*sampler.parameters(), *sampler.buffers()):
        held = tensor.detach().clone(memory_format=torch.contiguous_format)
        torch.distributed.broadcast(held, src=0)
        tensor.detach().copy_(held)
