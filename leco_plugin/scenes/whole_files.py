"""Files that appear under their names only when they are whole, however a process ends."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

PART = ".part"
"""How the names of unfinished files end."""


def write_whole(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Lets `write` fill a file beside `path` and then moves it there; folders are made.

    Several processes may do the same at once: the last one wins.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}-{threading.get_ident()}{PART}")
    try:
        with part.open("wb") as file:
            write(file)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def remove_parts(folder: Path) -> None:
    """Deletes what killed processes left half written in a folder and those below it."""
    for part in folder.rglob(f".*{PART}"):
        part.unlink(missing_ok=True)
