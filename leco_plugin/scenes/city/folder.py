"""The city as a scene on disk: written once, never seen half done, and taken up again when killed.

city.json          the configuration, from which the exact geometry is built again

As a nerfstudio scene, beside it:
images/*.png       the pictures
depths/*.npy       float32 [h, w], millimetres along the viewing axis, 0 where nothing is met:
                   what nerfstudio's depth methods read by default
transforms.json    cameras and splits
sparse_pc.ply      some visible surface points, like those of structure from motion

As a Mega-NeRF scene: see `mega_nerf_files`.

`CityTruth` reads it as a model sees it: turned, moved and scaled by nerfstudio's dataparser.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import shutil
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

import leco_plugin
from leco_plugin.log import for_each
from leco_plugin.scenes.city.cameras import CaptureConfig, Lens, View, views_of
from leco_plugin.scenes.city.city import DESCRIPTION, City, CityConfig, read_description
from leco_plugin.scenes.city.shapes import Array
from leco_plugin.scenes.frames import inverse, moved, parsed_frame
from leco_plugin.scenes.input_error import InputError, one_line
from leco_plugin.scenes.mega_nerf_files import (
    TO_DRB,
    Coordinates,
    Split,
    around,
    write_coordinates,
    write_mappings,
    write_view,
)
from leco_plugin.scenes.whole_files import (
    remove_parts,
    write_json,
    write_points,
    write_whole,
    writing_into,
)

Image8 = NDArray[np.uint8]
LayoutName = Literal["nerfstudio", "mega-nerf"]
TRANSFORMS = "transforms.json"
MAPPINGS, COORDINATES = "mappings.txt", "coordinates.pt"
PARTS = (("rgbs", "png"), ("metadata", "pt"))
"""Of a view in Mega-NeRF's format: the folders, and how the names in them end."""
POINTS = "sparse_pc.ply"
FILE_FIELDS = ("file_path", "depth_file_path")
"""Of a frame of transforms.json."""
_SPARSE_POINTS_PER_VIEW = 100


@dataclass
class Layout(ABC):
    """Writes pictures one by one, so that a city may be larger than memory, then the rest."""

    views: list[View]
    lens: Lens
    seed: int

    @abstractmethod
    def files(self, view: View) -> list[str]:
        """What is there, relative to the folder, when a view is written."""

    @abstractmethod
    def write(self, folder: Path, view: View, image: Image8, depth: NDArray[np.float32]) -> None:
        """Writes a view: `image` [h, w, 3 or 4], `depth` [h, w] metres along the rays."""

    @abstractmethod
    def finish(self, folder: Path) -> None:
        """Writes what is about all views."""


class NerfstudioLayout(Layout):
    """transforms.json, with depths and sparse points."""

    def files(self, view: View) -> list[str]:
        return [f"images/{view.name}.png", f"depths/{view.name}.npy"]

    def write(self, folder: Path, view: View, image: Image8, depth: NDArray[np.float32]) -> None:
        picture, depths = self.files(view)
        write_whole(folder / picture, lambda f: Image.fromarray(image).save(f, format="PNG"))
        write_whole(folder / depths, lambda f: np.save(f, self.lens.axial(depth)))

    def finish(self, folder: Path) -> None:
        random = np.random.default_rng([self.seed, 13])
        found = []
        for view in self.views:  # from the files, so that what a killed run wrote counts too
            picture, depths = self.files(view)
            depth = self.lens.along_ray(np.load(folder / depths, allow_pickle=False))
            with Image.open(folder / picture) as opened:
                image = np.asarray(opened)
            most = _SPARSE_POINTS_PER_VIEW
            found.append(self.lens.some_points(view.pose, depth, image, most, random))
        places, colours = map(np.concatenate, zip(*found))
        write_points(folder / POINTS, places, colours)
        as_written = {"orientation_override": "none", "ply_file_path": POINTS}
        facts = {**self.lens.intrinsics, **as_written, "metres_per_unit": 1.0}
        frames = [
            frame_of(view.pose, **dict(zip(FILE_FIELDS, self.files(view)))) for view in self.views
        ]
        held_out = [self.files(view)[0] for view in self.views if view.held_out]
        write_json(folder / TRANSFORMS, transforms_of(facts, frames, held_out), indent=1)


def frame_of(pose: Array, **facts: Any) -> dict[str, Any]:
    """A picture of transforms.json, with its files, from a pose [3, 4]."""
    return {**facts, "transform_matrix": [*pose.tolist(), [0.0, 0.0, 0.0, 1.0]]}


def transforms_of(
    facts: dict[str, Any], frames: list[dict[str, Any]], held_out: list[str]
) -> dict[str, Any]:
    """A transforms.json: facts of all pictures, their frames, and which files are for testing."""
    names, tested = [frame["file_path"] for frame in frames], set(held_out)
    splits = {
        "train_filenames": [name for name in names if name not in tested],
        "val_filenames": held_out,
        "test_filenames": held_out,
    }
    return {"camera_model": "OPENCV", **facts, "frames": frames, **splits}


class MegaNerfLayout(Layout):
    """Mega-NeRF's folders; held-out pictures are its validation set."""

    @cached_property
    def coordinates(self) -> Coordinates:
        return around(np.stack([view.pose[:, 3] for view in self.views]))

    def files(self, view: View) -> list[str]:
        split, stem = self._place(view)
        return [f"{split}/{part}/{stem}.{ending}" for part, ending in PARTS]

    def write(self, folder: Path, view: View, image: Image8, depth: NDArray[np.float32]) -> None:
        fx, fy, cx, cy = (self.lens.intrinsics[name] for name in ("fl_x", "fl_y", "cx", "cy"))
        pose = self.coordinates.to_file(view.pose[None])[0]
        write_view(folder, *self._place(view), image, pose, (fx, fy, cx, cy))

    def finish(self, folder: Path) -> None:
        write_coordinates(folder, self.coordinates)
        write_mappings(folder, {f"{each.name}.png": self._place(each)[1] for each in self.views})

    def _place(self, view: View) -> tuple[Split, str]:
        """Its split, and the stem of its files."""
        return "val" if view.held_out else "train", f"{view.number:06d}"


LAYOUTS: dict[LayoutName, type[Layout]] = {
    "nerfstudio": NerfstudioLayout,
    "mega-nerf": MegaNerfLayout,
}


def with_alpha(image: Image8, depth: NDArray[np.floating]) -> Image8:
    """[h, w, 4]: transparent where a ray meets nothing, so that no method has to model the void."""
    alpha = np.where(np.isfinite(depth), 255, 0).astype(np.uint8)
    return np.concatenate([image, alpha[..., None]], axis=-1)


def write_city(
    config: CityConfig,
    out_dir: Path,
    capture: CaptureConfig,
    layout: LayoutName = "nerfstudio",
) -> Path:
    """Writes the city as a scene into `out_dir`, unless it already holds just that; returns it. The
    folder appears under its name only when it is complete. Until then a hidden folder beside it has
    the pictures; a run that was killed is taken up there, and several may work on it.
    FileExistsError if `out_dir` holds something else, ValueError for a damaged city."""
    parts = {"city": dataclasses.asdict(config), "capture": dataclasses.asdict(capture)}
    wanted = {"format": 1, **parts, "layout": layout}
    text = json.dumps(wanted, indent=2) + "\n"
    if _holds(out_dir, wanted):
        return out_dir
    city = City(config)
    files = LAYOUTS[layout](views_of(city, capture), capture.lens, config.seed)
    drawn = f"{leco_plugin.__version__} {text}".encode()  # another version may draw it otherwise
    digest = hashlib.blake2b(drawn, digest_size=4).hexdigest()
    place = out_dir.resolve()  # of a link, the folder that it leads to
    if os.path.ismount(place) or Path.cwd().is_relative_to(place):
        fault = f"{out_dir} is where a disk is mounted, or where this command runs"
        raise InputError(f"{fault}: give a folder in it")
    unfinished = place.parent / f".{place.name}-unfinished-{digest}"
    with writing_into(out_dir, "--out"):
        unfinished.mkdir(parents=True, exist_ok=True)
    try:
        _photograph(city, files, unfinished)
        files.finish(unfinished)
        write_whole(unfinished / DESCRIPTION, text.encode())
        unfinished.replace(place)
        remove_parts(out_dir)  # not before: who loses a part to another finds the city there
    except OSError:
        # Somebody else may have finished the same city in the meantime.
        if not _holds(out_dir, wanted):
            raise
        shutil.rmtree(unfinished, ignore_errors=True)
    return out_dir


def _photograph(city: City, layout: Layout, folder: Path) -> None:
    """Takes the pictures that are not there yet, one by one."""
    from leco_plugin.scenes.city.render import Tracer

    def missing(view: View) -> bool:
        return not all((folder / path).is_file() for path in layout.files(view))

    wanted = [view for view in layout.views if missing(view)]
    if not wanted:
        return
    tracer, count = Tracer(city), len(layout.views)
    there = f" ({count - len(wanted)} of {count} are there)" if len(wanted) < count else ""

    def take(view: View) -> None:
        if missing(view):  # another process may work on the same city
            image, depth = tracer.photograph(view.pose, layout.lens)
            image = image if city.config.sky else with_alpha(image, depth)
            layout.write(folder, view, image, depth)

    for_each(f"Photographing the city{there}", wanted, take)


def _holds(folder: Path, wanted: dict[str, Any]) -> bool:
    """Whether `folder` holds these pictures of this city; False if there is nothing yet."""
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return False
    if not (folder / DESCRIPTION).is_file():
        raise FileExistsError(f"{folder} exists and is not a city: choose another folder")
    found = read_description(folder)
    there, asked = (
        {**one["city"], **one["capture"], "layout": one["layout"]} for one in (found, wanted)
    )
    for name, value in asked.items():
        if there.get(name) != value:
            raise FileExistsError(
                f"{folder} holds another city ({name} is {there.get(name)} there, not {value}): "
                "choose another folder"
            )
    if missing := _first_missing(folder, wanted["layout"]):
        raise ValueError(
            f"{folder} is damaged: {missing} is missing; delete the folder to write it anew"
        )
    return True


def _first_missing(folder: Path, layout: LayoutName) -> str | None:
    """A file that belongs to a finished city and is not there."""
    if layout == "nerfstudio":
        frames = read_transforms(folder)["frames"]
        paths = [POINTS, *(str(frame[key]) for frame in frames for key in FILE_FIELDS)]
        return next((path for path in paths if not (folder / path).is_file()), None)
    for name in (MAPPINGS, COORDINATES):
        if not (folder / name).is_file():
            return name
    there = {f"{path.parent.name}/{path.name}" for path in folder.glob("*/*/*")}
    lines = (folder / MAPPINGS).read_text(errors="replace").splitlines()
    stems = [Path(line.rsplit(",", 1)[-1]).stem for line in lines]
    paths = [f"{part}/{stem}.{ending}" for stem in stems for part, ending in PARTS]
    return next((path for path in paths if path not in there), None)


def count_pictures(folder: Path) -> tuple[int, int]:
    """How many pictures a finished city has, and how many of them are held out."""
    if read_description(folder)["layout"] == "mega-nerf":
        splits = [len(list((folder / split / "rgbs").iterdir())) for split in ("train", "val")]
        return sum(splits), splits[1]
    transforms = read_transforms(folder)
    return len(transforms["frames"]), len(transforms["test_filenames"])


def read_transforms(folder: Path) -> dict[str, Any]:
    """A city's `transforms.json`. ValueError, in one line, if it is incomplete."""
    try:
        transforms = json.loads((folder / TRANSFORMS).read_text())
        needed = {*FILE_FIELDS, "transform_matrix"}
        if not all(needed <= set(frame) for frame in transforms["frames"]):
            raise ValueError("a frame is incomplete")
    except (OSError, ValueError, KeyError, TypeError) as error:
        message = f"{folder} is damaged: {TRANSFORMS}: {one_line(error)}"
        raise ValueError(message) from error
    return dict(transforms)


@dataclass
class CityTruth:
    """A city seen through a dataparser's transform."""

    city: City
    folder: Path
    frame: Tensor
    """[3, 4] float64, from metres to the model."""
    scale: float
    """Model units in a metre."""

    @classmethod
    def from_dataparser(cls, folder: Path, outputs: Any) -> CityTruth:
        """The truth of a city's folder that nerfstudio has read. ValueError or OSError for none."""
        frame = parsed_frame(outputs).cpu()
        if read_description(folder)["layout"] == "mega-nerf":
            # that reader begins at (down, right, back)
            frame[:, :3] = frame[:, :3] @ torch.from_numpy(TO_DRB)
        return cls(City.from_folder(folder), folder, frame, float(outputs.dataparser_scale))

    def to_metres(self, positions: Tensor) -> NDArray[np.float64]:
        """Model positions [..., 3] in metres: float64 [..., 3]."""
        return moved(positions.detach().double().cpu(), inverse(self.frame)).numpy()

    def to_model(self, positions: NDArray[np.floating]) -> Tensor:
        """Positions [..., 3] in metres as model positions: float32 [..., 3]."""
        return moved(torch.as_tensor(positions, dtype=torch.float64), self.frame).float()

    def occupied(self, positions: Tensor) -> Tensor:
        """Whether model positions [..., 3] lie inside solid matter: bool [...]."""
        return self._ask(self.city.occupied, positions)

    def distance(self, positions: Tensor) -> Tensor:
        """Metres from model positions [..., 3] to the nearest surface: float32 [...]."""
        return self._ask(self.city.distance, positions).float()

    def _ask(self, question: Callable[[NDArray[Any]], NDArray[Any]], positions: Tensor) -> Tensor:
        """What the city answers at model positions [..., 3]: [...]."""
        metres = self.to_metres(positions)
        answers = question(metres.reshape(-1, 3)).reshape(metres.shape[:-1])
        return torch.from_numpy(answers).to(positions.device)

    def visible_surface(self, split: Literal["train", "val", "test"] = "test") -> Tensor:
        """Surface points in the middles of a split's pixels: [P, 3] float32, model coordinates."""
        lens = CaptureConfig(**read_description(self.folder)["capture"]).lens
        transforms = read_transforms(self.folder)
        wanted = set(transforms[f"{split}_filenames"])
        found = []
        for frame in transforms["frames"]:
            if frame["file_path"] in wanted:
                depth = lens.along_ray(
                    np.load(self.folder / frame["depth_file_path"], allow_pickle=False)
                )
                points = lens.points(np.array(frame["transform_matrix"])[:3], depth)
                found.append(self.to_model(points[np.isfinite(depth)]))
        return torch.cat(found)
