"""The photographs of a folder, which are only read: what EXIF says, checks before long work, and
copies for the scene, JPEG or PNG with 8 bits a channel, upright as EXIF says."""

from __future__ import annotations

import filecmp
import hashlib
import math
import os
import re
import shutil
import sys
import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from PIL import ExifTags, Image

from leco_plugin.log import by_number, counted, for_each
from leco_plugin.scenes.input_error import InputError, require_folder
from leco_plugin.scenes.photograph_files import Header, check_kind, decode, header_of, is_plain
from leco_plugin.scenes.whole_files import write_whole, writing_into

T = TypeVar("T")
Position = tuple[float, float, float]
"""Latitude and longitude in degrees, altitude in metres, which may be nan."""
UNITS = {2: 25.4, 3: 10.0, 4: 1.0}
"""EXIF's FocalPlaneResolutionUnit, inch, centimetre or millimetre, in millimetres."""
FILM_DIAGONAL = math.hypot(36.0, 24.0)
"""Of the 35 mm film, in millimetres, to which equivalent focal lengths refer."""
FOCAL_RANGE = (0.2, 20.0)
"""Focal lengths over the longest side. What lies outside is a mistake in the file."""


class Exif(NamedTuple):
    """What is known of a photograph; None where EXIF does not say it."""

    position: Position | None = None
    time: float | None = None
    """Seconds, of the camera's clock."""
    camera: str = ""
    """Maker, model, focal length and zoom: the same of photographs that share a lens."""
    focal: float | None = None
    """Focal length over the longest side of the picture."""


def read_exif(image: Image.Image) -> Exif:
    """What EXIF says of an opened image. Damaged parts count as not said."""
    try:
        tags = image.getexif()
        details = dict(tags.get_ifd(ExifTags.IFD.Exif))
        gps = dict(tags.get_ifd(ExifTags.IFD.GPSInfo))
    except Exception:  # noqa: BLE001  damaged EXIF raises whatever its parser meets
        return Exif()
    lens = [_number(details.get(tag)) for tag in (0x920A, 0xA405)]
    zoom = _number(details.get(ExifTags.Base.DigitalZoomRatio))
    lens += [zoom] if zoom > 1.0 else []  # 0 is another word for none
    camera = " ".join(str(part) for part in (tags.get(0x010F), tags.get(0x0110), *lens))
    return Exif(_position(gps), _time(details), camera, focal_length(details, image.size))


def focal_length(details: Mapping[int, Any], size: tuple[int, int]) -> float | None:
    """Focal length over the longest side of a picture of a size, or None. The 35 mm equivalent goes
    before the sensor's resolution, which is that of the picture as taken."""

    def said(tag: ExifTags.Base) -> float:
        return _number(details.get(tag))

    equivalent = said(ExifTags.Base.FocalLengthIn35mmFilm)
    found = math.hypot(*size) / max(size) * equivalent / FILM_DIAGONAL
    if not FOCAL_RANGE[0] < found < FOCAL_RANGE[1]:
        unit = UNITS.get(int(said(ExifTags.Base.FocalPlaneResolutionUnit) or 2))
        taken = max(said(ExifTags.Base.ExifImageWidth), said(ExifTags.Base.ExifImageHeight))
        if unit is None or taken <= 0.0:
            return None
        resolution = said(ExifTags.Base.FocalPlaneXResolution)
        found = said(ExifTags.Base.FocalLength) * resolution / unit / taken
    return found if FOCAL_RANGE[0] < found < FOCAL_RANGE[1] else None


def _position(gps: Mapping[int, Any]) -> Position | None:
    """Position; None where it is not said, or is the 0, 0 of a receiver without satellites."""
    latitude = _degrees(gps.get(ExifTags.GPS.GPSLatitude), gps.get(ExifTags.GPS.GPSLatitudeRef))
    longitude = _degrees(gps.get(ExifTags.GPS.GPSLongitude), gps.get(ExifTags.GPS.GPSLongitudeRef))
    if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0) or latitude == longitude == 0.0:
        return None
    altitude = _number(gps.get(ExifTags.GPS.GPSAltitude), math.nan) or math.nan  # 0: not known
    # below the sea or, since EXIF 3, below the ellipsoid
    below = gps.get(ExifTags.GPS.GPSAltitudeRef) in (1, 3, b"\x01", b"\x03")
    return latitude, longitude, -altitude if below else altitude


def _degrees(parts: Any, reference: Any) -> float:
    """Degrees of two or three parts; nan where they are none. Blank minutes and seconds are 0."""
    if not isinstance(parts, tuple) or len(parts) not in (2, 3):
        return math.nan
    signed = [_number(parts[0], math.nan), *(_number(part) for part in parts[1:])]
    total = sum(abs(part) / 60.0**power for power, part in enumerate(signed))
    named = reference.decode("ascii", "replace") if isinstance(reference, bytes) else str(reference)
    is_negative = named.strip("\0 ").upper()[:1] in ("S", "W") or min(signed) < 0.0
    return -total if is_negative else total


def _time(details: Mapping[int, Any]) -> float | None:
    try:
        said = str(details[ExifTags.Base.DateTimeOriginal])[:19]
        taken = datetime.strptime(said, "%Y:%m:%d %H:%M:%S")
        fraction = str(details.get(ExifTags.Base.SubsecTimeOriginal, "")).strip("\0 ")
        part = float(f"0.{fraction}") if fraction.isdecimal() else 0.0
        return (taken - datetime(1970, 1, 1)).total_seconds() + part
    except (KeyError, ValueError):
        return None


def _number(value: Any, otherwise: float = 0.0) -> float:
    """A finite number, or what counts as none."""
    try:
        found = float(value)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return otherwise
    return found if math.isfinite(found) else otherwise


HEIC = (".heic", ".heif")
KINDS = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp", *HEIC)
RAW = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".rw2", ".orf")
FILMS = (".mp4", ".mov", ".avi", ".mkv", ".m4v")
COPIED = {"JPEG": (".jpg", ".jpeg"), "MPO": (".jpg", ".jpeg"), "PNG": (".png",)}
"""Kinds, by Pillow's name, that are copied byte by byte where their colours need no change and
their names end so: pycolmap reads no other."""
FEWEST = 3
LONGEST, MOST_BYTES = 80, 240
"""Letters and bytes of a copy's name, its last ones: it may have 255 bytes, with a number before it
and an ending behind."""
PROBED = 4096
"""Bytes at either end of a file that tell most apart before all of them are compared."""
QUALITY = 95
MOST_EXIF = 65_533
"""Bytes of EXIF that a JPEG can hold."""


@dataclass(frozen=True)
class Photograph:
    """One photograph of the folder."""

    path: Path
    name: str
    """Of its copy in the scene: no blanks and no folders."""
    header: Header
    exif: Exif
    described: int = 0
    """Bytes of a JPEG that say something of its picture, as EXIF and comments do."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, upright."""
        width, height = self.header.size
        return (height, width) if self.header.orientation >= 5 else (width, height)

    @property
    def content(self) -> tuple[object, ...]:
        """The same of the same picture with the same lens, whatever its GPS."""
        length = self.path.stat().st_size - self.described
        return self.name, length, self.size, self.header.orientation, self.exif[2:]

    @property
    def lens(self) -> tuple[object, ...]:
        """The same of photographs that share their intrinsics."""
        return self.size, self.exif.camera

    @property
    def is_copied(self) -> bool:
        """Whether the copy has the bytes of the original."""
        upright = self.header.orientation == 1 and is_plain(self.header)
        return upright and self.path.suffix.lower() in COPIED.get(self.header.format, ())


class Found(NamedTuple):
    """What a folder holds."""

    photographs: list[Photograph]
    refused: dict[Path, str]
    """Files that cannot be used, each with a line that says why."""
    repeats: tuple[Path, ...] = ()
    """Those of them that are copies of others."""


def find_photographs(folder: Path, out: Path) -> Found:
    """The photographs below a folder, but for `out`, by name. InputError for fewer than three."""
    require_folder(folder, "give the one with the photographs")
    if folder.is_relative_to(out):
        raise InputError(f"--out {out} holds the photographs: give a folder beside them")
    refused: dict[Path, str] = {}
    files = _files_below(folder, out, refused)
    found = [path for path in files if path.suffix.lower() in KINDS]
    if len(found) < FEWEST:
        number = counted(len(found), "photograph") if found else "no photographs"
        raw = sum(path.suffix.lower() in RAW for path in files)
        films = sum(path.suffix.lower() in FILMS for path in files)
        remedy = "take more, from different places, whose pictures overlap by two thirds"
        if refused:
            remedy = f"{next(iter(refused.values()))}: give yourself the right to read it"
        elif raw:
            some = counted(raw, "raw file is", "raw files are")
            remedy = f"{some} not read, save {by_number(raw, 'it', 'them')} as JPEG"
        elif films:
            some = counted(films, "video is", "videos are")
            remedy = f"{some} not read: take pictures out of {by_number(films, 'it', 'them')}"
            remedy += ", two a second, as by ffmpeg -i FILM -vf fps=2 PHOTOS/%05d.jpg"
        elif not found:
            kinds = ", ".join(sorted(KINDS))
            remedy = f"give the folder that holds them; files that end in {kinds} are read"
        raise InputError(f"{folder} has {number}, and {FEWEST} or more are needed: {remedy}")
    with suppress(ImportError):
        import_module("pillow_heif").register_heif_opener()
    photographs = [each for path in found if (each := _or_why(_read, path, folder, refused))]
    clear = [each.path for each in photographs if each.header.transparent]
    if clear and len(clear) < len(photographs):
        have = by_number(len(clear), "has", "have")
        some = f"{len(clear)} of {len(photographs)} photographs {have} an alpha channel"
        raise InputError(f"{some}, the first is {clear[0]}: give it to all of them or to none")
    if len({photograph.name.lower() for photograph in photographs}) < len(photographs):
        digits = len(str(len(photographs)))
        photographs = [
            replace(each, name=f"{number:0{digits}}_{each.name}")
            for number, each in enumerate(photographs)
        ]
    return _enough(Found(photographs, refused))


def without_repeats(found: Found) -> Found:
    """What was found, each file once: a copy for tests would score its original in training.
    InputError for fewer than three."""
    firsts: dict[tuple[int, bytes], list[Path]] = {}
    repeats: dict[Path, str] = {}
    for path in (each.path for each in found.photographs):
        with path.open("rb") as file:
            size, head = path.stat().st_size, file.read(PROBED)
            file.seek(max(0, size - PROBED))
            ends = hashlib.blake2b(head + file.read(), digest_size=16).digest()
        alike = firsts.setdefault((size, ends), [])
        same = next((first for first in alike if filecmp.cmp(first, path, shallow=False)), None)
        if same is None:
            alike.append(path)
        else:
            repeats[path] = f"{path} is the same file as {same}"
    others = [each for each in found.photographs if each.path not in repeats]
    return _enough(Found(others, found.refused | repeats, (*repeats,)))


def _files_below(folder: Path, out: Path, refused: dict[Path, str]) -> list[Path]:
    """Files in a folder and below it, by name, each folder once; none hidden, and none in `out`.
    Links that lead nowhere count too, and folders that cannot be read are noted in `refused`."""

    def note(error: OSError) -> None:
        refused[Path(error.filename)] = f"{error.filename} cannot be read ({error.strerror})"

    found: list[Path] = []
    known = set()
    starts = [folder]  # linked folders follow, so that a folder is known by its own name first
    for start in starts:
        for place, folders, names in os.walk(start, onerror=note):
            here, real = Path(place), Path(place).resolve()
            # thumbnails and previews of other programs lie in hidden folders
            folders[:] = sorted(name for name in folders if name[0] != ".")
            if real in known or real.is_relative_to(out.resolve()):
                folders.clear()
                continue
            known.add(real)
            starts += [here / name for name in folders if (here / name).is_symlink()]
            found += [here / name for name in names if name[0] != "."]
    return sorted(path for path in found if os.path.isfile(path) or not os.path.exists(path))


def _enough(found: Found) -> Found:
    """What was found. InputError if too much of it cannot be used."""
    used, files = len(found.photographs), len(found.photographs) + len(found.refused)
    if used < FEWEST:
        left = f"{used} of {counted(files, 'photograph')} can be used, and {FEWEST} are needed"
        raise InputError(f"{next(iter(found.refused.values()))} ({left})")
    return found


def _or_why(
    use: Callable[[Path, Any], T], path: Path, how: Any, refused: dict[Path, str]
) -> T | None:
    """What `use` makes of a file; None, and the reason is noted, where it raises InputError."""
    try:
        return use(path, how)
    except InputError as error:
        refused[path] = str(error)
        return None


def _read(path: Path, folder: Path) -> Photograph:
    """One photograph, its pixels not decoded yet. InputError if it is of no kind that is used."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # damaged EXIF counts as not there
        try:
            header = header_of(path)
        except InputError:
            if path.suffix.lower() not in HEIC or sys.modules.get("pillow_heif"):
                raise
            remedy = "`pip install pillow-heif` reads it, or save it as JPEG"
            raise InputError(f"{path} is HEIC: {remedy}") from None
        check_kind(path, header)
        with Image.open(path) as image:
            exif, segments = read_exif(image), getattr(image, "applist", ())
    name = re.sub(r"[^\w.\-]+", "_", "_".join(path.relative_to(folder).parts))[-LONGEST:]
    name = name.encode()[-MOST_BYTES:].decode(errors="ignore")
    described = sum(4 + len(segment) for _, segment in segments)  # a marker, and its length
    photograph = Photograph(path, name, header, exif, described)
    suffix = path.suffix.lower()
    if photograph.is_copied or (suffix in COPIED["JPEG"] and not header.transparent):
        return photograph
    ending = ".jpg" if suffix in HEIC and not header.transparent else ".png"
    return replace(photograph, name=name if name.endswith(ending) else name + ending)


def copy_photographs(found: Found, folder: Path) -> Found:
    """Writes the copies that are missing. Returns what was found without what cannot be decoded.
    InputError if fewer than three photographs are left, or a copy cannot be written."""
    refused = dict(found.refused)

    def copy(photograph: Photograph) -> None:
        path = folder / photograph.name
        # plain copies are decoded too: it shows which are cut off
        if not path.is_file() and (image := _or_why(decode, photograph.path, True, refused)):
            _write(photograph, image, path)

    for_each("copying photographs", found.photographs, copy)
    left = [each for each in found.photographs if each.path not in refused]
    return _enough(Found(left, refused, found.repeats))


def _write(photograph: Photograph, image: Image.Image, path: Path) -> None:
    with photograph.path.open("rb") as source, writing_into(path.parent, "--out"):
        if photograph.is_copied:
            write_whole(path, lambda file: shutil.copyfileobj(source, file))
            return
        kind = "PNG" if path.suffix.lower() == ".png" else "JPEG"
        options: dict[str, Any] = {"exif": _upright_exif(image, kind)}
        options |= {} if kind == "PNG" else {"quality": QUALITY, "subsampling": 0}
        write_whole(path, lambda file: image.save(file, kind, **options))


def _upright_exif(image: Image.Image, kind: str) -> bytes:
    """EXIF of an image turned upright: only this, if the rest cannot be written or is too long."""
    upright = Image.Exif()
    upright[ExifTags.Base.Orientation] = 1
    with suppress(Exception):  # tags of another type than the standard's raise many errors
        exif = image.getexif()
        exif[ExifTags.Base.Orientation] = 1
        if kind == "PNG" or len(exif.tobytes()) <= MOST_EXIF:
            return exif.tobytes()
    return upright.tobytes()
