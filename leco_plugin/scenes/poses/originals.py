"""The photographs of a folder, checked before long work, and copied into the scene.

A copy has 8 bits a channel, is JPEG or PNG, and stands upright as EXIF says. The originals are
only read.
"""

from __future__ import annotations

import re
import shutil
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from PIL import Image

from leco_plugin.scenes.input_error import InputError, one_line
from leco_plugin.scenes.photograph_files import Header, check_kind, decode, header_of, is_plain
from leco_plugin.scenes.poses.exif import Exif, read_exif
from leco_plugin.scenes.whole_files import write_whole

HEIC = (".heic", ".heif")
KINDS = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp", *HEIC)
RAW = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".rw2", ".orf")
COPIED = (".jpg", ".jpeg", ".png")
"""Kinds that are copied byte by byte where their colours need no change."""
FEWEST = 3
QUALITY = 95
"""Of a JPEG that is written anew."""


@dataclass(frozen=True)
class Photograph:
    """One photograph of the folder."""

    path: Path
    name: str
    """Of its copy in the scene: no blanks and no folders."""
    header: Header
    exif: Exif

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, upright."""
        width, height = self.header.size
        return (height, width) if self.header.orientation >= 5 else (width, height)

    @property
    def lens(self) -> tuple[object, ...]:
        """The same of photographs that share their intrinsics."""
        return (self.size, self.exif.camera)

    @property
    def is_copied(self) -> bool:
        """Whether the copy has the bytes of the original."""
        upright = self.header.orientation == 1 and is_plain(self.header)
        return upright and self.path.suffix.lower() in COPIED


def find_photographs(folder: Path, out: Path) -> list[Photograph]:
    """The photographs in a folder and those below it, by name; what lies in `out` is left aside.

    Raises:
        InputError: there is no such folder, it has fewer than three, or one cannot be used.
    """
    if not folder.is_dir():
        raise InputError(f"there is no folder {folder}: give the one with the photographs")
    if folder.is_relative_to(out):
        raise InputError(f"--out {out} holds the photographs: give a folder beside them")
    files = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    files = [path for path in files if not path.is_relative_to(out) and path.name[0] != "."]
    found = [path for path in files if path.suffix.lower() in KINDS]
    if len(found) < FEWEST:
        number = f"{len(found) or 'no'} photograph{'' if len(found) == 1 else 's'}"
        raw = sum(path.suffix.lower() in RAW for path in files)
        remedy = "take more, from different places, whose pictures overlap by two thirds"
        if raw:
            remedy = f"{raw} raw files are not read, save them as JPEG"
        elif not found:
            kinds = ", ".join(sorted(KINDS))
            remedy = f"give the folder that holds them; files that end in {kinds} are read"
        raise InputError(f"{folder} has {number}, and {FEWEST} or more are needed: {remedy}")
    _allow_heic([path for path in found if path.suffix.lower() in HEIC])
    photographs = [_read(path, folder) for path in found]
    _refuse_mixed_alpha(photographs)
    if len({photograph.name.lower() for photograph in photographs}) == len(photographs):
        return photographs
    digits = len(str(len(photographs)))
    return [
        replace(each, name=f"{number:0{digits}}_{each.name}")
        for number, each in enumerate(photographs)
    ]


def _read(path: Path, folder: Path) -> Photograph:
    """One photograph, its pixels not decoded yet. InputError if it is of no kind that is used."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # damaged EXIF counts as not there
        header = header_of(path)
        check_kind(path, header)
        with Image.open(path) as image:
            exif = read_exif(image)
    name = re.sub(r"[^\w.\-]+", "_", "_".join(path.relative_to(folder).parts))
    photograph = Photograph(path, name, header, exif)
    if photograph.is_copied or path.suffix.lower() in (".jpg", ".jpeg"):
        return photograph
    ending = ".jpg" if path.suffix.lower() in HEIC else ".png"
    return replace(photograph, name=name if name.endswith(ending) else name + ending)


def _allow_heic(files: list[Path]) -> None:
    """Lets Pillow read HEIC. InputError if there are such files and nothing that reads them."""
    if not files:
        return
    try:
        from pillow_heif import register_heif_opener
    except ImportError:
        raise InputError(
            f"{len(files)} photographs are HEIC, as {files[0].name}: "
            "`pip install pillow-heif` reads them, or save them as JPEG"
        ) from None
    register_heif_opener()


def _refuse_mixed_alpha(photographs: list[Photograph]) -> None:
    """InputError if some photographs have an opacity and others have none."""
    clear = [each for each in photographs if each.header.transparent]
    if clear and len(clear) < len(photographs):
        raise InputError(
            f"{len(clear)} of {len(photographs)} photographs have an alpha channel, the first is "
            f"{clear[0].path}: give it to all of them or to none"
        )


def copy_photographs(
    photographs: list[Photograph], folder: Path, show: Callable[[float], None]
) -> None:
    """Writes those copies that are not there yet; `show` takes the share that is done.

    InputError, with its name, for a photograph whose pixels cannot be decoded.
    """
    for number, photograph in enumerate(photographs):
        if not (folder / photograph.name).is_file():
            _copy(photograph, folder / photograph.name)
        show((number + 1) / len(photographs))


def _copy(photograph: Photograph, path: Path) -> None:
    image = decode(photograph.path, turn=True)  # also of plain copies: it names those cut off
    try:
        if photograph.is_copied:
            with photograph.path.open("rb") as source:
                write_whole(path, lambda file: shutil.copyfileobj(source, file))
        else:
            kind = "PNG" if path.suffix.lower() == ".png" else "JPEG"
            exif = image.getexif()
            exif[0x0112] = 1  # upright from here on
            options = {} if kind == "PNG" else {"quality": QUALITY, "subsampling": 0}
            write_whole(path, lambda file: image.save(file, kind, exif=exif, **options))
    except OSError as error:
        raise InputError(f"{path} cannot be written: {one_line(error, 120)}") from None
