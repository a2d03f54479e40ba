"""Files that appear under their names only when they are whole, however a process ends; whether one
may be written, before work that takes minutes; and folders that one process at a time may fill."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Any, BinaryIO

from leco_plugin.scenes.input_error import InputError, one_line

if TYPE_CHECKING:  # `leco --help` loads no numpy for it
    import numpy as np
    from numpy.typing import NDArray

PART = ".part"
"""How the names of unfinished files end."""
LONGEST = 40
"""Letters of a name that an unfinished file has too: of 255 bytes each takes up to 4."""
POINTER = b"version https://git-lfs"
FETCH = "is a pointer of Git LFS: `git lfs pull` fetches the file"


def write_whole(path: Path, content: bytes | Callable[[BinaryIO], object]) -> None:
    """Writes bytes, or what a function writes into a file, beside `path` and moves it there;
    folders are made. Of several processes at once the last one wins. OSError, which names the
    file, if it cannot be written, or something that is no file has its name."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if kind := _other_than_a_file(path):
        raise OSError(f"{path} is {kind}; give a file")
    known = f"{path.name[-LONGEST:]}.{os.getpid()}-{threading.get_ident()}"
    part = path.with_name(f".{known}{PART}")
    try:
        with part.open("wb") as file:
            file.write(content) if isinstance(content, bytes) else content(file)
        part.replace(path)
    except (OSError, RuntimeError) as error:
        # torch tells of a full disk by an error of its own
        cause = error if isinstance(error, OSError) else error.__context__
        if not isinstance(cause, OSError) or cause.errno is None:
            raise
        raise OSError(cause.errno, cause.strerror, str(path)) from None
    finally:
        part.unlink(missing_ok=True)


def _other_than_a_file(path: Path) -> str | None:
    """What has the name of a file to write and is none; None where nothing has."""
    is_device = path.parent == Path("/dev")  # a file would take its place
    if not is_device and (path.is_file() or not path.exists()):
        return None
    return "a folder" if path.is_dir() else "a device or a pipe"


def digest_of_file(path: Path, *more: str) -> str:
    """16 hexadecimal digits of a file's path, size and time of change, and of `more`: others for
    another file, also where that has taken the name of this one."""
    known = path.stat()
    said = " ".join(map(str, (path.resolve(), known.st_size, known.st_mtime_ns, *more)))
    return hashlib.blake2b(os.fsencode(said), digest_size=8).hexdigest()


def is_pointer(path: Path) -> bool:
    """Whether a file only says where Git LFS has what belongs there."""
    return begins_with(path, POINTER)


def begins_with(path: Path, mark: bytes) -> bool:
    """Whether a file's first 200 bytes hold a mark; those of a folder, or of no file, do not."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return mark in file.read(200)


def write_json(path: Path, value: Any, indent: int = 2, allow_nan: bool = False) -> None:
    """Writes JSON whole or not at all; folders are made. ValueError for NaN and
    infinity, unless allowed."""
    text = json.dumps(value, indent=indent, allow_nan=allow_nan) + "\n"
    write_whole(path, text.encode())


def write_report(path: Path | None, value: Any) -> None:
    """`write_json` where a report was asked for."""
    if path is not None:
        write_json(path, value)


def remove_parts(folder: Path) -> None:
    """Deletes what killed processes left half written in a folder and those below it."""
    for part in folder.rglob(f".*{PART}"):
        part.unlink(missing_ok=True)


def write_points(
    path: Path, places: NDArray[Any], colours: NDArray[np.uint8], comments: Sequence[str] = ()
) -> None:
    """Writes places [N, 3], float32 or float64, and colours [N, 3 or 4] as a binary PLY file, after
    lines of comment. OSError if it cannot be written there."""
    import numpy as np

    channels, kind = colours.shape[1], "float" if places.itemsize == 4 else "double"
    stored = [("xyz", places.dtype.newbyteorder("<"), 3), ("rgb", "u1", channels)]
    rows = np.empty(len(places), stored)
    rows["xyz"], rows["rgb"] = places, colours
    properties = [f"property {kind} {axis}" for axis in "xyz"]
    properties += [f"property uchar {c}" for c in ("red", "green", "blue", "alpha")[:channels]]
    head = ["ply", "format binary_little_endian 1.0", *(f"comment {each}" for each in comments)]
    head += [f"element vertex {len(rows)}", *properties, "end_header\n"]
    write_whole(path, "\n".join(head).encode() + rows.tobytes())


def check_place(option: str, path: Path | None) -> None:
    """InputError if a file cannot be written there: it is a folder or a device, or its folder takes
    no new file. Tries it with a file that has no name, as rights do not say all."""
    if path is None:
        return
    if kind := _other_than_a_file(path):
        raise InputError(f"{option} {path} is {kind}; give a file")
    nearest = next(folder for folder in path.absolute().parents if folder.exists())
    if not nearest.is_dir():
        raise InputError(f"{option} {path}: {nearest} is a file, not a folder")
    with writing_into(nearest, option), TemporaryFile(dir=nearest):
        pass


def check_apart(written: Mapping[str, Path | None], *read: Path | None) -> None:
    """InputError if a file to write, by its option, is one that a command reads or writes twice."""
    known = [path for path in read if path is not None]
    inside = "transforms.json", "settings.json"  # of a scene, and of a folder of runs
    taken = {path.resolve() for each in known for path in (each, *map(each.joinpath, inside))}
    if any(path is not None and path.is_file() for path in written.values()):
        taken |= {named for path in taken for named in _named_in(path)}
    for option, path in written.items():
        if path is None:
            continue
        if path.resolve() in taken:
            fault = (
                f"{option} {path} is a file that this command reads, or writes by another option"
            )
            raise InputError(f"{fault}: give another name")
        taken.add(path.resolve())


def _named_in(path: Path) -> set[Path]:
    """Photographs, masks and points that a transforms.json names; of any other file none."""
    from leco_plugin.scenes.photograph_files import find_file

    named: set[Path] = set()

    def note(part: dict[str, Any]) -> None:
        names = [value for key, value in part.items() if key.endswith("path")]
        files = [path.parent / each for each in names if isinstance(each, str)]
        named.update(find_file(each).resolve() for each in files)

    if path.suffix == ".json":
        with suppress(OSError, ValueError):  # a damaged one is said when it is read
            json.loads(path.read_bytes(), object_hook=note)
    return named


def check_report(path: Path | None, *read: Path | None) -> None:
    """InputError if a report, the file of --json, cannot be written, or is one that is read."""
    check_place("--json", path)
    check_apart({"--json": path}, *read)


def check_picture(option: str, path: Path | None, moving: bool = False) -> None:
    """As `check_place`, and for an unknown kind of picture; a `moving` one may be a .gif."""
    check_place(option, path)
    if path is None:
        return
    from matplotlib.backend_bases import FigureCanvasBase

    kinds = {*FigureCanvasBase.get_supported_filetypes(), *(["gif"] if moving else [])}
    if path.suffix[1:].lower() not in kinds:
        raise InputError(f"{option} {path} ends in none of {', '.join(sorted(kinds))}")


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
