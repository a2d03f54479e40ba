"""`leco rays`: from the records of Block-NeRF, a ray for each pixel, to a scene with cameras.

The records of Mission Bay (https://waymo.com/research/block-nerf) give neither lens nor pose. A
lens is fitted to rays of some pictures of each camera, then a rotation to those of each picture.
"""

from __future__ import annotations

import gzip
import io
import shutil
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from leco_plugin.log import counted, for_each, resumable
from leco_plugin.scenes.input_error import InputError, one_line, require_folder
from leco_plugin.scenes.whole_files import (
    alone_in,
    digest_of_file,
    remove_parts,
    write_json,
    write_whole,
)

Array = NDArray[np.float64]
SCENE, READ = "transforms.json", "leco-rays"
"""In the folder of the scene: what is written last; until then a folder of what each file gave."""
INTRINSICS = ("fl_x", "fl_y", "cx", "cy")
DISTORTION = ("k1", "k2", "p1", "p2")
ACROSS, DOWN = 32, 24
"""Rays of a picture that its camera is fitted to."""
LENSES = 16
"""Pictures of a camera to which a lens is fitted. The best is kept: a car that turns bends rays."""
STRAIGHT = 0.1
"""Pixels (root mean square) within which a lens is fitted without distortion."""
NO_CAMERA = 0.05
"""Of the width: rays that are farther from every lens are those of no such camera."""
LONGEST = 1 << 31
"""Bytes of a record: none has more."""
FAULTS = (EOFError, ValueError, LookupError, struct.error, zlib.error, gzip.BadGzipFile)
"""What files of something else raise when they are read."""
RAYS = np.dtype(
    [
        *(("name", "U40"), ("camera", "i8"), ("width", "i8"), ("height", "i8"), ("test", "?")),
        *(("place", "f8", 3), ("moved", "f8"), ("directions", "f4", (ACROSS * DOWN, 3))),
    ]
)
"""Of a picture: the mean of its rays' origins, in units of the records, how far one of them is from
there at most, and directions of length 1 of the rays of ACROSS x DOWN of its pixels."""


def make_scene(records: Path, out: Path) -> dict[str, Any]:
    """Makes a scene of records; returns what was fitted. A picture that stands twice counts once,
    for testing if either does. InputError for other files, or an `out` with a scene."""
    require_folder(records, "give that of the records, *.tfrecord*")
    files = sorted(path for path in records.rglob("*.tfrecord*") if path.is_file())
    if all("validation" in path.name for path in files):
        raise InputError(f"{records} has no records to train on, *train.tfrecord*")
    with alone_in(out, "scene"), resumable():
        if (out / SCENE).exists():
            raise InputError(f"--out {out} holds a scene already: give another folder")
        remove_parts(out)

        def rays_of(path: Path) -> NDArray[Any]:
            kept = out / READ / f"{digest_of_file(path)}.npy"
            if kept.is_file():
                return np.asarray(np.load(kept))
            rays = np.array([*_read(path, out)], dtype=RAYS)
            write_whole(kept, lambda file: np.save(file, rays))
            return rays

        found = for_each("Reading the records", files, rays_of)
        pictures = np.sort(np.concatenate(found), order=("name", "test"))
        names = pictures["name"]
        report = _write_scene(out, pictures[np.append(names[1:] != names[:-1], True)])
        shutil.rmtree(out / READ)
    return report


def summary(report: dict[str, Any]) -> Iterator[str]:
    """Lines that say what a report says."""
    error, tests = report["error"], report["test_pictures"]
    pictures = counted(report["pictures"], "picture")
    yield f"{pictures} of {counted(report['cameras'], 'camera')}, {tests} of them for testing"
    worst = f"{error['worst']:.2f} at worst, in {report['worst']}"
    yield f"rays lie {error['median']:.2f} pixels from their pixels (median over pictures), {worst}"
    yield f"rays of one picture begin up to {report['moved']:.3g} from its camera's place"


def _write_scene(out: Path, pictures: NDArray[Any]) -> dict[str, Any]:
    """Fits cameras to the rays of pictures [P], and writes transforms.json; returns the report."""
    kinds = [tuple(map(int, each[["camera", "width", "height"]])) for each in pictures]
    lenses = {kind: best_lens(pictures[[k == kind for k in kinds]]) for kind in sorted({*kinds})}
    frames, errors = [], []
    for kind, rays in zip(kinds, pictures):
        pose, error = fit_pose(rays, lenses[kind])
        file = f"images/{rays['name']}.png"
        frames.append({"file_path": file, **lenses[kind], "transform_matrix": pose.tolist()})
        errors.append(error)
    meta: dict[str, Any] = {"camera_model": "OPENCV"}
    if pictures["test"].any():  # else every eighth picture is for testing
        for split in ("train", "val", "test"):
            chosen = pictures["test"] == (split != "train")
            meta[f"{split}_filenames"] = [f["file_path"] for f, of in zip(frames, chosen) if of]
    write_json(out / SCENE, meta | {"frames": frames}, indent=1)
    return {
        "format": 1,
        "pictures": len(pictures),
        "test_pictures": int(pictures["test"].sum()),
        "cameras": len(lenses),
        "error": {"median": float(np.median(errors)), "worst": max(errors)},
        "worst": frames[int(np.argmax(errors))]["file_path"],
        "moved": float(pictures["moved"].max()),
    }


def best_lens(pictures: NDArray[Any]) -> dict[str, float]:
    """The best lens of a camera, as transforms.json has it. InputError if none comes near."""
    some = np.unique(np.linspace(0, len(pictures) - 1, LENSES).astype(int))
    lens, error = min((fit_lens(pictures[each]) for each in some), key=lambda found: found[1])
    fault = ""
    if not error <= NO_CAMERA * lens["w"]:
        fault = f"are {error:.0f} pixels from every lens"
    elif min(lens["fl_x"], lens["fl_y"]) <= 0.0:
        fault = "are those of a mirrored picture"
    if fault:
        remedy = "no camera with distortion k1, k2, p1, p2 has them"
        raise InputError(f"the rays of {pictures[0]['name']} {fault}: {remedy}")
    return lens


def fit_lens(rays: np.void) -> tuple[dict[str, float], float]:
    """The lens of a picture, without distortion within `STRAIGHT`, and its distance in pixels."""
    width, height = int(rays["width"]), int(rays["height"])
    pixels, directions = _pixels(width, height), rays["directions"].astype(float)
    ends, places = directions.reshape(DOWN, ACROSS, 3), pixels.reshape(DOWN, ACROSS, 2)
    y, x = DOWN // 2, ACROSS // 2
    focal = [
        np.linalg.norm(places[far] - places[y, x])
        / max(float(np.linalg.norm(ends[far] - ends[y, x])), 1e-9)
        for far in ((y, x + 1), (y + 1, x))
    ]
    first = np.array([*focal, width / 2, height / 2])
    values, error = _fit(rays, np.append(_turn(directions, pixels, first), first))
    if error > STRAIGHT:
        values, error = _fit(rays, np.append(values, np.zeros(len(DISTORTION))))
    lens = dict(zip((*INTRINSICS, *DISTORTION), map(float, values[3:])))
    return {"w": width, "h": height, **lens}, error


def fit_pose(rays: np.void, lens: dict[str, float]) -> tuple[Array, float]:
    """The pose [4, 4] of a picture, OpenGL camera to world, and its rays' distance in pixels."""
    known = np.array([lens.get(name, 0.0) for name in (*INTRINSICS, *DISTORTION)])
    pixels = _pixels(int(rays["width"]), int(rays["height"]))
    turn, error = _fit(rays, _turn(rays["directions"].astype(float), pixels, known[:4]), known)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(turn).inv().as_matrix() * [1.0, -1.0, -1.0]
    pose[:3, 3] = rays["place"]
    return pose, error


def _fit(rays: np.void, start: Array, known: Array | None = None) -> tuple[Array, float]:
    """Rotation vector, then intrinsics and distortion unless `known`, that are nearest to a
    picture's rays from a start on; and their distance in pixels (root mean square)."""
    pixels = _pixels(int(rays["width"]), int(rays["height"]))
    directions = rays["directions"].astype(float)

    def missed(values: Array) -> Array:
        lens = values[3:] if known is None else known
        return (_seen(directions, values[:3], lens[:4], lens[4:]) - pixels).ravel()

    scale = np.array([1.0] * 3 + [float(rays["width"])] * 4 + [1.0] * len(DISTORTION))
    fitted = least_squares(missed, start, x_scale=scale[: len(start)])
    return fitted.x, float(np.sqrt(np.mean(np.sum(fitted.fun.reshape(-1, 2) ** 2, axis=-1))))


def _pixels(width: int, height: int) -> Array:
    """[R, 2] middles of the pixels whose rays are read, x and y."""
    x, y = (np.linspace(0, n - 1, c).round() + 0.5 for n, c in ((width, ACROSS), (height, DOWN)))
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def _seen(directions: Array, turn: Array, intrinsics: Array, distortion: Array) -> Array:
    """Pixels [R, 2] of world directions [R, 3]; `turn` is the rotation vector to OpenCV's axes."""
    fx, fy, cx, cy = intrinsics
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    seen = cv2.projectPoints(directions, turn, np.zeros(3), matrix, distortion)[0]
    return np.asarray(seen.reshape(-1, 2), dtype=float)


def _turn(directions: Array, pixels: Array, intrinsics: Array) -> Array:
    """The rotation vector by which a camera without distortion has directions nearest to pixels."""
    points = (pixels - intrinsics[2:]) / intrinsics[:2]
    own = _unit(np.column_stack([points, np.ones(len(points))]))
    return np.asarray(Rotation.align_vectors(own, directions)[0].as_rotvec(), dtype=float)


def _unit(directions: Array) -> Array:
    return directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def _read(path: Path, out: Path) -> Iterator[tuple[Any, ...]]:
    """Writes a file's pictures; yields a row of `RAYS` for each. InputError for another file."""
    try:
        with gzip.open(path) as file:
            while head := file.read(12):  # the length, and a sum of it: gzip has its own
                (length,) = struct.unpack("<Q", head[:8])
                if length > LONGEST:
                    raise ValueError(f"a record of {length} bytes")
                if len(record := file.read(length)) < length:
                    raise ValueError("a record that is cut off")
                name, png, *row = _picture(_fields(record))
                write_whole(out / f"images/{name}.png", png)
                yield (name, *row[:3], "validation" in path.name, *row[3:])
                file.read(4)
            if not file.tell():
                raise ValueError("no record")
    except FAULTS as error:
        said = f"{type(error).__name__}: {one_line(error, 80)}"
        raise InputError(f"{path} is no file of Block-NeRF's records ({said})") from None


def _picture(fields: dict[str, list[memoryview]]) -> tuple[Any, ...]:
    """Name, file, and the rest of a row of `RAYS` but `test`. ValueError, LookupError if wrong."""
    camera, known, width, height = (
        _varint(fields[name][0])[0] for name in ("cam_idx", "image_hash", "width", "height")
    )
    if camera >= 1 << 63:
        raise ValueError("a camera with a negative number")
    png = bytes(fields["image"][0])
    try:
        with Image.open(io.BytesIO(png)) as image:
            size = image.size
    except (OSError, Image.DecompressionBombError):
        raise ValueError("no image that can be read") from None
    if size != (width, height):
        raise ValueError(f"a picture of {size[0]} x {size[1]} for {width} x {height} rays")
    if min(size) < ACROSS:
        raise ValueError(f"a picture of {width} x {height}, below {ACROSS} pixels a side")
    x, y = _pixels(width, height).astype(int).T
    origins, directions = (
        np.frombuffer(fields[name][0], "<f4").reshape(height, width, 3)[y, x].astype(float)
        for name in ("ray_origins", "ray_dirs")
    )
    lengths = np.linalg.norm(directions, axis=1)
    if not (np.isfinite(origins).all() and np.isfinite(lengths).all() and lengths.all()):
        raise ValueError("rays that are not finite, or of length 0")
    directions = _unit(directions)
    if np.ptp(directions, axis=0).max() < 1e-6:
        raise ValueError("rays that all have one direction")
    place = origins.mean(axis=0)
    moved = np.linalg.norm(origins - place, axis=1).max()
    name = f"cam{camera:02d}_{known:016x}"
    return name, png, camera, width, height, place, moved, directions


def _fields(record: bytes) -> dict[str, list[memoryview]]:
    """Fields of a tf.train.Example, whose class only tensorflow brings; numbers stay packed."""
    found = {}
    for _, features in _parts(memoryview(record)):
        for _, entry in _parts(features):
            named = dict(_parts(entry))
            for _, values in _parts(named[2]):
                found[str(named[1], "utf-8")] = [value for _, value in _parts(values)]
    return found


def _parts(message: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Number and content of a protobuf message's fields. ValueError for one without a length."""
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
