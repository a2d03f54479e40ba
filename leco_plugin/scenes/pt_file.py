"""A file of torch.save read as data: tensors and numbers, and nothing that could run."""

from __future__ import annotations

import io
import pickle
import pickletools
import re
import zipfile
from pathlib import Path
from typing import Any

import torch

from leco_plugin.scenes.input_error import InputError, one_line
from leco_plugin.scenes.whole_files import FETCH, is_pointer

MOST_RECORDS, LONGEST_PICKLE = 256, 1 << 14
"""Records of an archive, and bytes of its pickle: that of a picture's metadata has about 500."""


def read_pt(path: Path, most_bytes: int = 1 << 20) -> Any:
    """What a .pt file holds: tensors, numbers, strings and containers of them. InputError if it
    holds anything else, cannot be read, is damaged or larger than `most_bytes`."""
    return load(read_bytes(path, most_bytes), str(path))


def read_bytes(path: Path, most_bytes: int) -> bytes:
    """All bytes of a file. InputError, in one line, if there are too many or it is none."""
    try:
        if not path.is_file():
            raise InputError(f"there is no file {path}")
        if is_pointer(path):
            raise InputError(f"{path} {FETCH}")
        size = path.stat().st_size
        if size > most_bytes:
            raise InputError(f"{path} has {size} bytes, and needs no more than {most_bytes}")
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from None


def load(data: bytes, name: str) -> Any:
    """What the bytes of a .pt file hold; `name` is for messages. InputError as of `read_pt`."""
    try:
        _check_sizes(data, name)
        value = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
        for one in value.values() if isinstance(value, dict) else [value]:
            _check_value(one, name)
        return value
    except InputError:
        raise
    except pickle.UnpicklingError as error:  # torch advises to trust the file
        found = re.search(r"GLOBAL ([\w.]+)|<class '([\w.]+)'>", str(error))
        what = found[found.lastindex or 0] if found else "more than that"
        raise InputError(f"{name} holds {what}, and only tensors and numbers are read") from None
    # Damaged archives and pickles raise whatever their readers meet; nothing of it is a new fault.
    except Exception as error:  # noqa: BLE001
        said = one_line(error, 120) or "no reason given"
        raise InputError(f"{name} is damaged: {type(error).__name__}: {said}") from None


def _check_sizes(data: bytes, name: str) -> None:
    """Refuses an archive that would take more memory or time than its bytes are worth."""
    if not data.startswith(b"PK"):
        raise InputError(f"{name} is not a file of torch.save (of torch 1.6 or newer)")
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        entries = archive.infolist()
        pickles = [entry for entry in entries if entry.filename.endswith("/data.pkl")]
        if len(pickles) != 1 or len(entries) > MOST_RECORDS:
            raise InputError(f"{name} is a zip, but not one of torch.save")
        if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
            raise InputError(f"{name} holds compressed records, which torch.save does not write")
        if sum(entry.file_size for entry in entries) > len(data):
            raise InputError(f"{name} claims more bytes than it has")
        pickled = archive.read(pickles[0])
    if len(pickled) > LONGEST_PICKLE:
        raise InputError(f"{name} describes its contents in {len(pickled)} bytes, far too many")
    _check_tuples(pickled, name)


def _check_tuples(pickled: bytes, name: str) -> None:
    """Refuses tuples that are used twice: of pairs of pairs of them, a key takes years to hash."""
    tuples, last = set(), ""
    for opcode, argument, _ in pickletools.genops(pickled):
        if opcode.name in ("BINPUT", "LONG_BINPUT") and "TUPLE" in last:
            tuples.add(argument)
        if opcode.name in ("BINGET", "LONG_BINGET") and argument in tuples:
            raise InputError(f"{name} describes its contents in a way that torch does not")
        last = opcode.name


def _check_value(value: Any, name: str) -> None:
    """Refuses classes that this process lets torch read elsewhere, and tensors that numpy lacks."""
    kind = type(value)
    if kind.__module__ not in ("builtins", "collections", "torch"):
        what = f"{kind.__module__}.{kind.__name__}"
        raise InputError(f"{name} holds a {what}, and only tensors and numbers are read")
    if isinstance(value, torch.Tensor) and (
        value.device.type != "cpu"
        or value.layout != torch.strided
        or value.is_quantized
        or value.is_complex()
        or value.is_nested
    ):
        raise InputError(
            f"{name} holds {describe(value)}, and only tensors of plain numbers are read"
        )


def describe(value: Any) -> str:
    """What a value of a .pt file is, in a few words."""
    if isinstance(value, torch.Tensor):
        shape = " x ".join(str(n) for n in value.shape) or "a single number"
        return f"a tensor of {str(value.dtype).removeprefix('torch.')}, {shape}"
    return f"a value of type {type(value).__name__}"
