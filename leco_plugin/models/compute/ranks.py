"""Agreement between the processes of a data-parallel run; a run of one process needs none.

Each process trains on its own rays. Gradients are averaged, so that all weights stay the same.
Measurements and random draws would differ, so all processes use those of the first one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TypeVar

import torch
from torch import Tensor, distributed, nn
from torch.nn.parallel import DistributedDataParallel

T = TypeVar("T")


def is_distributed() -> bool:
    """Whether the run has several processes."""
    known = distributed.is_available() and distributed.is_initialized()
    return known and distributed.get_world_size() > 1


def is_first() -> bool:
    """Whether this is the process that decides, writes files and logs."""
    return not is_distributed() or distributed.get_rank() == 0


@torch.no_grad()
def share(tensors: Iterable[Tensor]) -> None:
    """Gives the tensors of every process the values they have in the first one, in place: of any
    types, equally shaped everywhere, with NCCL on the device of the process."""
    if not is_distributed():
        return
    for tensor in tensors:
        values = tensor.detach().contiguous()
        # as bytes: not every release's gloo knows every type
        distributed.broadcast(values.view(-1).view(torch.uint8), src=0)
        if not tensor.is_contiguous():
            tensor.copy_(values)


def from_first(make: Callable[[], T], device: torch.device) -> T:
    """What `make` returns in the first process, plain values; the others wait and do not call it.
    `device` is that of this process."""
    if not is_distributed():
        return make()
    made = [make() if is_first() else None]
    distributed.broadcast_object_list(made, src=0, device=device)
    return made[0]  # type: ignore[return-value]


def mean(value: float, device: torch.device) -> float:
    """Mean of a number over all processes, the same to the last bit in each."""
    if not is_distributed():
        return value
    total = torch.tensor(value, dtype=torch.float64, device=device)
    distributed.all_reduce(total)
    return float(total) / distributed.get_world_size()


def averaging(model: nn.Module, device: torch.device) -> nn.Module:
    """The model as one to train with: its weights become those of the first process, and gradients
    after `backward` are the mean over all processes."""
    if not is_distributed():
        return model
    numbers = None if device.type == "cpu" else [device.index]
    return DistributedDataParallel(model, device_ids=numbers, find_unused_parameters=True)
