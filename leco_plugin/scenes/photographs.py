"""The default reader of photographs: nerfstudio's own format, the usual mistakes named in one line,
scenes left upright that are so already, sparse points read without open3d."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.dataparsers.nerfstudio_dataparser import Nerfstudio, NerfstudioDataParserConfig
from nerfstudio.plugins.registry_dataparser import DataParserSpecification
from numpy.typing import NDArray

from leco_plugin.scenes.frames import UP_IS_KNOWN
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.large_coordinates import ReadsNear
from leco_plugin.scenes.photograph_files import check_images, find_file
from leco_plugin.scenes.reading import CheckedReader
from leco_plugin.scenes.scene_file import SceneFile, file_in, load_json, poses_in, scene_file_of

HeldOut = Literal["spread", "stretch"]
"""Which photographs are tested: some all over the scene, or a whole line or arc of them."""


@dataclass
class LecoPhotographsDataParserConfig(NerfstudioDataParserConfig):
    """A nerfstudio scene, checked before it is loaded"""

    _target: type = field(default_factory=lambda: LecoPhotographs)
    """target class to instantiate"""
    held_out: HeldOut = "spread"
    """Photographs for testing. spread: those that the file lists, or nerfstudio's share of all.
    stretch: a flight line or an arc near the middle, whose neighbours are not trained on either."""


class LecoPhotographs(CheckedReader, ReadsNear, Nerfstudio):
    """Reads transforms.json and its images."""

    config: LecoPhotographsDataParserConfig

    def _generate_dataparser_outputs(
        self, split: str = "train", **kwargs: Any
    ) -> DataparserOutputs:
        data = self.config.data
        meta, folder = load_json(file_in(data)), file_in(data).parent
        check_images([find_file(folder / each["file_path"]) for each in meta["frames"]])
        up_is_known = self._knows_up(meta)
        if up_is_known and "orientation_override" not in meta:
            # nerfstudio's "up" would take the photographs' top edges for up, and tip the scene
            self.config.orientation_method = "none"
        outputs: DataparserOutputs = super()._generate_dataparser_outputs(split)
        if len(outputs.image_filenames) == 0 and split == "train":
            none = f"{data}: no image is left for the split {split!r}"
            remedy = "hold out fewer for tests, as by a larger --train-split-fraction"
            if "train_filenames" in meta:
                remedy = "list some in train_filenames, or remove it"
            raise InputError(f"{none}: {remedy}")
        if up_is_known:
            outputs.metadata[UP_IS_KNOWN] = True
        return outputs

    def _near(self, meta: dict[str, Any]) -> dict[str, Any]:
        """What the file says, with the split that was asked for."""
        meta = super()._near(meta)
        if self.config.held_out == "spread":
            return meta
        names = stretch_of(meta, str(self.config.data))
        tested = dict.fromkeys(("val_filenames", "test_filenames"), names["test"])
        return meta | {"train_filenames": names["train"]} | tested

    def _get_fname(
        self, filepath: Path, data_dir: Path, downsample_folder_prefix: str = "images_"
    ) -> Path:
        """nerfstudio's choice of a file, by a name as Windows or instant-ngp write it, too; a mask
        of full size where there is no smaller one."""
        there = find_file(data_dir / filepath)
        name = there.relative_to(data_dir) if there.is_relative_to(data_dir) else there
        path: Path = super()._get_fname(name, data_dir, downsample_folder_prefix)
        return there if downsample_folder_prefix == "masks_" and not path.exists() else path

    def _load_3D_points(self, *_: Any) -> None:
        """Nothing: nerfstudio reads a .ply by open3d, which needs system libraries."""

    def _knows_up(self, meta: dict[str, Any]) -> bool:
        """Whether z is up in the file already: it says so, or its cameras look down along it."""
        if "orientation_override" in meta:
            return bool(meta["orientation_override"] == "none")
        is_free = self.config.orientation_method in ("up", "none")
        return is_free and taken_from_above(poses_in(meta["frames"]))


def taken_from_above(poses: np.ndarray) -> bool:
    """Whether nearly all cameras [C, 4, 4] look down along -z: then +z is already up."""
    return bool(np.mean(poses[:, 2, 2] > 0.7) > 0.75)


def read_scene(data: Path) -> SceneFile:
    """The description of a scene. InputError as `scene_file_of`, or for missing images."""
    scene = scene_file_of(LecoPhotographsDataParserConfig(data=data), "train")
    assert scene is not None
    check_images(scene.pictures())
    return scene


def describe_held_out(data: Path, kind: HeldOut) -> dict[str, Any]:
    """Which photographs of a scene are tested, as JSON values: the `kind`, and of a stretch the
    names of those of `test` and of those `beside` it. InputError if none can be held out."""
    names = stretch_of(read_scene(data).meta, str(data)) if kind == "stretch" else {}
    return {"kind": kind} | {part: names[part] for part in names if part != "train"}


def describe_scene(data: Path) -> dict[str, Any]:
    """Name, number of images and digest of a scene, JSON values. InputError if none can be read."""
    images = len(read_scene(data).meta["frames"])
    file = file_in(data)
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    return {"name": file.parent.resolve().name, "images": images, "digest": digest[:16]}


def megapixels_of(data: Path) -> float | None:
    """Million pixels of a scene's first photograph; None where its file does not say them."""
    lens = read_scene(data).lenses[0]
    if lens.width is None or lens.height is None:
        return None
    return lens.width * lens.height / 1e6


Array = NDArray[np.float64]
LEAST, WANTED, MOST = 1 / 12, 1 / 8, 1 / 4
"""Shares of all cameras that a stretch may have, and the one that it has where nothing decides."""
CLEAR = 0.8
"""Share of the widest gap behind a stretch from which on another gap is as clear an end."""
BESIDE = 1.5
"""A camera stands beside a stretch up to so many times the usual distance between neighbours."""
FEWEST = 12
"""Cameras of which a stretch can be held out."""
TRAINED = 0.5
"""Least share of the cameras that is still trained on."""


def find_stretch(positions: Array) -> tuple[list[int], list[int]]:
    """The stretch of cameras at [C, 3] near the middle that ends with the widest gap, and those
    beside it, by number. It grows from the middle by the nearest camera each time, so that it
    follows a line or an arc. ValueError for too few cameras, or too close together."""
    if (count := len(positions)) < FEWEST:
        few = f"there are {count} cameras"
        raise ValueError(f"{few}, and a stretch is held out of {FEWEST} or more")
    order, gaps = _grow(positions)
    low, high = max(2, round(LEAST * count)), round(MOST * count)
    behind = gaps[low - 1 : high]  # behind a stretch of `low` cameras, and so on
    sizes = np.flatnonzero(behind >= CLEAR * behind.max()) + low
    size = int(sizes[np.abs(sizes - WANTED * count).argmin()])
    held_out, rest = order[:size], order[size:]
    away = np.full(len(rest), np.inf)
    for number in held_out:
        away = np.minimum(away, np.linalg.norm(positions[rest] - positions[number], axis=1))
    apart = gaps[gaps > 1e-6 * gaps.max()]
    beside = rest[away <= BESIDE * np.median(apart)] if len(apart) else rest
    if count - size - len(beside) < TRAINED * count:
        others = f"beside a stretch of {size} of {count} cameras there are {len(beside)} others"
        raise ValueError(f"{others}, too many to leave them out of training")
    return sorted(held_out.tolist()), sorted(beside.tolist())


def _grow(positions: Array) -> tuple[NDArray[np.int64], Array]:
    """All cameras [C], each the nearest to those before it, and how far it is from them [C - 1]."""
    left = np.linalg.norm(positions - positions.mean(axis=0), axis=1)
    order, gaps = [int(left.argmin())], []
    away = np.full(len(positions), np.inf)
    for _ in range(len(positions) - 1):
        away = np.minimum(away, np.linalg.norm(positions - positions[order[-1]], axis=1))
        away[order] = np.inf
        order.append(int(away.argmin()))
        gaps.append(float(away[order[-1]]))
    return np.array(order), np.array(gaps)


def stretch_of(meta: dict[str, Any], scene: str) -> dict[str, list[str]]:
    """Names of the photographs of a transforms.json: `train`, `test`, and `beside`, left out as
    they stand next to the tested ones. InputError, with `scene`, if no stretch can be held out."""
    try:
        held_out, beside = find_stretch(poses_in(meta["frames"])[:, :3, 3])
    except ValueError as error:
        raise InputError(f"{scene}: {error}; hold out photographs of the spread instead") from None
    kinds = dict.fromkeys(held_out, "test") | dict.fromkeys(beside, "beside")
    names: dict[str, list[str]] = {"train": [], "test": [], "beside": []}
    for number, frame in enumerate(meta["frames"]):
        names[kinds.get(number, "train")].append(str(frame["file_path"]))
    return names


leco_photographs_dataparser = DataParserSpecification(
    config=LecoPhotographsDataParserConfig(),
    description="A scene in nerfstudio's format, checked, upright, with its sparse points.",
)
