"""Splits the time of torch's profiler among named parts, forward and backward apart.

A part is a name around functions and modules. An operation belongs to the innermost part around it.
A backward operation belongs to the part whose forward has made its node: autograd numbers nodes in
the order in which they are made, and the profiler knows that number on both sides.
"""

from __future__ import annotations

import functools
import sys
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from typing import Any, NamedTuple
from unittest import mock

import torch
from torch.autograd import DeviceType
from torch.profiler import ProfilerActivity, profile, record_function

PREFIX = "part:"
REST = "rest"
EVALUATE = "autograd::engine::evaluate_function"
BACKWARD_SCOPE = 1
"""Of the profiler's events, those that autograd's engine calls."""
NO_NODE = -1


class Work(NamedTuple):
    """What a call cannot do without; sums of calls add up."""

    bytes: float = 0.0
    """Read and written by the forward pass, each value once."""
    operations: float = 0.0
    """Multiplications and additions of the forward pass."""
    backward_bytes: float = 0.0
    backward_operations: float = 0.0
    rays: int = 0
    samples: int = 0
    """Places at which the field is asked."""

    def plus(self, other: Work) -> Work:
        return Work(*map(sum, zip(self, other)))


class Parts:
    """Names functions by the part that they belong to, and sums the work of their calls."""

    def __init__(self) -> None:
        self.work: defaultdict[str, Work] = defaultdict(Work)
        self._counting: list[Callable[..., Work]] = []
        self._undo = ExitStack()

    def name(
        self, owner: Any, name: str, part: str, work: Callable[..., Work] | None = None
    ) -> None:
        """Names what `owner.name` does from now on, until `close`.

        Args:
            owner: a module, an object or a class.
            work: from the result of a call and its arguments to its work; calls inside of a call
                with the same `work` are a part of that one.
        """
        function = getattr(owner, name)

        @functools.wraps(function)
        def named(*args: Any, **kwargs: Any) -> Any:
            counts = work is not None and work not in self._counting
            self._counting += [work] if counts else []
            try:
                with record_function(PREFIX + part):
                    result = function(*args, **kwargs)
            finally:
                if counts:
                    self._counting.remove(work)
            if counts:
                self.work[part] = self.work[part].plus(work(result, *args, **kwargs))
            return result

        self._undo.enter_context(mock.patch.object(owner, name, named))

    def name_everywhere(
        self, function: Callable[..., Any], part: str, work: Callable[..., Work] | None = None
    ) -> None:
        """Names a function in all modules of the package that have imported it."""
        name = function.__name__
        for module in list(sys.modules.values()):
            ours = getattr(module, "__name__", "").startswith("leco_plugin.")
            if ours and vars(module).get(name) is function:
                self.name(module, name, part, work)

    def close(self) -> None:
        """Takes all names away."""
        self._undo.close()


class Times(NamedTuple):
    """Seconds of each part."""

    forward: dict[str, float]
    backward: dict[str, float]

    @property
    def total(self) -> float:
        return sum(self.forward.values()) + sum(self.backward.values())


def profiler() -> profile:
    """Of the device where there is one, else of the CPU."""
    kinds = [ProfilerActivity.CPU]
    return profile(activities=kinds + [ProfilerActivity.CUDA] * torch.cuda.is_available())


def split(events: Iterable[Any], of_device: bool) -> Times:
    """Seconds of each part.

    Args:
        events: of the profiler. What is in no part and no backward pass is left out, such as what
            another thread does meanwhile.
        of_device: whether the time of kernels on a GPU is wanted, in place of the CPU's.
    """
    roots = [e for e in events if e.cpu_parent is None and e.device_type == DeviceType.CPU]
    roots.sort(key=lambda event: event.time_range.start)
    found = [each for root in roots for each in _walk(root, None, None)]
    # an operation that makes no node shows the number of the next one, so the last one has made it
    makers = {
        event.sequence_nr: part
        for event, part, node in found
        if node is None and event.sequence_nr >= 0 and not event.name.startswith(PREFIX)
    }
    times = Times(defaultdict(float), defaultdict(float))
    for event, part, node in found:
        spent = event.self_device_time_total if of_device else event.self_cpu_time_total
        if node is not None:
            times.backward[part or makers.get(node) or REST] += spent * 1e-6
        elif part is not None:
            times.forward[part] += spent * 1e-6
    return times


def _walk(
    event: Any, part: str | None, node: int | None
) -> Iterator[tuple[Any, str | None, int | None]]:
    """An event and all inside of it, each with its part and the number of its backward node."""
    if event.name.startswith(PREFIX):
        part = event.name.removeprefix(PREFIX)
    elif event.scope == BACKWARD_SCOPE or event.name.startswith(EVALUATE):
        part = None
        if event.sequence_nr >= 0 or node is None:
            node = max(event.sequence_nr, NO_NODE)
    yield event, part, node
    for child in event.cpu_children:
        yield from _walk(child, part, node)
