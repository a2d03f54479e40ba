"""A file of torch.save read as data: tensors and numbers, and nothing that could run.

`torch.load(weights_only=True)` runs no code, but it unpacks whatever a file claims, and not every
version of torch compares a claimed size with what is there. So a file is looked through first, by
Python alone, and torch is given an archive that holds only what was seen.
"""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Any

import torch

from leco_plugin.scenes.input_error import InputError, one_line
from leco_plugin.scenes.mega_nerf_format.pt_pickle import Look, Refused

_MOST_RECORDS = 256


def read_pt(path: Path, most_bytes: int = 1 << 20) -> Any:
    """What a .pt file holds.

    Raises:
        InputError: one line; it cannot be read, is damaged, is larger than `most_bytes`, or holds
            anything but tensors, numbers, strings and containers of them.
    """
    return load(read_bytes(path, most_bytes), str(path))


def read_bytes(path: Path, most_bytes: int) -> bytes:
    """All bytes of a file. InputError, in one line, if there are too many or it is none."""
    try:
        if not path.is_file():
            raise InputError(f"there is no file {path}")
        size = path.stat().st_size
        if size > most_bytes:
            raise InputError(f"{path} has {size} bytes, and needs no more than {most_bytes}")
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from None


def load(data: bytes, name: str) -> Any:
    """What the bytes of a .pt file hold; `name` is for messages. InputError as of `read_pt`."""
    try:
        records = _records(data)
        Look(records).through()
        return torch.load(_archive(records), map_location="cpu", weights_only=True)
    except Refused as refusal:
        raise InputError(f"{name} {refusal}") from None
    # Damaged archives and pickles raise whatever their readers meet; nothing of it is a new fault.
    except Exception as error:  # noqa: BLE001
        said = one_line(error, 120) or "no reason given"
        raise InputError(f"{name} is damaged: {type(error).__name__}: {said}") from None


def _records(data: bytes) -> dict[str, bytes]:
    """The records of an archive by their names: `data.pkl`, `data/0`, ..., `byteorder`."""
    if not data.startswith(b"PK"):
        raise Refused("is not a file of torch.save (of torch 1.6 or newer)")
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        entries = archive.infolist()
        roots = {e.filename[: -len("/data.pkl")] for e in entries if _is_pickle(e.filename)}
        if len(roots) != 1 or len(entries) > _MOST_RECORDS:
            raise Refused("is a zip, but not one of torch.save")
        if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
            raise Refused("holds compressed records, which torch.save does not write")
        if sum(entry.file_size for entry in entries) > len(data):
            raise Refused("claims more bytes than it has")
        root = roots.pop() + "/"
        wanted = [e for e in entries if e.filename.startswith((root + "data", root + "byteorder"))]
        return {entry.filename[len(root) :]: archive.read(entry) for entry in wanted}


def _is_pickle(name: str) -> bool:
    return name.endswith("/data.pkl")


def _archive(records: dict[str, bytes]) -> io.BytesIO:
    """The records as an archive for torch."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name, record in (records | {"version": b"3\n"}).items():
            archive.writestr(f"archive/{name}", record)
    file.seek(0)
    return file
