"""What EXIF says of a photograph: position, time, camera, and focal length in pixels."""

from __future__ import annotations

import math
from collections.abc import Mapping
from datetime import datetime
from typing import Any, NamedTuple

from PIL import ExifTags, Image

INCH, CENTIMETRE = 25.4, 10.0
UNITS = {2: INCH, 3: CENTIMETRE, 4: 1.0}
"""EXIF's FocalPlaneResolutionUnit, in millimetres."""
FILM_DIAGONAL = math.hypot(36.0, 24.0)
"""Of the 35 mm film, in millimetres, to which equivalent focal lengths refer."""
FOCAL_RANGE = (0.2, 20.0)
"""Focal lengths over the longest side. What lies outside is a mistake in the file."""


class Exif(NamedTuple):
    """What is known of a photograph; None where EXIF does not say it."""

    position: tuple[float, float, float] | None = None
    """Latitude and longitude in degrees, altitude in metres. The altitude may be nan."""
    time: float | None = None
    """Seconds, of the camera's clock."""
    camera: str = ""
    """Maker, model and focal length: the same of photographs that share a lens."""
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
    camera = " ".join(str(part) for part in (tags.get(0x010F), tags.get(0x0110), *lens))
    return Exif(_position(gps), _time(details), camera, focal_length(details, image.size))


def focal_length(details: Mapping[int, Any], size: tuple[int, int]) -> float | None:
    """Focal length over the longest side of a picture.

    Args:
        details: EXIF's own tags. The equivalent for 35 mm goes before the resolution of the
            sensor, which is that of the picture as it was taken, not of one made smaller.
        size: width and height of the picture.
    """
    diagonal = math.hypot(*size) / max(size)
    equivalent = _number(details.get(ExifTags.Base.FocalLengthIn35mmFilm))
    found = diagonal * equivalent / FILM_DIAGONAL
    if not FOCAL_RANGE[0] < found < FOCAL_RANGE[1]:
        resolution = _number(details.get(ExifTags.Base.FocalPlaneXResolution))
        unit = UNITS.get(int(_number(details.get(ExifTags.Base.FocalPlaneResolutionUnit)) or 2))
        taken = max(
            _number(details.get(ExifTags.Base.ExifImageWidth)),
            _number(details.get(ExifTags.Base.ExifImageHeight)),
        )
        if unit is None or taken <= 0.0:
            return None
        found = _number(details.get(ExifTags.Base.FocalLength)) * resolution / unit / taken
    return found if FOCAL_RANGE[0] < found < FOCAL_RANGE[1] else None


def _position(gps: Mapping[int, Any]) -> tuple[float, float, float] | None:
    """Position; None where it is not said, or is the 0, 0 of a receiver without satellites."""
    latitude = _degrees(gps.get(ExifTags.GPS.GPSLatitude), gps.get(ExifTags.GPS.GPSLatitudeRef))
    longitude = _degrees(gps.get(ExifTags.GPS.GPSLongitude), gps.get(ExifTags.GPS.GPSLongitudeRef))
    if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0) or latitude == longitude == 0.0:
        return None
    altitude = _number(gps.get(ExifTags.GPS.GPSAltitude, math.nan), math.nan)
    below = gps.get(ExifTags.GPS.GPSAltitudeRef) in (1, b"\x01")
    return latitude, longitude, -altitude if below else altitude


def _degrees(parts: Any, reference: Any) -> float:
    """Degrees of three parts; nan where they are none."""
    if not isinstance(parts, tuple) or len(parts) != 3:
        return math.nan
    degrees, minutes, seconds = (_number(part, math.nan) for part in parts)
    total = degrees + minutes / 60.0 + seconds / 3600.0
    return -total if str(reference).strip().upper()[:1] in ("S", "W") else total


def _time(details: Mapping[int, Any]) -> float | None:
    try:
        taken = datetime.strptime(
            str(details[ExifTags.Base.DateTimeOriginal])[:19], "%Y:%m:%d %H:%M:%S"
        )
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
