"""A transforms.json, read and checked for all its readers; of a folder without one, which reader or
converter of nerfstudio it is for."""

from __future__ import annotations

import json
import shlex
import sys
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any
from unicodedata import normalize

import numpy as np
from nerfstudio.cameras.cameras import Cameras
from numpy.typing import NDArray

from leco_plugin.log import by_number, say
from leco_plugin.scenes.frames import check_no_contradiction, check_poses
from leco_plugin.scenes.input_error import InputError, one_line
from leco_plugin.scenes.lenses import (
    ANGLES,
    LENS_FIELDS,
    PINHOLE_FIELDS,
    Lens,
    check_together,
    lens_of,
)
from leco_plugin.scenes.photograph_files import find_file
from leco_plugin.scenes.poses import ASKED
from leco_plugin.scenes.whole_files import FETCH, begins_with, is_pointer

FRAMES = ("frames", "test_frames")
"""Lists of frames; the second is ScanNet++'s."""
NO_SCENE = (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError)
ROUNDED = 1e-9
"""Of the largest coordinate, how far cameras of one place may be apart by rounding: UTM's 5 mm."""
MAKE_ANEW = "make it anew from the photographs, with leco poses or ns-process-data"


@dataclass(frozen=True)
class SceneFile:
    """What a transforms.json says."""

    path: Path
    meta: dict[str, Any]
    frames: list[dict[str, Any]]
    """All of them, those for tests included."""
    lenses: list[Lens]
    """Of each frame."""
    folder: Path
    """To which names of pictures are relative."""

    def pictures(self) -> list[Path]:
        """The file of each frame, where there is one."""
        return [find_file(self.folder / frame["file_path"]) for frame in self.frames]

    def mask(self, name: str) -> Path:
        """The file of a mask, by its name as `find_file` takes it; where it would be if missing."""
        return find_file(self.path.parent / name.replace("\\", "/"))


def file_in(data: Path) -> Path:
    """The transforms.json that `data` means: itself, or that in the folder."""
    return data if data.suffix == ".json" else data / "transforms.json"


def load_json(path: Path) -> Any:
    """What a JSON file says, with or without a byte order mark. Nulls are left out, poses of three
    rows have the fourth, and an `applied_transform` of four has three."""
    said = _parsed(path.read_bytes())
    if not isinstance(said, dict):
        return said
    said = _without_nulls(said)
    applied = said.get("applied_transform")
    if isinstance(applied, list) and applied[3:] == [[0, 0, 0, 1]]:
        said["applied_transform"] = applied[:3]
    for name in FRAMES:
        if isinstance(said.get(name), list):
            said[name] = [_completed(frame) for frame in said[name]]
    return said


@lru_cache(maxsize=1)
def _parsed(content: bytes) -> Any:
    """Parsed once for a reader and for the checks of it."""
    return json.loads(content.decode("utf-8-sig"))


def _without_nulls(said: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in said.items() if value is not None}


def _completed(frame: Any) -> Any:
    if not isinstance(frame, dict):
        return frame
    frame = _without_nulls(frame)
    pose = frame.get("transform_matrix")
    if isinstance(pose, list) and len(pose) == 3:
        frame["transform_matrix"] = [*pose, [0.0, 0.0, 0.0, 1.0]]
    return frame


def poses_in(frames: list[dict[str, Any]]) -> NDArray[np.float64]:
    """The poses [C, 4, 4] of frames; ValueError, KeyError or TypeError where they have none."""
    return np.array([frame["transform_matrix"] for frame in frames], dtype=float)


def not_a_scene(path: Path, error: BaseException) -> InputError:
    """What to raise for a transforms.json that cannot be read as one: one of `NO_SCENE`."""
    if is_pointer(path):
        return InputError(f"{path} {FETCH}")
    reason = f"{type(error).__name__}: {one_line(error, 120)}"
    fault = f"{path} is not a scene in nerfstudio's format ({reason})"
    return InputError(f"{fault}; mend it, or {MAKE_ANEW}")


def read_scene_file(path: Path, split: str, folder: Path) -> SceneFile:
    """A transforms.json, its pictures relative to `folder`. InputError if its poses or lenses are
    none that cameras have, or all cameras of a training split are in one place."""
    try:
        meta = load_json(path)
        frames = [frame for name in FRAMES for frame in meta.get(name, [])]
        meta["frames"]
        names = [frame["file_path"] for frame in frames]
        if not all(type(name) is str and all(ord(c) >= 32 for c in name) for name in names):
            raise ValueError("a file_path is no path")
        poses = poses_in(frames)
    except NO_SCENE as error:
        raise not_a_scene(path, error) from None
    if len(frames) == 0:
        fault = "has no cameras: its list of frames is empty"
        raise InputError(f"{path} {fault}; {MAKE_ANEW}")
    of_each = [f"{path}: the transform_matrix of {Path(name)}" for name in names]  # without ./
    check_poses(poses, of_each)
    check_no_contradiction(poses, of_each)
    positions = poses[:, :3, 3]
    if split == "train" and np.ptp(positions, axis=0).max() <= ROUNDED * np.abs(positions).max():
        number = "one image" if len(frames) == 1 else f"{len(frames)} images from one place"
        raise InputError(f"{path} has {number}: add photographs from two places at least")
    lenses = [lens_of(meta, frame, f"{path}: {frame['file_path']}") for frame in frames]
    check_together(lenses, str(path))
    masked = sum("mask_path" in frame for frame in frames)
    if 0 < masked < len(frames):
        some = f"{masked} of {len(frames)} images {by_number(masked, 'has', 'have')} a mask_path"
        raise InputError(f"{path.parent}: {some}; give one to all or to none")
    return SceneFile(path, meta, frames, lenses, folder)


def own_target(config: Any) -> Any:
    """The class of a config's reader, also where that has been replaced by a function."""
    return config._target if isinstance(config._target, type) else type(config)()._target


def description_of(config: Any, split: str) -> Path | None:
    """Where a reader's transforms.json is; None of one that reads something else."""
    from nerfstudio.data.dataparsers.blender_dataparser import Blender
    from nerfstudio.data.dataparsers.dnerf_dataparser import DNeRF
    from nerfstudio.data.dataparsers.instant_ngp_dataparser import InstantNGP
    from nerfstudio.data.dataparsers.nerfstudio_dataparser import Nerfstudio
    from nerfstudio.data.dataparsers.scannetpp_dataparser import ScanNetpp

    data = Path(config.data)
    target = own_target(config)
    if issubclass(target, Nerfstudio | InstantNGP):
        return file_in(data)
    if issubclass(target, ScanNetpp):
        return data / Path(config.transforms_path)
    return data / f"transforms_{split}.json" if issubclass(target, Blender | DNeRF) else None


def scene_file_of(config: Any, split: str) -> SceneFile | None:
    """The transforms.json that a reader will read, or None. InputError as `read_scene_file`."""
    data, file = Path(config.data), description_of(config, split)
    if file is None:
        return None
    if not data.exists():
        raise InputError(f"there is no folder {data}: put it, or a link, there, or give another")
    if not file.exists():
        beside = sorted(file.parent.glob("transforms_*.json"))
        instead = "give a folder with one, or make one from photographs with leco poses"
        instead = remedy_for(data) or instead
        if file.name != "transforms.json" and beside:
            instead = f"give that split one, as a copy of {beside[0].name}"
        raise InputError(f"{data} holds no {file.relative_to(data)}; {instead}")
    own = getattr(config, "images_dir", None)
    scene = read_scene_file(file, split, file.parent if own is None else data / own)
    if hasattr(config, "downscale_factor"):  # nerfstudio's own format has all of these
        for frame in scene.frames:
            for name in (each for each in PINHOLE_FIELDS if each not in scene.meta | frame):
                raise InputError(f"{file}: {frame['file_path']} has no {name}{_add(scene, data)}")
    return scene


def _add(scene: SceneFile, data: Path) -> str:
    """What to do about an intrinsic that a file lacks."""
    if not any(angle in scene.meta for angle in ANGLES):
        return ": add it"
    command = command_with("instant-ngp-data", data)
    formula = "write fl_x = w / (2 tan(camera_angle_x / 2)), and so on"
    return f"; {formula}" if command is None else f"; `{command}` reads fields of view instead"


def frames_of(images: list[Path], scene: SceneFile) -> list[int | None]:
    """The number of the frame of each picture, which may be a smaller one of the same name; None
    where no frame has it. InputError if frames of several folders would share a smaller picture."""
    places = [_one_spelling(str(frame["file_path"])) for frame in scene.frames]
    named: dict[str, list[int]] = {}
    for number, place in enumerate(places):
        named.setdefault(place.rsplit("/", 1)[-1], []).append(number)
    found: list[int | None] = []
    folder = Path(_one_spelling(str(scene.folder)))
    for image in (Path(_one_spelling(str(each))) for each in images):
        numbers = named.get(image.name) or named.get(image.stem) or []
        paths = [folder / places[number] for number in numbers]
        files = [(path, path.with_name(f"{path.name}{image.suffix}")) for path in paths]
        ends = [number for number, either in zip(numbers, files) if image in either]
        others = sorted({places[number] for number in numbers})
        if not ends and len(others) > 1:
            fault = f"{image} would be the picture of {others[0]} and of {others[1]}"
            raise InputError(f"{fault}: give them names of their own")
        found.append(next(iter(ends or numbers), None))
    return found


def _one_spelling(name: str) -> str:
    """The same of all names for which `find_file` may find one file, but for its ending."""
    return normalize("NFC", name.replace("\\", "/"))


def factor_of(scene: SceneFile, numbers: list[int | None], config: Any, cameras: Cameras) -> int:
    """By which whole number a reader has made cameras smaller than their lenses say: nerfstudio's
    own by the width of the scene, Blender's by that of its first picture, others not."""
    known = [(row, number) for row, number in enumerate(numbers) if number is not None]
    if not known or not (hasattr(config, "downscale_factor") or hasattr(config, "alpha_color")):
        return 1
    row, number = known[0]
    full = scene.meta.get("w") if hasattr(config, "downscale_factor") else None
    full = scene.lenses[number].width if full is None else full
    return 1 if full is None else max(1, round(float(full) / int(cameras.width[row])))


READ = LENS_FIELDS | {
    *("applied_scale", "applied_transform", "file_path", "frames", "has_mask", "mask_path"),
    *("metres_per_unit", "orientation_override", "ply_file_path", "test_filenames", "test_frames"),
    *("train_filenames", "transform_matrix", "transform_matrix_end", "transform_matrix_start"),
    "val_filenames",
}
"""By leco's own reader, or held against what another reader has made of them."""
NEEDLESS = {
    *("aabb", "aabb_scale", "blur_score", "colmap_im_id", "colmap_image_id", "depth_file_path"),
    *("depth_path", "depth_unit_scale_factor", "enable_depth_loading", "enable_ray_loading"),
    *("fovx", "fovy", "geographic_origin", "importance_sampling", "integer_depth_scale"),
    *("n_extra_learnable_dims", "offset", "render_aabb", "rotation", "scale", "sharpness"),
    "timestamp",
}
"""Neither geometry nor colour depends on them: bounds come from cameras and points, and our methods
learn without depths. No reader knows `fovx`, each wants a focal length or another angle. `rotation`
is by how much Blender turned the camera, as poses say too."""


def unused_fields(meta: dict[str, Any]) -> list[str]:
    """Names of fields of a scene and of its frames that are not used and say something."""
    owners = [meta, *meta["frames"], *meta.get("test_frames", [])]
    nothing: tuple[Any, ...] = (None, False, 0, "", [], {})
    names = {name for owner in owners for name in owner if owner[name] not in nothing}
    return sorted(names - READ - NEEDLESS)


def say_unused(meta: dict[str, Any], file: Path, has_times: bool) -> None:
    """Says in one line what a scene has that is not used; `has_times`: its reader took times."""
    unused = [name for name in unused_fields(meta) if name != "time" or not has_times]
    folder = (file.parent / str(meta["frames"][0]["file_path"])).parent
    beside = ("dynamic_mask_*", "rays_*.dat", "*.alpha.*")
    unused += [kind for kind in beside if any(folder.glob(kind))]
    if unused:
        say(f"{file}: not used: {', '.join(unused)[:300]}")


COLMAP = ("colmap/sparse/0", "sparse/0", "sparse", "colmap/sparse", "0", ".")
"""Where COLMAP's own files lie, in the order they are looked for."""
READERS = {
    "transforms.json": "leco-photographs",
    "transforms_train.json": "blender-data",
    "coordinates.pt": "mega-nerf",
    "dslr/nerfstudio/transforms.json": "scannetpp-data",
    "intrinsic/intrinsic_color.txt": "scannet-data",
    "meta_data.json": "sdfstudio-data",
    "scene.json": "dycheck-data",
    "train.npz": "minimal-parser",
}
PICTURES = "*.[jJpP][pPnN]*[gG]"
CONVERTERS = {
    "keyframes": "polycam",
    "opensfm": "odm",
    "odm_report": "odm",
    "rgb": "record3d",
    "EXR_RGBD": "record3d",
    "*.xml": "metashape --xml FILE.xml",
    "*.csv": "realitycapture --csv FILE.csv",
    PICTURES: "images",
    "images": "images",
}
"""What lies in a folder, and which of ns-process-data's commands is for it."""
BEGIN_WITH = {"*.xml": b"<document", "*.csv": b"#"}
"""What cameras of Metashape and of RealityCapture hold near their beginning; flight logs do not."""
METHOD = "leco-occupancy"
"""Named where none was typed."""


def command_with(reader: str, data: Path) -> str | None:
    """The command that was typed, with a reader and its options; None where it takes no reader."""
    program, typed = Path(sys.argv[0]).name, sys.argv[1:]
    given = f"--data {shlex.quote(str(data))} {reader}"
    if program == "leco":
        if typed[:1] != ["swap"]:
            return None
        own = typed[: typed.index("--")] if "--" in typed else typed
        return f"{shlex.join(['leco', *own])} -- {given}"
    if program.startswith("ns-") and program != "ns-train":
        return None
    named = program == "ns-train" and typed and typed[0][:1] != "-"
    return f"ns-train {shlex.quote(typed[0]) if named else METHOD} {given}"


def has_model(folder: Path) -> bool:
    """Whether a folder holds a model of COLMAP."""
    return any((folder / f"cameras.{ending}").is_file() for ending in ("bin", "txt"))


def _readers_for(folder: Path) -> list[str]:
    """Readers that may read a folder, each with its options."""
    found = [reader for sign, reader in READERS.items() if (folder / sign).is_file()]
    for place in COLMAP:
        if has_model(folder / place):
            path = "" if place == COLMAP[0] else f" --colmap-path {place}"
            return [*found, f"colmap{path}{_images_option(folder)}"]
    return found


def _images_option(folder: Path) -> str:
    """Where the pictures of a model of COLMAP are, if not in `images`."""
    if (folder / "images").is_dir():
        return ""
    beside = [folder, *sorted(each for each in folder.iterdir() if each.is_dir())]
    place = next((each for each in beside if any(each.glob(PICTURES))), None)
    return "" if place is None else f" --images-path {shlex.quote(str(place.relative_to(folder)))}"


def _converter_for(data: Path) -> str | None:
    """The command that makes a scene of a folder; None where none is known."""
    if not data.is_dir():
        return None
    for sign, kind in CONVERTERS.items():
        mark = BEGIN_WITH.get(sign)
        if any(mark is None or begins_with(path, mark) for path in data.glob(sign)):
            source = data / "images" if sign == "images" else data
            command, *options = kind.split()
            place = next((each for each in COLMAP if (data / each / "cameras.bin").is_file()), None)
            if command == "images" and place is None:
                return f"leco poses {shlex.quote(str(source))} --out SCENE"
            given = [command, "--data", shlex.quote(str(source)), *options]
            if command == "images" and place is not None:
                model = shlex.quote(str((data / place).resolve()))
                given += ["--skip-colmap", "--colmap-model-path", model]
            return " ".join(["ns-process-data", *given, "--output-dir", "SCENE"])
    return None


def remedy_for(data: Path) -> str | None:
    """What to do about a folder that lacks its reader's files; None where nothing is known."""
    known = [(reader, folder) for folder in (data, data.parent) for reader in _readers_for(folder)]
    for reader, folder in known:
        if command := command_with(reader, folder):
            return f"`{command}` reads it"
    if known and known[0] == (READERS["transforms.json"], data.parent):
        return f"give {data.parent}, which holds one"
    if known and "colmap" not in known[0][0]:
        return f"it is for the reader {known[0][0]}, and this command reads a transforms.json only"
    if (data / ASKED).is_file():
        return "`leco poses` has not finished it: give the same command again"
    converter = _converter_for(data)
    return None if converter is None else f"`{converter}` makes a scene of it"
