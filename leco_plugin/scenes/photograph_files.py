"""The files of photographs: there, of the right size, and of a kind that nerfstudio reads rightly.

nerfstudio takes the numbers of a palette for greys and the low bytes of 16 bits for all of them,
and a file that is cut off ends it in the middle of loading.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from nerfstudio.cameras.cameras import Cameras
from PIL import Image, UnidentifiedImageError

from leco_plugin.scenes.input_error import InputError, one_line

READ_RIGHTLY = ("L", "RGB", "RGBA")
"""Pillow's modes of images that nerfstudio reads as they are."""

Read = TypeVar("Read")


def check_images(meta: dict[str, Any], frames: list[dict[str, Any]], folder: Path) -> None:
    """Every image is there, of the size that its intrinsics are for, and of one kind with all.

    Raises:
        InputError: one line.
    """
    paths = [folder / frame["file_path"] for frame in frames]
    missing = [path for path in paths if not path.exists()]
    if missing:
        raise InputError(
            f"{len(missing)} of {len(frames)} images are not there, the first is {missing[0]}"
        )
    transparent = []
    for frame, path in zip(frames, paths):
        width, height = (int(meta[n] if n in meta else frame[n]) for n in ("w", "h"))
        size, mode = header_of(path)
        if size != (width, height):
            raise InputError(
                f"{path} has {size[0]} x {size[1]} pixels, "
                f"its intrinsics are for {width} x {height}"
            )
        if mode not in READ_RIGHTLY:
            raise InputError(
                f"{path} is of Pillow's mode {mode!r}, which nerfstudio reads wrongly: save it "
                "with 8 bits a channel as RGB, RGBA or grey"
            )
        if mode == "RGBA":
            transparent.append(path)
    if 0 < len(transparent) < len(paths):
        raise InputError(
            f"{len(transparent)} of {len(paths)} images have transparency, the first is "
            f"{transparent[0]}: save all of them with it, or all without"
        )


def check_smaller_images(paths: list[Path], cameras: Cameras) -> None:
    """Images in a folder like images_2 are there, and of their cameras' size but for rounding.

    Raises:
        InputError: one line.
    """
    for path, width, height in zip(paths, cameras.width.flatten(), cameras.height.flatten()):
        if not path.exists():
            raise InputError(
                f"{path} is not there; make smaller images with ns-process-data, or set no "
                "--pipeline.datamanager.dataparser.downscale-factor"
            )
        (wide, high), _ = header_of(path)
        if abs(wide - int(width)) > 1 or abs(high - int(height)) > 1:
            raise InputError(
                f"{path} has {wide} x {high} pixels, at its factor the camera's are "
                f"{int(width)} x {int(height)}"
            )


def header_of(path: Path) -> tuple[tuple[int, int], str]:
    """Width and height of an image, and its mode in Pillow's words.

    Raises:
        InputError: it is none.
    """
    try:
        with Image.open(path) as image:
            return image.size, image.mode
    except (OSError, UnidentifiedImageError, Image.DecompressionBombError):
        raise InputError(f"{path} cannot be read as an image") from None


def names_what_it_cannot_read(dataset: Any) -> Any:
    """A dataset of nerfstudio's which says in one line which of its images, or what comes with it,
    cannot be read."""
    dataset.get_data = _naming(dataset.get_data, dataset.image_filenames)
    return dataset


def _naming(read: Callable[..., Read], paths: list[Path]) -> Callable[..., Read]:
    def read_or_name(image_idx: int, *arguments: Any, **options: Any) -> Read:
        try:
            return read(image_idx, *arguments, **options)
        except InputError:
            raise
        except (AssertionError, OSError, SyntaxError, ValueError) as error:  # of Pillow's readers
            reason = one_line(error, 200) or type(error).__name__
        # out here, because that error holds the file that nerfstudio has left open
        raise InputError(f"{paths[image_idx]} cannot be read ({reason}): is the file whole?")

    return read_or_name
