"""The routines in C as a library, compiled once for a machine and kept in the user's cache folder.

The file is `leco_plugin/native-DIGEST.so` in `$XDG_CACHE_HOME`, or else in `~/.cache`. The digest
is of the sources, the command, the compiler and the processor. A change of one of them makes
another file.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

from leco_plugin.scenes.whole_files import write_whole

SECONDS = 60
"""That a compiler may take."""
OF_A_PROCESSOR = ("vendor_id", "cpu family", "model", "stepping", "flags", "CPU ", "Features")
"""Lines of /proc/cpuinfo that `-march=native` depends on, for x86 and ARM, begin like this."""


def compiled(command: Sequence[str], sources: Sequence[Path]) -> ctypes.CDLL:
    """The library that a compiler makes of these sources, or has made of them earlier.

    Args:
        command: the compiler and its flags.
        sources: C files.

    Raises:
        OSError: the compiler cannot be started, or its library cannot be loaded.
        subprocess.SubprocessError: it fails, or takes longer than `SECONDS`.
    """
    folder = cache_folder()
    kept = folder / f"native-{digest(command, sources)}.so" if folder else None
    if kept is not None and _is_own(kept):
        with contextlib.suppress(OSError):  # damaged: it is compiled again
            return ctypes.CDLL(str(kept))
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as temporary:
        made = Path(temporary, "native.so")
        whole = [*command, *map(str, sources), "-o", str(made), "-lm"]
        subprocess.run(whole, check=True, capture_output=True, timeout=SECONDS)
        library = ctypes.CDLL(str(made))
        if kept is not None:
            with contextlib.suppress(OSError):  # the next process compiles it again
                write_whole(kept, lambda file: file.write(made.read_bytes()))
        return library


def cache_folder() -> Path | None:
    """The folder of this package in the user's cache; None for a user without a home."""
    folder = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))
    return folder / "leco_plugin" if folder.is_absolute() else None


def _is_own(path: Path) -> bool:
    """Whether this user has written a file: another user's is not run."""
    try:
        return path.stat().st_uid == os.getuid()
    except OSError:
        return False


def digest(command: Sequence[str], sources: Sequence[Path]) -> str:
    """Sixteen hexadecimal digits of all that the library depends on."""
    compiler = Path(shutil.which(command[0]) or command[0]).resolve()
    known = compiler.stat() if compiler.exists() else None
    version = (known.st_size, known.st_mtime_ns) if known else None
    sha = hashlib.sha256(repr((list(command), str(compiler), version, processor())).encode())
    for source in sources:
        headers = sorted(source.parent.glob("*.h"))
        for path in (source, *headers):
            sha.update(path.read_bytes())
    return sha.hexdigest()[:16]


def processor() -> list[str]:
    """What is known of this machine's processor."""
    known = [platform.system(), platform.machine(), platform.processor()]
    with contextlib.suppress(OSError):
        first = Path("/proc/cpuinfo").read_text().partition("\n\n")[0]
        known += [line for line in first.splitlines() if line.startswith(OF_A_PROCESSOR)]
    return known
