"""Masks of photographs: what would end a run at its first batch is said before it is loaded."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from leco_plugin.scenes.input_error import InputError


def check_masks(frames: list[dict[str, Any]], folder: Path) -> None:
    """Every frame or none has a mask, of its image's size, and pixels are left to learn from.

    Raises:
        InputError: one line.
    """
    masked = [frame for frame in frames if "mask_path" in frame]
    if not masked:
        return
    if len(masked) < len(frames):
        raise InputError(
            f"{folder}: {len(masked)} of {len(frames)} images have a mask_path; "
            "give one to all or to none"
        )
    shown = [_shows_something(folder, frame) for frame in frames]
    if not any(seen for seen, _ in shown):
        raise InputError(
            f"{folder}: the masks leave no pixel of {len(frames)} images: a mask is black where "
            "its image is not to be used"
        )
    hidden = [frame["file_path"] for frame, (seen, _) in zip(frames, shown) if not seen]
    if hidden and len({size for _, size in shown}) > 1:
        raise InputError(
            f"the mask of {hidden[0]} leaves no pixel, and each image of a scene of many sizes "
            "must give some: leave the image out of transforms.json"
        )


def _shows_something(folder: Path, frame: dict[str, Any]) -> tuple[bool, tuple[int, int]]:
    """Whether a frame's mask leaves a pixel of its image, and the size of both.

    Raises:
        InputError: the mask is not there, cannot be read, or has another size.
    """
    from PIL import Image, UnidentifiedImageError

    path = folder / str(frame["mask_path"])
    try:
        with Image.open(path) as mask, Image.open(folder / frame["file_path"]) as image:
            size, wanted, seen = mask.size, image.size, mask.getbbox() is not None
    except FileNotFoundError:
        raise InputError(f"the mask {path} is not there") from None
    except (OSError, ValueError, UnidentifiedImageError, Image.DecompressionBombError):
        raise InputError(f"the mask {path} cannot be read as an image") from None
    if size != wanted:
        raise InputError(
            f"the mask {path} has {size[0]} x {size[1]} pixels, its image {wanted[0]} x {wanted[1]}"
        )
    return seen, size
