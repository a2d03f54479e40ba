"""A survey from the air that numpy renders: textured ground, blocks on it, exact GPS in EXIF."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

Array = NDArray[np.float64]
WIDTH, HEIGHT, FOCAL = 320, 240, 256.0
CELL = 0.2
"""Metres of a cell of the finest texture."""
ORIGIN = (41.5, -83.25)
"""Latitude and longitude of the survey's middle, of the altitude 0."""
METRES_A_DEGREE = (111_071.0, 83_506.0)
"""Northwards and eastwards there."""
BLOCKS = ((-20, -12, 10, 9, 7.0), (6, -9, 13, 8, 10.0), (-8, 6, 9, 12, 5.0), (14, 7, 11, 10, 8.0))
"""West, south, width, depth and height of the blocks on the ground, metres."""


def photograph(
    place: Sequence[float], heading: float = 0.0, seed: int = 0, tilt: float = 12.0
) -> Image.Image:
    """What a camera at a place (metres east, north, up) sees.

    Args:
        heading: degrees from north to where the picture's top edge is, clockwise.
        seed: another seed, another ground.
        tilt: degrees by which it looks ahead of straight down. Where all look straight down, focal
            length and height cannot be told apart.
    """
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    right, back = (columns - WIDTH / 2) / FOCAL, (rows - HEIGHT / 2) / FOCAL
    sine, cosine = np.sin(np.radians(tilt)), np.cos(np.radians(tilt))
    fall = cosine + back * sine
    right, ahead = right / fall, (sine - back * cosine) / fall
    sine, cosine = np.sin(np.radians(heading)), np.cos(np.radians(heading))
    east, north = right * cosine + ahead * sine, ahead * cosine - right * sine
    grey = _texture(place[0] + place[2] * east, place[1] + place[2] * north, seed)
    for number, (west, south, width, depth, height) in enumerate(BLOCKS):
        fall = place[2] - height
        x, y = place[0] + fall * east, place[1] + fall * north
        inside = (x > west) & (x < west + width) & (y > south) & (y < south + depth)
        grey = np.where(inside, _texture(x, y, seed + number + 1), grey)
    return Image.fromarray((255 * grey).astype(np.uint8)).convert("RGB")


def _texture(x: Array, y: Array, seed: int) -> Array:
    """Grey values in [0, 1] of places: noise of several sizes."""
    total = np.zeros_like(x)
    for octave in range(4):
        table = np.random.default_rng(1000 * seed + octave).random((256, 256))
        u, v = (each / (CELL * 2**octave) + 100 for each in (x, y))
        column, row = np.floor(u).astype(int), np.floor(v).astype(int)
        a, b = u - column, v - row
        near, far = (
            (1 - a) * table[at % 256, column % 256] + a * table[at % 256, (column + 1) % 256]
            for at in (row, row + 1)
        )
        total += ((1 - b) * near + b * far) / 4
    return np.clip(0.5 + 1.6 * (total - 0.5), 0.0, 1.0)


def odd_exif(tag: tuple[int, int, int, bytes], orientation: int = 6) -> bytes:
    """EXIF with an orientation and one tag: its number, type, count and 4 bytes of value."""
    entries = struct.pack("<HHIHH", 0x112, 3, 1, orientation, 0) + struct.pack("<HHI4s", *tag)
    return b"Exif\0\0II*\0" + struct.pack("<IH", 8, 2) + entries + bytes(4)


def exif_of(place: Sequence[float] | None, second: int = 0) -> Image.Exif:
    """EXIF with an equivalent focal length, a time, and the position of a place if there is one."""
    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = "Numpy", "Survey"
    film = FOCAL / np.hypot(WIDTH, HEIGHT) * np.hypot(36.0, 24.0)
    time = f"2026:05:01 12:{second // 60:02}:{second % 60:02}"
    exif[0x8769] = {0xA405: round(float(film)), 0x9003: time}
    if place is not None:
        east, north, up = place
        latitude = ORIGIN[0] + north / METRES_A_DEGREE[0]
        longitude = ORIGIN[1] + east / METRES_A_DEGREE[1]
        exif[0x8825] = {
            **{1: "N", 2: (latitude, 0.0, 0.0), 3: "W", 4: (-longitude, 0.0, 0.0)},
            **{5: b"\x00", 6: up},
        }
    return exif


def grid(columns: int, rows: int, step: float = 14.0, height: float = 60.0) -> list[list[float]]:
    """Places of a flight in rows over the middle, at heights that differ a little."""
    return [
        [step * (column - (columns - 1) / 2), step * (row - (rows - 1) / 2), height + 3 * (row % 2)]
        for row in range(rows)
        for column in range(columns)
    ]


PLACES = grid(4, 3)


def write_survey(
    folder: Path, places: Sequence[Sequence[float]], seed: int = 0, gps: bool = True
) -> list[Path]:
    """Photographs at places as JPEG files; rows are flown to and fro."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for number, place in enumerate(places):
        path = folder / f"IMG_{seed}{number:03}.jpg"
        picture = photograph(place, 180.0 * (number % 2), seed)
        picture.save(path, quality=95, exif=exif_of(place if gps else None, 2 * number))
        paths.append(path)
    return paths
