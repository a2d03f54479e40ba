"""Counting, on any machine, what would wait for a device."""

from __future__ import annotations

from typing import Any

import torch
from torch.overrides import TorchFunctionMode

WAITING = {"tolist", "item", "nonzero", "equal", "__bool__", "__int__", "__float__", "__index__"}


class Waits(TorchFunctionMode):
    """Within it, the names of calls whose result depends on what a device holds."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[str] = []

    def __torch_function__(
        self, function: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        name = function.__name__
        masked = name == "__getitem__" and getattr(args[1], "dtype", None) == torch.bool
        if name in WAITING or masked:
            self.seen.append(name)
        return function(*args, **(kwargs or {}))
