"""The routines in C as a library, compiled once for a machine and kept in the user's cache folder.

The file is `leco_plugin/native-DIGEST.so` in `$XDG_CACHE_HOME`, or else in `~/.cache`. The digest
is of the sources, the command, the compiler and the processor. A change of one of them makes
another file. It may be deleted at any time.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import os
import platform
import shutil
import stat
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

from leco_plugin.scenes.whole_files import write_whole

SECONDS = 60
"""That a compiler may take."""
OF_A_PROCESSOR = ("vendor_id", "cpu family", "model", "stepping", "flags", "CPU ", "Features")
"""Lines of /proc/cpuinfo that `-march=native` depends on, for x86 and ARM, begin like this."""


def compiled(command: Sequence[str], sources: Sequence[Path]) -> ctypes.CDLL:
    """The library that a compiler, with these flags, makes of C files, or has made of them earlier.
    OSError if it cannot be started, or its library cannot be loaded; subprocess.SubprocessError if
    it fails, or takes longer than `SECONDS`."""
    folder = cache_folder()
    kept = folder / f"native-{digest(command, sources)}.so" if folder else None
    library = _load(kept)
    if library is not None:
        return library
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as temporary:
        made = Path(temporary, "native.so")
        whole = [*command, *map(str, sources), "-o", str(made), "-lm"]
        subprocess.run(whole, check=True, capture_output=True, timeout=SECONDS)
        _keep(kept, made.read_bytes())
        return _load(kept) or ctypes.CDLL(str(made))


def cache_folder() -> Path | None:
    """The folder of this package in the user's cache; None for a user without a home."""
    folder = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))
    return folder / "leco_plugin" if folder.is_absolute() else None


def _keep(path: Path | None, library: bytes) -> None:
    """Writes a library with its digest at the end, which loaders do not read. Where that cannot be,
    the next process compiles it again."""

    def write(file: BinaryIO) -> None:
        os.fchmod(file.fileno(), 0o600)
        file.write(library + hashlib.sha256(library).digest())

    if path is not None:
        with contextlib.suppress(OSError):
            path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            write_whole(path, write)


def _load(path: Path | None) -> ctypes.CDLL | None:
    """A library that `_keep` wrote; None where it is missing, damaged, or another user's work.

    Loading one that is cut short would end the process, without a word.
    """
    try:
        if path is None or not (
            _is_own(path.parent.stat()) and _is_own(path.lstat(), stat.S_IFREG)
        ):
            return None
        content = path.read_bytes()
        whole = hashlib.sha256(content[:-32]).digest() == content[-32:]
        return ctypes.CDLL(str(path)) if whole else None
    except OSError:
        return None


def _is_own(found: os.stat_result, kind: int = stat.S_IFDIR) -> bool:
    """Whether only this user can have written a file or folder, which is of this kind."""
    writable = found.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    return found.st_uid == os.geteuid() and not writable and stat.S_IFMT(found.st_mode) == kind


def digest(command: Sequence[str], sources: Sequence[Path]) -> str:
    """Sixteen hexadecimal digits of all that the library depends on."""
    programs = [Path(found).resolve() for word in command if (found := shutil.which(word))]
    versions = [(str(path), path.stat().st_size, path.stat().st_mtime_ns) for path in programs]
    sha = hashlib.sha256(repr((list(command), versions, processor())).encode())
    headers = {header for source in sources for header in source.parent.glob("*.h")}
    for path in (*sources, *sorted(headers)):
        sha.update(path.read_bytes())
    return sha.hexdigest()[:16]


def processor() -> list[str]:
    """What is known of this machine's processor; where that is nothing, the machine's name."""
    try:
        first = Path("/proc/cpuinfo").read_text().partition("\n\n")[0]
        known = [line for line in first.splitlines() if line.startswith(OF_A_PROCESSOR)]
    except OSError:
        known = []
    return [platform.system(), platform.machine(), *(known or [platform.node()])]
