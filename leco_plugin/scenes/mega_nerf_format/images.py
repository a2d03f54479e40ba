"""The pictures and masks of a Mega-NeRF scene, as files of the size and the part that is wanted.

masks/<stem>.pt is a zip that holds <stem>.pt, a tensor of bool [H, W]: the pixels to keep.
"""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from leco_plugin.scenes.derived_images import DerivedImages, image_header, open_image
from leco_plugin.scenes.input_error import InputError, one_line
from leco_plugin.scenes.mega_nerf_format.files import Frame
from leco_plugin.scenes.mega_nerf_format.pt_file import describe, load, read_bytes
from leco_plugin.scenes.photograph_files import check_kind, header_of, is_plain, plain

_MORE = 1 << 16
"""Bytes that a file may have beyond its pixels, one byte each."""


def scaled(frame: Frame, factor: int) -> tuple[int, int]:
    """Width and height of a picture divided by a factor.

    Raises:
        InputError: the factor does not divide them, or the file is smaller than that.
    """
    if frame.width % factor or frame.height % factor:
        raise InputError(
            f"{frame.image} has metadata for {frame.width} x {frame.height} pixels, "
            f"which a scale factor of {factor} does not divide"
        )
    size = frame.width // factor, frame.height // factor
    if frame.image_size[0] < size[0]:
        raise InputError(
            f"{frame.image} has {frame.image_size[0]} x {frame.image_size[1]} pixels, fewer than "
            f"the {size[0]} x {size[1]} that are asked for; use a larger scale factor"
        )
    return size


def picture_of(frame: Frame, factor: int, right_half: bool, derived: DerivedImages) -> Path:
    """A file with the picture, resized as Mega-NeRF does it, or with its right half only."""
    size = scaled(frame, factor)
    header = header_of(frame.image)
    check_kind(frame.image, header)
    if frame.image_size == size and is_plain(header) and not right_half:
        return frame.image

    def make() -> Image.Image:
        image = plain(open_image(frame.image))
        if image.size != size:
            image = image.resize(size, Image.Resampling.LANCZOS)
        return image.crop((size[0] // 2, 0, *size)) if right_half else image

    return derived.get(frame.image, f"{size} {'right' if right_half else 'whole'}", make)


def mask_of(
    frame: Frame, factor: int, left_half: bool, masks: Path | None, derived: DerivedImages
) -> Path | None:
    """A file with the pixels to train on, or None if there are none.

    Args:
        left_half: whether the right half of the picture is left out.
        masks: folder of the scene's masks, if it has any.
    """
    size = scaled(frame, factor)
    if masks is None:
        part = "left" if left_half else "whole"
        path = derived.folder / f"{part}-{size[0]}x{size[1]}.png"
        if not path.exists():
            derived.put(path, _cut(Image.new("L", size, 255), left_half))
        return path

    source = masks / f"{frame.stem}.pt"
    if not source.is_file():
        raise InputError(f"there is no {source}: each picture needs a mask, or none has one")

    def make() -> Image.Image:
        keep = read_mask(source, frame.width, frame.height)
        mask = Image.fromarray(keep.astype(np.uint8) * 255)
        if mask.size != size:
            mask = mask.resize(size, Image.Resampling.NEAREST)
        mask = _cut(mask, left_half)
        return mask if mask.getbbox() else Image.new("L", (1, 1))

    path = derived.get(source, f"{frame.width, frame.height} {size} {left_half}", make)
    # a mask that keeps nothing is kept as one pixel, so that its header says so
    return None if image_header(path)[0] != size else path


def _cut(mask: Image.Image, left_half: bool) -> Image.Image:
    if left_half:
        mask.paste(0, (mask.width // 2, 0, *mask.size))
    return mask


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
