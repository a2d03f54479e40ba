"""Masks of Mega-NeRF's format: masks/<stem>.pt is a zip that holds <stem>.pt, a tensor of bool
[H, W]: which pixels of a picture to keep.
"""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from leco_plugin.scenes.input_error import InputError, one_line
from leco_plugin.scenes.mega_nerf_format.pt_file import load, read_bytes

_MORE = 1 << 16
"""Bytes that a file may have beyond its pixels, one byte each."""


def read_mask(path: Path, width: int, height: int) -> NDArray[np.bool_]:
    """Which pixels of a picture to keep: bool [height, width].

    Raises:
        InputError: one line; there is no such file, it is no mask, or one of another size.
    """
    most = width * height + _MORE
    mask = load(_unpack(path, read_bytes(path, most), most), str(path))
    if not isinstance(mask, torch.Tensor) or mask.dtype != torch.bool or mask.dim() != 2:
        raise InputError(f"{path} holds {describe(mask)}, and a mask is a tensor of bool [H, W]")
    if tuple(mask.shape) != (height, width):
        raise InputError(
            f"{path} is a mask of {mask.shape[1]} x {mask.shape[0]} pixels, "
            f"its picture has {width} x {height}"
        )
    # a byte of a damaged file may be neither 0 nor 1
    keep: NDArray[np.bool_] = mask.view(torch.uint8).numpy() != 0
    return keep


def _unpack(path: Path, data: bytes, most: int) -> bytes:
    """The .pt file in a mask's zip, of at most so many bytes."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            entry = archive.getinfo(f"{path.stem}.pt")
            if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise InputError(f"{path} is compressed in a way that Mega-NeRF does not use")
            with archive.open(entry) as file:
                inside = file.read(most + 1)
    except InputError:
        raise
    except KeyError:
        raise InputError(f"{path} is a zip without {path.stem}.pt, so no mask") from None
    # Damaged archives raise whatever their reader meets; nothing of it is a new fault.
    except Exception as error:  # noqa: BLE001
        said = one_line(error, 120)
        raise InputError(f"{path} is not a zip with a mask: {said}") from None
    if len(inside) > most:
        raise InputError(f"{path} unpacks to more than {most} bytes, too many for its picture")
    return inside


def describe(value: Any) -> str:
    """What a value of a .pt file is, in a few words."""
    if isinstance(value, torch.Tensor):
        shape = " x ".join(str(n) for n in value.shape) or "a single number"
        return f"a tensor of {str(value.dtype).removeprefix('torch.')}, {shape}"
    return f"a value of type {type(value).__name__}"
