"""A scene in Mega-NeRF's format without a renderer: coloured noise seen from a drone."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from leco_plugin.scenes.city.cameras import look_at
from leco_plugin.scenes.mega_nerf_files import (
    Coordinates,
    write_coordinates,
    write_mappings,
    write_view,
)

WIDTH, HEIGHT = 24, 16
COORDINATES = Coordinates(np.array([-90.0, 12.0, -300.0]), 40.0)
INTRINSICS = (20.0, 21.0, 12.5, 7.5)
VALIDATION = (2, 5)
"""Numbers of the pictures that are held out."""


def poses(count: int = 7) -> np.ndarray:
    """[count, 3, 4] metres, (right, forward, up): cameras at 100 m and more that look down."""
    random = np.random.default_rng(3)
    middle = np.array([12.0, 300.0, 90.0])
    places = middle + np.column_stack(
        [random.uniform(-35, 35, (count, 2)), random.uniform(10, 30, count)]
    )
    targets = places * [1, 1, 0] + np.column_stack(
        [random.uniform(-40, 40, (count, 2)), np.zeros(count)]
    )
    return np.stack([look_at(place, target) for place, target in zip(places, targets)])


def image(number: int, channels: int = 3) -> np.ndarray:
    """[HEIGHT, WIDTH, channels] noise."""
    random = np.random.default_rng(number)
    return random.integers(0, 256, (HEIGHT, WIDTH, channels), dtype=np.uint8)


def write(folder: Path, masks: bool = False) -> Path:
    """Writes seven pictures, two of them for validation; returns `folder`."""
    write_coordinates(folder, COORDINATES)
    for number, pose in enumerate(COORDINATES.to_file(poses())):
        split = "val" if number in VALIDATION else "train"
        write_view(folder, split, f"{number:06d}", image(number), pose, INTRINSICS)
        if masks:
            write_mask(folder / "masks", f"{number:06d}", mask(number))
    write_mappings(folder, {f"DJI_{n}.JPG": f"{n:06d}" for n in range(7)})
    return folder


def mask(number: int) -> np.ndarray:
    """bool [HEIGHT, WIDTH]; that of picture 4 keeps nothing."""
    keep = np.random.default_rng(number).random((HEIGHT, WIDTH)) < 0.7
    return keep & (number != 4)


def write_mask(folder: Path, stem: str, keep: np.ndarray) -> None:
    """Writes the mask [H, W] of a picture into `folder`; False leaves a pixel out of training."""
    folder.mkdir(exist_ok=True)
    pack(folder / f"{stem}.pt", torch.from_numpy(keep), f"{stem}.pt")


def pack(path: Path, value: object, name: str = "a.pt", **options: int) -> Path:
    """Writes a zip that holds a value under a name, as masks are held; returns `path`."""
    path.write_bytes(zipped(saved(value), name, **options))
    return path


def saved(value: object, **options: Any) -> bytes:
    """What torch.save writes of a value."""
    file = io.BytesIO()
    torch.save(value, file, **options)
    return file.getvalue()


def zipped(data: bytes, name: str, compression: int = zipfile.ZIP_STORED) -> bytes:
    """A zip of one file."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", compression) as archive:
        archive.writestr(name, data)
    return file.getvalue()


def rebuilt(data: bytes, change: Callable[[bytes], bytes], part: str = "data.pkl") -> bytes:
    """An archive with one of its records changed, and right in all else."""
    file = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as source, zipfile.ZipFile(file, "w") as target:
        for entry in source.infolist():
            record, changed = source.read(entry), entry.filename.endswith(part)
            target.writestr(entry.filename, change(record) if changed else record)
    return file.getvalue()
