"""Imported before nerfstudio, which then takes less than half as long to import.

For each of the methods that it offers to install, it lists the call stack with all sources, of
which it wants one name; and it prepares to compile a function of `splatfacto`, which no test calls.
At its end a process does not search what was imported for unused cycles, which takes two seconds.
"""

from __future__ import annotations

import atexit
import gc
import sys
from types import SimpleNamespace
from typing import Any

from nerfstudio.configs import external_methods
from nerfstudio.utils import misc


def _stack() -> list[Any]:
    """As `inspect.stack`, with the names of functions alone."""
    frame, found = sys._getframe(1), []
    while frame is not None:
        found.append(SimpleNamespace(function=frame.f_code.co_name))
        frame = frame.f_back  # type: ignore[assignment]
    return found


external_methods.inspect = SimpleNamespace(stack=_stack)
atexit.register(gc.freeze)
misc.torch_compile = lambda *_, **__: lambda function: function
