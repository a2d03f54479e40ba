"""Masks of photographs, as programs write them: which pixels of each are seen.

nerfstudio takes the numbers of a palette for greys, and each pixel that is not 0 for seen.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from rich.markup import escape

from leco_plugin.log import say
from leco_plugin.scenes.input_error import InputError, one_line
from leco_plugin.scenes.photograph_files import DerivedImages

HALF = 128
"""From this grey on, where a mask has so light ones, a pixel is seen."""
COLOURED = 40
"""Difference between channels beyond what JPEG makes of a grey."""


def convert_masks(
    masks: list[Path],
    images: list[Path],
    sizes: list[tuple[int, int]],
    derived: DerivedImages,
    speak: bool,
) -> list[Path]:
    """Files of the masks in which every pixel that is seen is light, and every other is 0.

    Args:
        images: that they are of.
        sizes: width and height of these.
        derived: where a mask goes that nerfstudio would read otherwise.
        speak: whether to say what was taken for seen.
    Raises:
        InputError: one line, about the mask.
    """
    found, shown, grey = [], [], []
    for wanted, image, size in zip(masks, images, sizes):
        path = _found(wanted, image)
        values = _values(path)
        seen = _is_seen(values)
        if bool(((values > 0) & ~seen).any()):
            grey.append(path)
        fitting = _fit(seen, size, path)
        as_it_is = fitting is seen and bool((seen == (values > 0)).all()) and _is_grey(path)
        made = partial(Image.fromarray, fitting.astype(np.uint8) * 255)
        found.append(path if as_it_is else derived.get(path, f"mask {size}", made))
        shown.append(bool(fitting.any()))
    if not any(shown):
        raise InputError(
            f"the masks leave no pixel of {len(masks)} images, the first is {masks[0]}: a mask is "
            "black where its image is not to be used"
        )
    if not all(shown) and len(set(sizes)) > 1:
        raise InputError(
            f"the mask {found[shown.index(False)]} leaves no pixel, and each image of a scene of "
            "many sizes must give some: leave its image out"
        )
    if grey and speak:
        say(
            f"{len(grey)} masks have greys between black and white, of which those from {HALF} on "
            f"are seen; the first is {escape(str(grey[0]))}"
        )
    return found


def seen_pixels(mask: Path, image: Path, size: tuple[int, int]) -> NDArray[np.bool_]:
    """The pixels [H, W] of an image that its mask shows. InputError, one line, about the mask.

    Args:
        size: width and height of the image.
    """
    path = _found(mask, image)
    return _fit(_is_seen(_values(path)), size, path)


def check_masked(frames: list[dict[str, Any]], folder: Path) -> None:
    """InputError if some frames have a mask, and some have none."""
    masked = sum("mask_path" in frame for frame in frames)
    if 0 < masked < len(frames):
        raise InputError(
            f"{folder}: {masked} of {len(frames)} images have a mask_path; "
            "give one to all or to none"
        )


def _found(path: Path, image: Path) -> Path:
    """The file of a mask: of full size where there is no smaller one, or named as COLMAP does."""
    folders = [path.parent]
    for place, part in enumerate(path.parts[:-1]):
        if re.search(r"._\d+$", part):
            full = re.sub(r"_\d+$", "", part)
            folders.append(Path(*path.parts[:place], full, *path.parts[place + 1 : -1]))
    for folder in folders:
        for name in (path.name, f"{image.name}.png", f"{image.stem}.png"):
            if (folder / name).is_file():
                return folder / name
    raise InputError(f"the mask {path} is not there: give every photograph a mask, or none")


def _values(path: Path) -> NDArray[np.uint8]:
    """How light each pixel of a mask is: [H, W] from 0 to 255, transparent ones 0. InputError if it
    cannot be read, or has colours."""
    try:
        with Image.open(path) as image:
            if image.mode in ("1", "L") and "transparency" not in image.info:
                return np.asarray(image.convert("L"))
            if image.mode[0] in "IF":
                deep = np.nan_to_num(np.asarray(image, dtype=np.float64)).clip(min=0.0)
                return np.ceil(deep * (255.0 / max(deep.max(), 1e-9))).astype(np.uint8)
            rgba = np.asarray(image.convert("RGBA")).astype(np.int16)
    except Exception as error:  # noqa: BLE001  decoders raise whatever they meet
        reason = one_line(error, 120)
    else:
        lightest, darkest = rgba[..., :3].max(axis=-1), rgba[..., :3].min(axis=-1)
        if bool(((lightest - darkest)[rgba[..., 3] > 0] > COLOURED).any()):
            raise InputError(
                f"the mask {path} has colours: save it in black, where its image is not to be "
                "used, and white"
            )
        return (lightest * rgba[..., 3] // 255).astype(np.uint8)
    raise InputError(f"the mask {path} cannot be read as an image ({reason}): is the file whole?")


def _is_seen(values: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Which greys [H, W] of a mask are of pixels that are seen."""
    return np.asarray(values >= HALF if values.max() >= HALF else values > 0)


def _is_grey(path: Path) -> bool:
    with Image.open(path) as image:
        return image.mode == "L" and "transparency" not in image.info


def _fit(seen: NDArray[np.bool_], size: tuple[int, int], path: Path) -> NDArray[np.bool_]:
    """The pixels of a mask of its image's size, or of a whole number of times that. InputError if
    it has another size."""
    high, wide = seen.shape
    if (wide, high) == size:
        return seen
    factor = max(1, round(wide / size[0]))
    if factor == 1 or any(
        abs(full - factor * part) > factor for full, part in zip((wide, high), size)
    ):
        raise InputError(
            f"the mask {path} has {wide} x {high} pixels, its image {size[0]} x {size[1]}"
        )
    return np.asarray(Image.fromarray(seen).resize(size, Image.Resampling.NEAREST))
