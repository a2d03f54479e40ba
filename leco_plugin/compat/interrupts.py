"""Ctrl-C lets a run finish its step, so that what is saved then is whole; twice ends it at once."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

HEARD = "\nstopping after this step; Ctrl-C once more stops at once\n"


@contextmanager
def heard_between_steps() -> Iterator[threading.Event]:
    """An event that the first Ctrl-C sets; the second one is a `KeyboardInterrupt` as ever.

    Outside of the main thread, which alone hears signals, and where somebody else listens already,
    nothing is changed.
    """
    asked = threading.Event()
    before: Any = signal.getsignal(signal.SIGINT)
    in_main = threading.current_thread() is threading.main_thread()
    if not in_main or before is not signal.default_int_handler:
        yield asked
        return

    def hear(number: int, frame: Any) -> None:
        if asked.is_set():
            before(number, frame)
        asked.set()
        os.write(2, HEARD.encode())  # nothing that might hold a lock just now

    signal.signal(signal.SIGINT, hear)
    try:
        yield asked
    finally:
        signal.signal(signal.SIGINT, before)
