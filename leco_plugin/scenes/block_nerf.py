"""`leco rays`: from the records of Block-NeRF, a ray for each pixel, to a scene with cameras.

The records of Mission Bay (https://waymo.com/research/block-nerf) give neither lens nor pose. A
lens is fitted to the rays of each camera's first picture, then a rotation to those of each picture.
"""

from __future__ import annotations

import gzip
import io
import json
import shutil
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from leco_plugin.log import bar, resumable
from leco_plugin.scenes.input_error import InputError, one_line, require_folder
from leco_plugin.scenes.locks import alone_in
from leco_plugin.scenes.whole_files import write_json, write_whole

Array = NDArray[np.float64]
SCENE, READ = "transforms.json", "read"
"""In the folder of the scene: what is written last; until then a folder of what each file gave."""
INTRINSICS = ("fl_x", "fl_y", "cx", "cy")
DISTORTION = ("k1", "k2", "p1", "p2")
ACROSS, DOWN = 32, 24
"""Rays of a picture that its camera is fitted to."""
STRAIGHT = 0.1
"""Pixels (root mean square) within which a lens is fitted without distortion."""
NO_CAMERA = 0.05
"""Of the width: rays that are farther from every lens are those of no such camera."""
LONGEST = 1 << 31
"""Bytes of a record: none has more."""


@dataclass(frozen=True)
class Picture:
    """A record: a picture and its rays, some of them."""

    name: str
    camera: int
    size: tuple[int, int]
    """Width and height."""
    png: bytes
    pixels: Array
    """[R, 2] middles of pixels, x and y."""
    origins: Array
    """[R, 3] in units of the records."""
    directions: Array
    """[R, 3] of length 1."""


def make_scene(records: Path, out: Path) -> dict[str, Any]:
    """Writes pictures and cameras of a folder of records; returns what was fitted. Goes on with
    what a killed run has left. InputError for other files, or an `out` with a scene."""
    require_folder(records, "give that of the records, *.tfrecord*")
    files = sorted(path for path in records.rglob("*.tfrecord*") if path.is_file())
    if all(_is_validation(path) for path in files):
        raise InputError(f"{records} has no records to train on, *train.tfrecord*")
    with alone_in(out, "scene"), resumable(), bar("Reading the records") as show:
        if (out / SCENE).exists():
            raise InputError(f"--out {out} holds a scene already: give another folder")
        read: list[dict[str, Any]] = []
        lenses: dict[str, dict[str, float]] = {}
        for number, path in enumerate(files):
            part = out / READ / f"{path.relative_to(records)}.json"
            found = json.loads(part.read_text()) if part.is_file() else _read(path, out, lenses)
            lenses |= found["lenses"]
            write_json(part, found)
            read += [each | {"test": _is_validation(path)} for each in found["pictures"]]
            show((number + 1) / len(files))
        _write_scene(out, read)
        shutil.rmtree(out / READ)
    errors = [each["error"] for each in read]
    worst = read[int(np.argmax(errors))]
    return {
        "format": 1,
        "pictures": len(read),
        "test_pictures": sum(each["test"] for each in read),
        "cameras": len(lenses),
        "error": {"median": float(np.median(errors)), "worst": worst["error"]},
        "worst": worst["frame"]["file_path"],
        "moved": max(each["moved"] for each in read),
    }


def summary(report: dict[str, Any]) -> Iterator[str]:
    """Lines that say what a report says."""
    pictures, cameras, error = report["pictures"], report["cameras"], report["error"]
    yield f"{pictures} pictures of {cameras} cameras, {report['test_pictures']} of them for testing"
    worst = f"{error['worst']:.2f} at worst, in {report['worst']}"
    yield f"rays lie {error['median']:.2f} pixels from their pixels (median over pictures), {worst}"
    yield f"rays of one picture begin up to {report['moved']:.3g} from its camera's place"


def _is_validation(path: Path) -> bool:
    return "validation" in path.name


def _read(path: Path, out: Path, known: dict[str, dict[str, float]]) -> dict[str, Any]:
    """Writes the pictures of a file; returns their frames, and the lenses that were not known."""
    lenses: dict[str, dict[str, float]] = {}
    pictures = []
    for picture in _pictures(path):
        key = f"{picture.camera} {picture.size}"
        lens = known.get(key) or lenses.get(key) or fit_lens(picture)
        if key not in known:
            lenses[key] = lens
        pose, error = fit_pose(picture, lens)
        file = f"images/{picture.name}.png"
        write_whole(out / file, lambda to, png=picture.png: to.write(png))  # type: ignore[misc]
        frame = {"file_path": file, **lens, "transform_matrix": pose.tolist()}
        moved = float(np.linalg.norm(picture.origins - pose[:3, 3], axis=1).max())
        pictures.append({"frame": frame, "error": error, "moved": moved})
    return {"lenses": lenses, "pictures": pictures}


def _write_scene(out: Path, read: list[dict[str, Any]]) -> None:
    """Writes transforms.json, its frames in the order of cameras and names."""
    read = sorted(read, key=lambda each: each["frame"]["file_path"])
    meta: dict[str, Any] = {"camera_model": "OPENCV"}
    if any(each["test"] for each in read):  # else every eighth picture is for testing
        for split in ("train", "val", "test"):
            chosen = [each["frame"] for each in read if each["test"] == (split != "train")]
            meta[f"{split}_filenames"] = [frame["file_path"] for frame in chosen]
    meta["frames"] = [each["frame"] for each in read]
    write_json(out / SCENE, meta, indent=1)


def fit_lens(picture: Picture) -> dict[str, float]:
    """The lens of a picture's rays, as transforms.json has it: without distortion where that is
    within a tenth of a pixel. InputError if no lens comes near."""
    width, height = picture.size
    ends = picture.directions.reshape(DOWN, ACROSS, 3)
    pixels = picture.pixels.reshape(DOWN, ACROSS, 2)
    y, x = DOWN // 2, ACROSS // 2
    focal = [
        np.linalg.norm(pixels[far] - pixels[y, x]) / np.linalg.norm(ends[far] - ends[y, x])
        for far in ((y, x + 1), (y + 1, x))
    ]
    first = np.array([*focal, width / 2, height / 2])
    rays = _unit(_through(picture.pixels, first, np.zeros(4)))
    turn = _turn_to(rays, picture.directions).inv().as_rotvec()

    def missed(values: Array) -> Array:
        """Pixels between where rays come from and where this camera has them, one after another."""
        matrix, distortion = _matrix(values[3:7]), values[7:]
        places = picture.directions[:, None]
        seen = cv2.projectPoints(places, values[:3], np.zeros(3), matrix, distortion)[0]
        return np.asarray((seen.reshape(-1, 2) - picture.pixels).ravel(), dtype=float)

    scale = np.array([1.0] * 3 + [float(width)] * 4)
    fitted = least_squares(missed, np.concatenate([turn, first]), x_scale=scale)
    if _apart(fitted.fun.reshape(-1, 2)) > STRAIGHT:
        start = np.append(fitted.x, np.zeros(len(DISTORTION)))
        fitted = least_squares(missed, start, x_scale=np.append(scale, np.ones(len(DISTORTION))))
    error = _apart(fitted.fun.reshape(-1, 2))
    fault = f"are {error:.0f} pixels from every lens" if not error <= NO_CAMERA * width else ""
    if min(fitted.x[3:5]) <= 0.0:
        fault = fault or "are those of a mirrored picture"
    if fault:
        remedy = "no camera with distortion k1, k2, p1, p2 has them"
        raise InputError(f"the rays of {picture.name} {fault}: {remedy}")
    lens = dict(zip(INTRINSICS, map(float, fitted.x[3:7])))
    return {"w": width, "h": height, **lens, **dict(zip(DISTORTION, map(float, fitted.x[7:])))}


def fit_pose(picture: Picture, lens: dict[str, float]) -> tuple[Array, float]:
    """The pose [4, 4] of a picture, OpenGL camera to world, and how far its rays are from those of
    that camera, in pixels (root mean square)."""
    values = np.array([lens[name] for name in INTRINSICS])
    distortion = np.array([lens.get(name, 0.0) for name in DISTORTION])
    rays = _unit(_through(picture.pixels, values, distortion))
    turn = _turn_to(rays, picture.directions)
    pose = np.eye(4)
    pose[:3, :3] = turn.as_matrix() * [1.0, -1.0, -1.0]
    pose[:3, 3] = picture.origins.mean(axis=0)
    return pose, _apart((turn.apply(rays) - picture.directions) * values[:2].mean())


def _through(pixels: Array, intrinsics: Array, distortion: Array) -> Array:
    """Directions [R, 3] through pixels [R, 2], in OpenCV's axes: right, down, forward."""
    points = cv2.undistortPoints(pixels.reshape(-1, 1, 2), _matrix(intrinsics), distortion)
    return np.column_stack([points.reshape(-1, 2), np.ones(len(pixels))])


def _matrix(intrinsics: Array) -> Array:
    fx, fy, cx, cy = intrinsics
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def _unit(directions: Array) -> Array:
    return directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def _turn_to(rays: Array, directions: Array) -> Rotation:
    """The rotation that leads from rays [R, 3] of a camera nearest to directions in the world."""
    return Rotation.align_vectors(directions, rays)[0]


def _apart(offsets: Array) -> float:
    """The root mean square of the lengths of offsets [R, n]."""
    return float(np.sqrt(np.mean(np.sum(offsets**2, axis=-1))))


def _pictures(path: Path) -> Iterator[Picture]:
    """The pictures of a file. InputError for a file that holds something else."""
    try:
        with gzip.open(path) as file:
            while head := file.read(12):  # the length, and a sum of it: gzip has its own
                (length,) = struct.unpack("<Q", head[:8])
                if length > LONGEST:
                    raise ValueError(f"a record of {length} bytes")
                yield _picture(_fields(file.read(length)))
                file.read(4)
    except InputError:
        raise
    except (OSError, EOFError, ValueError, KeyError, struct.error, zlib.error) as error:
        said = f"{type(error).__name__}: {one_line(error, 80)}"
        raise InputError(f"{path} is no file of Block-NeRF's records ({said})") from None


def _picture(fields: dict[str, list[memoryview]]) -> Picture:
    """A picture of its record's fields. ValueError or KeyError if one is missing or wrong."""
    camera, known, width, height = (
        _varint(fields[name][0])[0] for name in ("cam_idx", "image_hash", "width", "height")
    )
    png = bytes(fields["image"][0])
    with Image.open(io.BytesIO(png)) as image:
        if image.size != (width, height) or min(image.size) < ACROSS:
            raise ValueError(f"a picture of {image.size} pixels for {width} x {height} rays")
    x, y = (
        np.linspace(0, n - 1, c).round().astype(int) for n, c in ((width, ACROSS), (height, DOWN))
    )
    places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    rays = [
        np.frombuffer(fields[name][0], "<f4").reshape(height, width, 3)[places[:, 1], places[:, 0]]
        for name in ("ray_origins", "ray_dirs")
    ]
    origins, directions = (each.astype(float) for each in rays)
    lengths = np.linalg.norm(directions, axis=1)
    if not (np.isfinite(origins).all() and np.isfinite(lengths).all() and lengths.all()):
        raise ValueError("rays that are not finite, or of length 0")
    name = f"cam{camera:02d}_{known:016x}"
    return Picture(name, camera, (width, height), png, places + 0.5, origins, _unit(directions))


def _fields(record: bytes) -> dict[str, list[memoryview]]:
    """The fields of a tf.train.Example, whose class only tensorflow brings: bytes, or numbers,
    which are packed, as bytes."""
    found = {}
    for _, features in _parts(memoryview(record)):
        for _, entry in _parts(features):
            named = dict(_parts(entry))
            for _, values in _parts(named[2]):
                found[str(named[1], "utf-8")] = [value for _, value in _parts(values)]
    return found


def _parts(message: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Number and content of each field of a message of protobuf, all of which have a length here.
    ValueError for one that has none, or is cut off."""
    at = 0
    while at < len(message):
        key, at = _varint(message, at)
        length, at = _varint(message, at)
        if key & 7 != 2 or at + length > len(message):
            raise ValueError("a record of another form, or cut off")
        yield key >> 3, message[at : at + length]
        at += length


def _varint(message: memoryview, at: int = 0) -> tuple[int, int]:
    """A whole number, seven bits a byte and the least first, and where it ends."""
    value = 0
    for shift, byte in enumerate(message[at : at + 10]):
        value |= (byte & 127) << (7 * shift)
        if byte < 128:
            return value, at + shift + 1
    raise ValueError("a whole number without an end")
