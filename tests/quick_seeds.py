"""Imported before tests seed torch, which then takes microseconds and not milliseconds.

Until there is a GPU, torch keeps each seed for it with a list of the whole call stack, three times;
the call stack of a test is long.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import torch.mtia
import torch.xpu


def _no_stack() -> list[str]:
    return []


for _device in (torch.cuda, torch.mtia, torch.xpu):
    _named: Any = _device
    _named.traceback = SimpleNamespace(format_stack=_no_stack)
