"""The files of a Mega-NeRF scene: their coordinates, how they are read and checked, and written.

coordinates.pt                    origin_drb [3] metres, pose_scale_factor in metres
mappings.txt                      "<original name>,<metadata file>" in each line
train|val/rgbs/<stem>.png         the pictures
train|val/metadata/<stem>.pt      H, W, c2w [3, 4], intrinsics [4], distortion [4]

The format's world is (down, right, back), in units of `pose_scale_factor` metres around
`origin_drb`. The model's is (right, forward, up) in the same units. Camera axes are OpenGL's in
both.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from leco_plugin.log import counted, for_each
from leco_plugin.scenes.city.shapes import Array
from leco_plugin.scenes.frames import check_poses
from leco_plugin.scenes.input_error import InputError, require_folder
from leco_plugin.scenes.photograph_files import header_of
from leco_plugin.scenes.pt_file import describe, read_pt
from leco_plugin.scenes.whole_files import write_whole

Split = Literal["train", "val"]
TO_DRB = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""(right, forward, up) to (down, right, back). A rotation; its inverse is its transpose."""
_DIRECTIONS = {
    "down": (0, 1.0),
    "up": (0, -1.0),
    "right": (1, 1.0),
    "left": (1, -1.0),
    "back": (2, 1.0),
    "forward": (2, -1.0),
}
"""What the format calls its axes and their opposites: axis and sign."""
_UPRIGHT, _CLEARLY = 0.6, 0.9
"""Shares of cameras that are upright: fewer is suspicious, more is clear. Street views with a roll
and nadir strips of one heading lie in between, and pass."""


@dataclass(frozen=True)
class Coordinates:
    """What `coordinates.pt` says."""

    origin_drb: Array
    """[3] metres, (down, right, back): where the scene's origin lies."""
    metres: float
    """Metres in a unit, `pose_scale_factor`."""

    def to_model(self, poses: Array) -> Array:
        """Poses [C, 3, 4] of the files as (right, forward, up), still in units of `metres`."""
        return TO_DRB.T @ poses

    def to_file(self, poses: Array) -> Array:
        """Poses [C, 3, 4] in metres, (right, forward, up), as the files hold them."""
        turned = TO_DRB @ poses
        turned[:, :, 3] = (turned[:, :, 3] - self.origin_drb) / self.metres
        return turned

    def altitudes(self, poses: Array) -> Array:
        """Metres above the datum, up is positive, of poses [C, 3, 4] of the files: [C]."""
        return -(poses[:, 0, 3] * self.metres + self.origin_drb[0])

    def height_of(self, down: float) -> float:
        """The model's z of a level that lies so many metres down from the datum."""
        return float(self.origin_drb[0] - down) / self.metres

    def transform(self) -> Array:
        """[3, 4] from metres (down, right, back) to the model's axes, before scaling."""
        return np.column_stack([TO_DRB.T, -TO_DRB.T @ self.origin_drb])


def around(positions: Array) -> Coordinates:
    """Coordinates in which cameras at [C, 3] metres, (right, forward, up), lie within [-1, 1]."""
    places = positions @ TO_DRB.T
    origin = (places.min(0) + places.max(0)) / 2
    return Coordinates(origin, max(float(np.abs(places - origin).max()), 1e-3))


def wrong_axis(poses: Array) -> str | None:
    """Why poses [C, 3, 4] are not (down, right, back), or None. An upright camera's right axis is
    level, it does not look far above the horizon, and its top is not below: nearly all cameras of a
    survey agree on what is down."""
    rights, tops, looks = poses[:, :, 0], poses[:, :, 1], -poses[:, :, 2]

    def upright(axis: int, sign: float) -> float:
        level, down = np.abs(rights[:, axis]) < 0.35, sign * looks[:, axis] > -0.35
        return float(np.mean(level & down & (sign * tops[:, axis] < 0.35)))

    shares = {name: upright(*where) for name, where in _DIRECTIONS.items()}
    # Of directions that fit equally well, down is the one that cameras look along.
    downward = {name: float(s * looks[:, a].mean()) for name, (a, s) in _DIRECTIONS.items()}
    best = max(shares, key=lambda name: (shares[name] >= _CLEARLY, downward[name]))
    if shares["down"] > _UPRIGHT or shares[best] < _CLEARLY:
        return None
    if best == "up":
        return "the first axis of its world points up and not down: nearly all cameras look up"
    return (
        f"the first axis of its world does not point down, as the cameras look {best}; poses "
        "aligned to east, north, up are to be turned before they are converted"
    )


ENDINGS = (".jpg", ".JPG", ".png", ".PNG")
"""Of pictures, in the order in which Mega-NeRF looks for them."""
KINDS = ("JPEG", "MPO", "PNG")
"""By content, as Pillow calls them. MPO is a JPEG with a preview, as of a drone."""
_MOST_PIXELS = 1 << 16
"""A side."""


@dataclass(frozen=True)
class Frame:
    """One photograph, as its metadata say."""

    stem: str
    split: Split
    image: Path
    image_size: tuple[int, int]
    """Width and height of the file; Mega-NeRF resizes it to `width` x `height`."""
    width: int
    height: int
    pose: Array
    """[3, 4] camera to world, (down, right, back), units of the scene."""
    intrinsics: Array
    """[4] fx, fy, cx, cy, pixels at `width` x `height`."""


@dataclass(frozen=True)
class MegaNerfScene:
    """All of a scene but its pixels."""

    coordinates: Coordinates
    frames: list[Frame]
    """Sorted by stem, both splits together: the order of Mega-NeRF's appearance codes."""

    def poses(self) -> Array:
        """[C, 3, 4] of all frames."""
        return np.stack([frame.pose for frame in self.frames])

    def describe(self) -> str:
        """One line for the log: sizes, and altitudes with their sign."""
        validation = sum(frame.split == "val" for frame in self.frames)
        altitudes = self.coordinates.altitudes(self.poses())
        below = (
            " (all below the datum: right for a local origin, else origin_drb has the wrong sign)"
            if altitudes.max() < 0
            else ""
        )
        return (
            f"Mega-NeRF scene: {len(self.frames)} pictures, {validation} of them for validation; "
            f"1 unit is {self.coordinates.metres:.4g} m; cameras at altitudes from "
            f"{altitudes.min():.1f} to {altitudes.max():.1f} m{below}"
        )


def read_scene(folder: Path, check_axes: bool = True) -> MegaNerfScene:
    """Reads and checks everything but pixels; `check_axes` refuses a first axis that does not point
    down. InputError, in one line, names a file and what is wrong with it."""
    require_folder(folder, "give one with --data")
    coordinates = read_coordinates(folder / "coordinates.pt")
    pairs = sorted(_pairs(folder, "train") + _pairs(folder, "val"), key=lambda pair: pair[0].name)
    for (before, _), (after, _) in pairwise(pairs):
        if before.name == after.name:
            raise InputError(f"{before.name} is both in train/metadata and in val/metadata")
    frames = for_each("Reading the scene", pairs, lambda pair: read_frame(*pair))
    scene = MegaNerfScene(coordinates, frames)
    poses, names = scene.poses(), [f"{metadata}: c2w" for metadata, _ in pairs]
    if (np.linalg.det(poses[:, :, :3]) < 0).all():
        raise InputError(
            f"{names[0]} is mirrored, as in all files: the axes of its world are not "
            "(down, right, back), perhaps the first one points up"
        )
    check_poses(poses, names)
    fault = wrong_axis(poses) if check_axes else None
    if fault is not None:
        raise InputError(
            f"{folder}: {fault}; the world of this format is (down, right, back), "
            "and --check-axes False reads it as it is"
        )
    return scene


def _pairs(folder: Path, split: str) -> list[tuple[Path, Path]]:
    """The metadata files of a split and their pictures."""
    rgbs, metadata = folder / split / "rgbs", folder / split / "metadata"
    for place in (rgbs, metadata):
        if not place.is_dir():
            raise InputError(f"{folder} is not a Mega-NeRF scene: it has no {split}/{place.name}")
    files = {path.stem: path for path in metadata.glob("[!.]*.pt")}
    images: dict[str, Path] = {}
    for ending in reversed(ENDINGS):
        images |= {path.stem: path for path in rgbs.glob(f"[!.]*{ending}")}
    if not files:
        raise InputError(f"{metadata} holds no metadata (.pt)")
    lonely = sorted(files.keys() ^ images.keys())
    if lonely:
        what = "metadata" if lonely[0] in images else f"picture ({' '.join(ENDINGS)})"
        raise InputError(
            f"{folder / split} holds {counted(len(images), 'picture')} and "
            f"{counted(len(files), 'metadata file')}; "
            f"{lonely[0]} has no {what}"
        )
    return [(files[stem], images[stem]) for stem in files]


def read_coordinates(path: Path) -> Coordinates:
    """`coordinates.pt`. InputError if it does not say what it should."""
    values = _read(path, "so this is no Mega-NeRF scene")
    origin = _numbers(path, values, "origin_drb", (3,))
    metres = float(_numbers(path, values, "pose_scale_factor"))
    if not (np.isfinite(metres) and metres > 0):
        raise InputError(f"{path}: pose_scale_factor is {metres:g}, and must be above 0")
    return Coordinates(origin, metres)


def read_frame(metadata: Path, image: Path) -> Frame:
    """A picture's metadata, checked against the picture's header. InputError if they are bad."""
    values = _read(metadata, "so its picture cannot be used")
    height, width = (_side(metadata, values, name) for name in ("H", "W"))
    pose = _numbers(metadata, values, "c2w", (3, 4))
    intrinsics = _numbers(metadata, values, "intrinsics", (4,))
    if intrinsics[:2].min() <= 0:
        raise InputError(f"{metadata}: a focal length in intrinsics is not above 0")
    header = header_of(image, turned=False)
    if header.format not in KINDS:
        raise InputError(f"{image} is a file of {header.format}: save it as JPEG or PNG")
    size = header.size
    if abs(size[0] * height - size[1] * width) > max(width, height):
        raise InputError(
            f"{image} has {size[0]} x {size[1]} pixels, its metadata are for {width} x {height}"
        )
    split: Split = "val" if metadata.parent.parent.name == "val" else "train"
    return Frame(metadata.stem, split, image, size, width, height, pose, intrinsics)


def _read(path: Path, otherwise: str) -> dict[str, Any]:
    """A file's dictionary of tensors and numbers."""
    if not path.exists():
        raise InputError(f"there is no {path}, {otherwise}")
    values = read_pt(path)
    if not isinstance(values, dict):
        raise InputError(f"{path} holds {describe(values)}, and not a dictionary")
    for name, value in values.items():
        if not isinstance(name, str) or not isinstance(value, (torch.Tensor, int, float)):
            raise InputError(
                f"{path}: {str(name)[:40]!r} is {describe(value)}; "
                "only tensors and numbers belong there"
            )
    return values


def _numbers(path: Path, values: dict[str, Any], name: str, shape: tuple[int, ...] = ()) -> Array:
    """A finite tensor of a known shape, float64; without a shape any number."""
    if name not in values:
        raise InputError(f"{path} has no {name}")
    value = values[name]
    size = value.shape if isinstance(value, torch.Tensor) else torch.Size()
    fits = tuple(size) == shape if shape else size.numel() == 1
    if not fits:
        wanted = f"{' x '.join(map(str, shape))} numbers" if shape else "a number"
        raise InputError(f"{path}: {name} is {describe(value)}, and not {wanted}")
    try:
        numbers = torch.as_tensor(value, dtype=torch.float64).detach().reshape(shape).numpy().copy()
    except (OverflowError, RuntimeError):
        raise InputError(f"{path}: {name} is too large a number") from None
    if shape and not np.isfinite(numbers).all():
        raise InputError(f"{path}: {name} holds values that are not finite")
    return numbers


def _side(path: Path, values: dict[str, Any], name: str) -> int:
    """A number of pixels."""
    value = float(_numbers(path, values, name))
    if not (1 <= value <= _MOST_PIXELS and value == int(value)):
        raise InputError(f"{path}: {name} is {value:g}, and not a number of pixels")
    return int(value)


def write_coordinates(folder: Path, coordinates: Coordinates) -> None:
    values = {
        "origin_drb": torch.from_numpy(coordinates.origin_drb).float(),
        "pose_scale_factor": float(coordinates.metres),
    }
    write_whole(folder / "coordinates.pt", lambda file: torch.save(values, file))


def write_mappings(folder: Path, stems: dict[str, str]) -> None:
    """Writes `mappings.txt` from the original names of pictures and their stems."""
    text = "".join(f"{name},{stem}.pt\n" for name, stem in stems.items())
    write_whole(folder / "mappings.txt", text.encode())


def write_view(
    folder: Path,
    split: Split,
    stem: str,
    image: NDArray[np.uint8],
    pose: Array,
    intrinsics: tuple[float, float, float, float],
) -> None:
    """Writes a picture [H, W, 3 or 4] and then its metadata: a pose [3, 4] as `Coordinates.to_file`
    has it, and fx, fy, cx, cy in pixels."""
    metadata: dict[str, Any] = {
        "H": image.shape[0],
        "W": image.shape[1],
        "c2w": torch.from_numpy(np.ascontiguousarray(pose)).float(),
        "intrinsics": torch.tensor(intrinsics, dtype=torch.float32),
        "distortion": torch.zeros(4),
    }
    rgb, data = folder / split / "rgbs" / f"{stem}.png", folder / split / "metadata" / f"{stem}.pt"
    write_whole(rgb, lambda file: Image.fromarray(image).save(file, format="PNG"))
    write_whole(data, lambda file: torch.save(metadata, file))
