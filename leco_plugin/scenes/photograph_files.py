"""The files of photographs and of their masks: there, whole, and such as nerfstudio reads rightly.

nerfstudio takes the numbers of a palette for greys and the low bytes of 16 bits for all of them,
turns no photograph as its EXIF says, and a file that is cut off ends it in the middle of loading.
Of a mask, each pixel that is not 0 counts as seen.
"""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from unicodedata import normalize

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image

from leco_plugin.log import bar, by_number, counted, say
from leco_plugin.scenes.input_error import InputError, one_line
from leco_plugin.scenes.whole_files import FETCH, LONGEST, digest_of_file, is_pointer, write_whole

READ_RIGHTLY = ("L", "RGB", "RGBA")
"""Pillow's modes of images that nerfstudio reads as they are."""
CONVERTED = ("1", "P", "PA", "LA", "CMYK")
"""Modes that become one of these; of CMYK by Pillow's formula, without a colour profile."""
SAVE_ANEW = "if the file is whole, save it as JPEG or PNG with 8 bits a channel, and give that name"
"""What to do about HEIC, OpenEXR and other kinds that Pillow does not read."""
NO_RIGHT = "give yourself the right to read it, and to enter its folder"
TURNS = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
"""What sets an image upright, by EXIF's orientation."""


class Header(NamedTuple):
    """What a file of an image says before it is decoded."""

    size: tuple[int, int]
    """Width and height of what is stored; of a TIFF of what Pillow decodes, which is upright."""
    mode: str
    """Pillow's."""
    transparent: bool
    """Whether one colour is transparent, or pixels have an alpha."""
    orientation: int
    """EXIF's: 1 is upright, from 5 on width and height change places."""
    several: bool
    """Whether it holds more pictures than one and a preview."""
    format: str
    """Pillow's name of the kind of file, whatever its name ends in."""
    tipped: bool = False
    """Whether it is a TIFF that Pillow lays on its side: by its path some are read wrongly."""


@contextmanager
def opened(path: Path) -> Iterator[Image.Image]:
    """An image that Pillow has opened, without its warning that a large one may be an attack."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        # of a path Pillow maps some turned TIFFs into memory by the wrong sides
        with path.open("rb") as file, Image.open(file) as image:
            yield image


def header_of(path: Path, turned: bool = True) -> Header:
    """What a file of an image says. InputError if it is none. Unless it may be `turned`, it counts
    as upright: to look for an orientation, Pillow decodes a PNG."""
    try:
        with opened(path) as image:
            several = image.format != "MPO" and getattr(image, "n_frames", 1) > 1
            transparent = image.mode in ("LA", "PA", "RGBA") or "transparency" in image.info
            size, how = _size_and_orientation(image) if turned else (image.size, 1)
            kind = image.format or ""
            tipped = kind == "TIFF" and _orientation(image) >= 5
            return Header(size, image.mode, transparent, how, several, kind, tipped)
    except Image.DecompressionBombError:
        most = f"{2 * (Image.MAX_IMAGE_PIXELS or 0) / 1e6:.0f} megapixels that Pillow opens"
        raise InputError(f"{path} has more than the {most}: make it smaller") from None
    except PermissionError as error:
        raise InputError(f"{path}: {error.strerror}: {NO_RIGHT}") from None
    except Exception:  # noqa: BLE001  decoders raise whatever they meet
        if not os.path.exists(path):
            raise InputError(f"the image {path} is not there{remedy_for_missing(path)}") from None
        if is_pointer(path):
            raise InputError(f"{path} {FETCH}") from None
        raise InputError(f"{path} cannot be read as an image: {SAVE_ANEW}") from None


def _size_and_orientation(image: Image.Image) -> tuple[tuple[int, int], int]:
    """Of a TIFF those of what Pillow decodes: it sets it upright, as nerfstudio then gets it."""
    size, orientation = image.size, _orientation(image)
    if image.format != "TIFF":
        return size, orientation
    if orientation >= 5 and size[0] == image.getexif().get(ExifTags.Base.ImageWidth):
        size = size[::-1]  # releases of Pillow that give the stored size until they decode
    return size, 1


def _orientation(image: Image.Image) -> int:
    try:
        noted = int(image.getexif().get(ExifTags.Base.Orientation, 1))
        return noted if noted in range(1, 9) else 1
    except Exception:  # noqa: BLE001  damaged EXIF raises whatever its parser meets
        return 1


def find_file(path: Path) -> Path:
    """A file of that name, of its name with slashes or with letters and accents joined or apart, as
    systems store them, or of one of these with an ending."""
    for name in _spellings(str(path)):
        for ending in ("", ".png", ".jpg", ".jpeg", ".JPG"):
            if os.path.isfile(name + ending):  # pathlib raises for a name that is too long
                return Path(name + ending)
    return path


def _spellings(name: str) -> Iterator[str]:
    """How a file of that name may be stored; folders that are there stay as they are spelled."""
    slashed = name.replace("\\", "/")
    yield from (name, slashed)
    there = os.path.dirname(slashed)
    while there and not os.path.isdir(there):
        there = os.path.dirname(there)
    for form in ("NFC", "NFD"):
        yield there + normalize(form, slashed[len(there) :])


def check_images(paths: list[Path]) -> None:
    """InputError if an image is not there, or its folder may not be entered."""
    if missing := [path for path in paths if _is_missing(path)]:
        some = f"{len(missing)} of {counted(len(paths), 'image')}"
        some += by_number(len(missing), " is", " are") + " not there, the first is"
        raise InputError(f"{some} {missing[0]}{remedy_for_missing(missing[0])}")


def _is_missing(path: Path) -> bool:
    """Whether a file is not there. InputError if a folder on the way may not be entered."""
    try:
        os.stat(path)
    except PermissionError as error:
        raise InputError(f"{path}: {error.strerror}: {NO_RIGHT}") from None
    except (OSError, ValueError):
        return True
    return False


def remedy_for_missing(path: Path, otherwise: str = "put it there, or leave its frame out") -> str:
    """What to add to a line about a file that is missing: why it may be, and what to do."""
    if "\\" in str(path):
        return ": its name was written by Windows, write / for each backslash"
    smaller = re.fullmatch(r"(.+)_(\d+)", path.parent.name)
    if smaller and (smaller[1] == "images" or path.parent.with_name(smaller[1]).is_dir()):
        return (
            f": make it, 1/{smaller[2]} of the width and height of its photograph in {smaller[1]}, "
            "or give --downscale-factor 1 after the name of the reader"
        )
    if os.path.islink(path):
        return f": it is a link to {path.readlink()}, which is not there"
    beside: list[str] = []
    with suppress(OSError):  # there is no such folder, or it may not be read
        beside = sorted(os.listdir(path.parent))
    for name in beside:
        if Path(name).stem.lower() == path.stem.lower():
            return f": there is {name}, write its name like that"
        if not path.suffix and name.startswith(f"{path.name} "):
            return (
                f": there is {name}, and nerfstudio reads names in COLMAP's .txt files up to a "
                "blank: give its .bin files, or names without blanks"
            )
    return f": {otherwise}"


def check_kind(path: Path, header: Header) -> None:
    """InputError if the colours of an image cannot be read."""
    if header.mode not in READ_RIGHTLY + CONVERTED:
        fault = f"{path} is of Pillow's mode {header.mode!r}, which nerfstudio reads wrongly"
        remedy = "save it as JPEG or PNG with 8 bits a channel, RGB, RGBA or grey"
        raise InputError(f"{fault}: {remedy}")
    if header.several:
        raise InputError(f"{path} holds more pictures than one: save the one that is meant alone")


def is_plain(header: Header) -> bool:
    """Whether nerfstudio reads all colours of an image as they are."""
    is_read = header.mode in READ_RIGHTLY and not header.tipped
    return is_read and header.transparent == (header.mode == "RGBA")


def plain(image: Image.Image) -> Image.Image:
    """The same colours of an image that passes `check_kind`, in a mode that nerfstudio reads."""
    if image.mode in ("LA", "PA") or "transparency" in image.info:
        return image.convert("RGBA")
    if image.mode in READ_RIGHTLY:
        return image
    return image.convert("L" if image.mode == "1" else "RGB")


def is_turned(header: Header, size: tuple[int, int]) -> bool:
    """Whether a picture of that size is what is stored, turned as EXIF says."""
    return header.orientation >= 5 and header.size != size and header.size[::-1] == size


def decode(path: Path, turn: bool) -> Image.Image:
    """Plain colours, turned as EXIF says if asked; EXIF stays as it was. InputError if damaged."""
    try:
        with opened(path) as image:
            image.load()  # Pillow itself turns TIFF here
            # Pillow's exif_transpose writes all EXIF anew, and fails at tags of another type
            turning = TURNS.get(_orientation(image)) if turn else None
            return plain(image if turning is None else image.transpose(turning)).copy()
    except Exception as error:  # noqa: BLE001  decoders raise whatever they meet
        reason = one_line(error, 120) or type(error).__name__
        raise InputError(f"{path} cannot be read ({reason}): is the file whole?") from None


def names_what_it_cannot_read(dataset: Any) -> Any:
    """nerfstudio's dataset; for what it cannot read, an InputError names the image in one line."""
    read, paths = dataset.get_data, dataset.image_filenames

    def read_or_name(image_idx: int, *arguments: Any, **options: Any) -> Any:
        try:
            return read(image_idx, *arguments, **options)
        except InputError:
            raise
        except Exception as error:  # noqa: BLE001  decoders raise whatever they meet
            reason = one_line(error, 200) or type(error).__name__
        # out here, because that error holds the file that nerfstudio has left open
        raise InputError(f"{paths[image_idx]} cannot be read ({reason}): is the file whole?")

    dataset.get_data = read_or_name
    return dataset


class DerivedImages:
    """A folder of PNG files, made when first asked for, and again once their source (path, size,
    time of change) or recipe has changed. `remedy` is for where nothing can be written."""

    def __init__(
        self, folder: Path, remedy: str = "give another folder for derived pictures with --cache"
    ) -> None:
        self.folder, self.remedy = folder, remedy

    def get(self, source: Path, recipe: str, make: Callable[[], Image.Image]) -> Path:
        """The file with what `make` makes of `source`; `recipe` names it. InputError as `put`."""
        path = self.folder / f"{source.stem[-LONGEST:]}-{digest_of_file(source, recipe)}.png"
        if not path.exists():
            self.put(path, make())
        return path

    def put(self, path: Path, image: Image.Image) -> None:
        """Writes an image under its name. InputError if that cannot be done."""
        try:
            write_whole(path, lambda file: image.save(file, format="PNG"))
        except OSError as error:
            why = error.strerror or error
            raise InputError(f"{path} cannot be written ({why}); {self.remedy}") from None


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
    """Files of the masks in which every pixel that is seen is light, and every other is 0: one that
    nerfstudio would read otherwise goes into `derived`. `sizes` are width and height of images;
    `speak` says what was taken for seen. InputError about a mask."""
    found, shown, grey = [], [], []
    with bar("Reading masks") as progress:
        for wanted, image, size in zip(masks, images, sizes):
            path = _found(wanted, image)
            values = _values(path)
            seen = _is_seen(values)
            if bool(((values > 0) & ~seen).any()):
                grey.append(path)
            fitting = _fit(seen, size, path)
            header = header_of(path)
            is_grey = header.mode == "L" and is_plain(header)
            as_it_is = fitting is seen and bool((seen == (values > 0)).all()) and is_grey
            made = partial(Image.fromarray, fitting.astype(np.uint8) * 255)
            found.append(path if as_it_is else derived.get(path, f"mask {size}", made))
            shown.append(bool(fitting.any()))
            progress(len(found) / len(masks))
    if not any(shown):
        images_of = counted(len(masks), "image")
        none = f"the masks leave no pixel of {images_of}, the first is {masks[0]}"
        raise InputError(f"{none}: a mask is black where its image is not to be used")
    if not all(shown) and len(set(sizes)) > 1:
        none = f"the mask {found[shown.index(False)]} leaves no pixel, and each image of a scene"
        raise InputError(f"{none} of many sizes must give some: leave its image out")
    if grey and speak:
        some = counted(len(grey), "mask has", "masks have") + " greys between black and white"
        say(f"{some}, of which those from {HALF} on are seen; the first is {grey[0]}")
    return found


def seen_pixels(mask: Path, image: Path, size: tuple[int, int]) -> NDArray[np.bool_]:
    """The pixels [H, W] that a mask shows of an image of this size. InputError about the mask."""
    path = _found(mask, image)
    return _fit(_is_seen(_values(path)), size, path)


def _found(path: Path, image: Path) -> Path:
    """The file of a mask: of full size where there is no smaller one, or named as COLMAP does."""
    parts = path.absolute().parts[:-1]
    # what both lie in is the scene, and SCENE_2 no smaller copy of SCENE
    own = len(Path(os.path.commonpath([path.absolute(), image.absolute()])).parts)
    folders = [path.parent] + [
        Path(*parts[:place], smaller[1], *parts[place + 1 :])
        for place in range(own, len(parts))
        if (smaller := re.fullmatch(r"(.+)_\d+", parts[place]))
    ]
    for folder in folders:
        for name in (path.name, f"{image.name}.png", f"{image.stem}.png"):
            if (folder / name).is_file():
                return folder / name
    raise InputError(f"the mask {path} is not there: give every photograph a mask, or none")


def _values(path: Path) -> NDArray[np.uint8]:
    """How light a mask is: [H, W], 0 to 255, 0 if transparent. InputError for none, or colours."""
    try:
        with opened(path) as image:
            image.load()  # which sets a TIFF upright
            if image.mode in ("1", "L") and "transparency" not in image.info:
                return np.asarray(image.convert("L"))
            if image.mode[0] in "IF":
                deep = np.nan_to_num(np.asarray(image, dtype=np.float64)).clip(min=0.0)
                return np.ceil(deep * (255.0 / max(deep.max(), 1e-9))).astype(np.uint8)
            rgba = np.asarray(image.convert("RGBA")).astype(np.int32)
    except Exception as error:  # noqa: BLE001  decoders raise whatever they meet
        why = f"({one_line(error, 120)}): is the file whole?"
        raise InputError(f"the mask {path} cannot be read as an image {why}") from None
    lightest, darkest = rgba[..., :3].max(axis=-1), rgba[..., :3].min(axis=-1)
    if bool(((lightest - darkest)[rgba[..., 3] > 0] > COLOURED).any()):
        remedy = "save it in black, where its image is not to be used, and white"
        raise InputError(f"the mask {path} has colours: {remedy}")
    return (lightest * rgba[..., 3] // 255).astype(np.uint8)


def _is_seen(values: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Which greys [H, W] of a mask are of pixels that are seen."""
    return np.asarray(values >= HALF if values.max() >= HALF else values > 0)


def _fit(seen: NDArray[np.bool_], size: tuple[int, int], path: Path) -> NDArray[np.bool_]:
    """A mask [H, W] in its image's size, from that or a whole number of times it, or InputError."""
    high, wide = seen.shape
    if (wide, high) == size:
        return seen
    factor = round(wide / size[0])
    off = max(abs(wide - factor * size[0]), abs(high - factor * size[1]))
    if factor <= 1 or off > factor:
        sizes = f"{wide} x {high} pixels, its image {size[0]} x {size[1]}"
        remedy = "save it as large as its image, or a whole number of times that"
        raise InputError(f"the mask {path} has {sizes}: {remedy}")
    return np.asarray(Image.fromarray(seen).resize(size, Image.Resampling.NEAREST))
