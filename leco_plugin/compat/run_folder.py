"""One run in a folder at a time, and none over another's checkpoints.

A new run deletes whatever checkpoints it finds in its folder as soon as it saves one of its own.
"""

from __future__ import annotations

import atexit
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from leco_plugin.compat.whole_checkpoints import step_of
from leco_plugin.scenes.input_error import InputError

try:
    import fcntl as _fcntl

    fcntl: Any = _fcntl
except ImportError:  # Windows has no such locks: there only checkpoints are looked for
    fcntl = None

LOCK = ".running"
"""File that a run holds locked; the system lets go of it however the run ends, and one that ends by
itself takes it away where there are such locks."""

_held: dict[Path, int] = {}
"""Descriptors of this process's locks, by folder."""


def claim(folder: Path, checkpoints: Path, load_from: Path | None) -> str | None:
    """Takes a folder for the run of this process until it ends; returns why it cannot be had.

    Args:
        folder: of the run; made where it is missing.
        checkpoints: where the run saves.
        load_from: folder or file that the run resumes from; None is a new run.
    """
    place = folder.resolve()
    if place not in _held:
        folder.mkdir(parents=True, exist_ok=True)
        held = lock(folder)
        if held is None:
            return f"another run is going on in {folder}"
        if not _held:
            atexit.register(_release_all, os.getpid())
        _held[place] = held
    theirs = [path for path in checkpoints.glob("*.ckpt") if step_of(path) >= 0]
    if theirs and (load_from is None or not _goes_on(load_from, checkpoints)):
        release(folder)
        return f"{folder} holds an earlier run, with which this one does not go on"
    return None


def release(folder: Path) -> None:
    """Lets go of a folder before the process ends."""
    held = _held.pop(folder.resolve(), None)
    if held is not None:
        _unlock(folder, held)


def _release_all(process: int) -> None:
    """When a process ends; one that was forked from it has nothing to let go of."""
    if os.getpid() == process:
        for folder in list(_held):
            release(folder)


@contextmanager
def alone_in(folder: Path, work: str) -> Iterator[None]:
    """Keeps a folder from every other process that would make the same runs in it.

    Args:
        folder: made where it is missing.
        work: what is made there, for the message.
    Raises:
        InputError: another process is at work there, or it is no folder.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise InputError(f"{folder} is no folder; name another one with --out") from None
    held = lock(folder)
    if held is None:
        raise InputError(
            f"another process makes the {work} in {folder}; wait for it, or name another folder "
            "with --out"
        )
    try:
        yield
    finally:
        _unlock(folder, held)


def lock(folder: Path, tries: int = 5) -> int | None:
    """An open file in a folder that is locked until it is closed, which the system does for a
    process that ends; None where another process has locked it."""
    held = os.open(folder / LOCK, os.O_CREAT | os.O_RDWR, 0o644)
    if fcntl is None:
        return held
    try:
        fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(held)
        return None
    except OSError:
        return held  # a file system without locks
    if tries > 1 and not _lies_in(folder, held):  # taken away by who held it, or never the same
        os.close(held)
        return lock(folder, tries - 1)
    return held


def _lies_in(folder: Path, held: int) -> bool:
    """Whether the folder's lock is still this open file."""
    try:
        return os.path.samestat(os.stat(folder / LOCK), os.fstat(held))
    except FileNotFoundError:
        return False


def _unlock(folder: Path, held: int) -> None:
    """Takes the lock away while it is held, so that nobody else's is taken away."""
    with suppress(OSError):
        if fcntl is not None and _lies_in(folder, held):
            (folder / LOCK).unlink()
    os.close(held)


def _goes_on(load_from: Path, checkpoints: Path) -> bool:
    """Whether what a run resumes from is the folder in which it saves, or lies there."""
    source = load_from.resolve()
    return checkpoints.resolve() in (source, source.parent)
