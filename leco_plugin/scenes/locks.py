"""Folders that one process at a time may fill."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from leco_plugin.scenes.input_error import InputError, one_line

LOCK = ".running"
"""File that a run holds locked: the system lets go of it however the run ends."""


@contextmanager
def alone_in(folder: Path, work: str) -> Iterator[None]:
    """Makes a folder, and keeps other processes from the same `work` in it. InputError if one is at
    work there, or nothing can be written there."""
    with writing_into(folder, "--out"):
        folder.mkdir(parents=True, exist_ok=True)
        held = lock(folder)
    if held is None:
        taken = f"another process makes the {work} in {folder}"
        raise InputError(f"{taken}; wait for it, or name another folder with --out")
    try:
        yield
    finally:
        unlock(folder, held)


@contextmanager
def writing_into(folder: Path, option: str) -> Iterator[None]:
    """While something is written into the folder of an option: InputError if that cannot be."""
    try:
        yield
    except OSError as error:
        why = error.strerror or one_line(error)
        fault = f"nothing can be written into {folder} ({why})"
        raise InputError(f"{fault}: name another folder with {option}") from None


def lock(folder: Path, tries: int = 5) -> int | None:
    """An open file in a folder, locked until it is closed; None where another process has it."""
    held = os.open(folder / LOCK, os.O_CREAT | os.O_RDWR, 0o644)
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


def unlock(folder: Path, held: int) -> None:
    """Takes the lock away while it is held, so that nobody else's is taken away."""
    with suppress(OSError):
        if _lies_in(folder, held):
            (folder / LOCK).unlink()
    os.close(held)
