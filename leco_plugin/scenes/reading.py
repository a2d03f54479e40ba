"""What all readers of scenes pass: their pictures, masks and lenses, and their errors.

nerfstudio has some fifteen readers, and packages add more. Each checks something else, so that what
is read wrongly is looked for in what they return.
"""

from __future__ import annotations

import functools
import math
import re
from collections import Counter
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.dataparsers import base_dataparser
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataparserOutputs
from nerfstudio.data.dataparsers.nerfstudio_dataparser import Nerfstudio
from PIL import UnidentifiedImageError

from leco_plugin.log import bar, by_number, counted, say
from leco_plugin.scenes import photograph_files, scene_file
from leco_plugin.scenes.coloured_points import told_by
from leco_plugin.scenes.frames import check_poses
from leco_plugin.scenes.input_error import InputError, one_line, require
from leco_plugin.scenes.large_coordinates import near_bases
from leco_plugin.scenes.lenses import Lens, set_lenses
from leco_plugin.scenes.photograph_files import (
    DerivedImages,
    Header,
    decode,
    find_file,
    header_of,
    is_plain,
)
from leco_plugin.scenes.scene_file import SceneFile, command_with, description_of
from leco_plugin.scenes.whole_files import FETCH, is_pointer
from leco_plugin.studio.checkpoints import require_data

SAVE_ALIKE = "save all with an alpha channel or none"
UNWRITABLE = "make the folder of the scene writable, or convert its pictures and masks by hand"

OPTIONS: dict[str, tuple[Callable[[float], bool], str]] = {
    "downscale_factor": (lambda value: value > 0, "1 or more"),
    "scale_factor": (lambda value: 0.0 < value < math.inf, "a positive number"),
    "train_split_fraction": (lambda value: 0.0 <= value <= 1.0, "from 0 to 1"),
    "eval_interval": (lambda value: value > 0, "1 or more"),
}
"""Of readers, by name: whether a value is right, and what is."""


class CheckedReader(DataParser):
    """Stands before a reader among a class's bases: outputs are checked, errors are one line."""

    def __init__(self, config: base_dataparser.DataParserConfig) -> None:
        super().__init__(config)
        self._first: dict[bool, tuple[Path, str]] = {}
        """The first picture with transparency and the first without, each with its split."""

    def get_dataparser_outputs(self, split: str = "train", **options: Any) -> DataparserOutputs:
        """As the reader's. InputError, in one line, for whatever goes wrong."""
        config: Any = self.config
        require_data(Path(config.data))
        for option, (is_right, wanted) in OPTIONS.items():
            value = getattr(config, option, None)
            require(value is None or is_right(value), option, value, wanted)
        if isinstance(factor := getattr(config, "downscale_factor", None), float):
            # as `ns-render dataset` gives it; nerfstudio would look for images_2.0
            config.downscale_factor = int(factor) if factor.is_integer() else factor
        scene = scene_file.scene_file_of(config, split)
        _refuse_pointers(config, "colmap_path")
        try:
            read = super().get_dataparser_outputs(split=split, **options)
            outputs = checked(read, config, split, scene)
            if scene is not None and isinstance(self, Nerfstudio):
                outputs.metadata |= told_by(scene, config.data, outputs)
            if outputs.image_filenames and outputs.alpha_color is None:
                path = Path(outputs.image_filenames[0])
                self._first[header_of(path).transparent] = path, split
        except InputError:
            raise
        # nerfstudio's readers assert, ask and exit
        except (Exception, SystemExit) as error:
            _refuse_pointers(config, "images_path")
            for path in () if scene is None else scene.pictures():
                _ = header_of(path) if path.is_file() else None  # one that is none goes first
            if scene is not None and isinstance(self, Nerfstudio):
                _check_lists(scene)
            fault = f"{Path(config.data)} cannot be read as a scene by {reader_name(config)}"
            raise InputError(f"{fault}: {_reason(error)}; {_remedy(error, config)}") from error
        if len(self._first) == 2:
            (clear, one), (solid, other) = self._first[True], self._first[False]
            fault = f"{clear} of the split {one} has transparency, and {solid} of {other} has none"
            raise InputError(f"{fault}: {SAVE_ALIKE}")
        return outputs


@functools.cache
def checked_class(kind: type[DataParser]) -> type[DataParser]:
    """A subclass of a reader that is checked, and shifts large positions where it can."""
    if issubclass(kind, CheckedReader):
        return kind
    return type(kind.__name__, (CheckedReader, *near_bases(kind)), {"__module__": kind.__module__})


def read_checked(parser: Any) -> Any:
    """A reader like this one that is checked."""
    of: Any = type(parser)
    kind = checked_class(of)
    return parser if isinstance(parser, kind) else kind(parser.config)


def set_up_checked(config: Any, **options: Any) -> Any:
    """What a config of `with_checks` sets up: its own reader, checked."""
    return checked_class(scene_file.own_target(config))(config, **options)


def with_checks(config: Any) -> Any:
    """The config of a reader that will be checked in whatever data manager."""
    return replace(config, _target=set_up_checked)


def reader_name(config: Any) -> str:
    """What a reader is called on the command line."""
    from nerfstudio.configs.dataparser_configs import all_dataparsers

    names = [name for name, known in all_dataparsers.items() if type(known) is type(config)]
    return names[0] if names else type(config).__name__


def _refuse_pointers(config: Any, option: str) -> None:
    """InputError for a file that Git LFS has not fetched in a folder that a COLMAP reader names."""
    folder = getattr(config, option, None)
    for path in () if folder is None else sorted((Path(config.data) / folder).glob("*")):
        if is_pointer(path):
            raise InputError(f"{path} {FETCH}")


def _check_lists(scene: SceneFile) -> None:
    """InputError for a list of photographs that is none, or names others than frames do."""
    known = {*scene.pictures()}
    for key in ("train_filenames", "val_filenames", "test_filenames"):
        listed = scene.meta.get(key, [])
        if not isinstance(listed, list) or not all(isinstance(name, str) for name in listed):
            raise InputError(f"{scene.path}: {key} is no list of names: list the file_path of each")
        for name in listed:
            if find_file(scene.folder / name) not in known:
                fault = f"{scene.path}: {key} has {name}, and no frame has"
                raise InputError(f"{fault}: write it as its file_path")


def _reason(error: BaseException) -> str:
    said = one_line(error, 200).rstrip(".")
    if isinstance(error, EOFError | SystemExit):
        return "it asks a question, and nobody answered"
    if isinstance(error, AssertionError | OSError | ValueError | RuntimeError) and said:
        return said
    return f"{type(error).__name__} {said}".strip()


def _remedy(error: BaseException, config: Any) -> str:
    """What to do about an error of a reader: another one only where its file is not there."""
    data, name = Path(config.data), reader_name(config)
    if not data.exists():
        return "there is no such folder: put it, or a link, there, or give another with --data"
    if _lacks_its_file(error, config) and (other := scene_file.remedy_for(data)):
        return other
    if isinstance(error, EOFError | SystemExit):
        if name != "colmap":
            return "run it on a terminal once, and answer"
        reader = f"colmap --downscale-factor 1 --colmap-path {config.colmap_path}"
        command = f"`{command_with(reader, data) or reader}` takes them as they are"
        return f"it would make smaller copies of photographs of more than 1600 pixels: {command}"
    if "list of filenames for split" in str(error):
        lists = "train_filenames, val_filenames and test_filenames"
        if name == "colmap":
            lists = f"train_list.txt, val_list.txt and test_list.txt in {data}"
        return f"list photographs in each of {lists}, or remove these lists"
    if name == "colmap" and "Some filenames for split" in str(error):
        return "in its _list.txt, write each as its model has it, and leave no line empty"
    if "camera model" in _reason(error).lower():
        return "undistort the photographs with `colmap image_undistorter`, and give that model"
    if re.search(r"\w\\{1,2}\w", str(error)):
        return "its names were written by Windows: write / for each backslash"
    if re.search(r"\.(png|jpe?g)\.png\b", str(error), re.IGNORECASE):
        return f"{name} adds .png to each file_path, and reads no other kind: leave endings off"
    if hasattr(config, "images_path") and not (data / config.images_path).is_dir():
        return "name the folder of its photographs with --images-path after colmap"
    if isinstance(error, ImportError):
        by_system = " (by `sudo apt-get install libusb-1.0-0`)" if "libusb" in str(error) else ""
        return f"install it{by_system}: {name} needs it"
    if isinstance(error, ZeroDivisionError):
        return "add photographs: a scene is seen from two places at least"
    if isinstance(error, UnidentifiedImageError):
        return photograph_files.SAVE_ANEW
    if isinstance(error, FileNotFoundError | NotADirectoryError):
        otherwise = "put that file there, or remove what names it"
        return photograph_files.remedy_for_missing(Path(error.filename or data), otherwise)[2:]
    file = description_of(config, "train") or data / getattr(config, "colmap_path", "")
    if isinstance(error, KeyError):
        return f"add {one_line(error, 40)} to {file}"
    return f"mend {file}"


def _lacks_its_file(error: BaseException, config: Any) -> bool:
    if description_of(config, "train") is not None:
        return False  # it has been read
    data, name = Path(config.data), reader_name(config)
    if hasattr(config, "colmap_path"):
        return not scene_file.has_model(data / config.colmap_path)
    signs = [sign for sign, reader in scene_file.READERS.items() if reader == name]
    if signs:
        return not (data / signs[0]).is_file()
    return isinstance(error, FileNotFoundError | NotADirectoryError) or "exist" in str(error)


def checked(
    outputs: DataparserOutputs, config: Any, split: str, scene: SceneFile | None
) -> DataparserOutputs:
    """What a reader returned, with pictures, masks and lenses such as the files say; some are
    converted into `leco-cache/pictures` beside the data. InputError for what cannot be read."""
    outputs.metadata = dict(outputs.metadata)
    if not outputs.image_filenames:
        return outputs
    data, speak = Path(config.data), split == "train"
    folder = data if data.is_dir() else data.parent
    derived = DerivedImages(folder / "leco-cache" / "pictures", UNWRITABLE)
    images = [Path(path) for path in outputs.image_filenames]
    cameras, factor = outputs.cameras, 1
    if cameras.camera_to_worlds.shape != (len(images), 3, 4):
        # as nerfstudio's reader of instant-ngp makes them of one photograph
        some = f"no cameras of {counted(len(images), 'photograph')} of the split {split}"
        remedy = "hold out more by a lower --train-split-fraction"
        raise InputError(f"{data}: {reader_name(config)} makes {some}: {remedy}")
    names = [f"{data}: the pose of {path}" for path in images]
    check_poses(cameras.camera_to_worlds.numpy(), names)
    headers = [header_of(path) for path in images]
    lenses: list[Lens | None] = [None] * len(images)
    if scene is not None:
        numbers = scene_file.frames_of(images, scene)
        lenses = [None if number is None else scene.lenses[number] for number in numbers]
        factor = scene_file.factor_of(scene, numbers, config, cameras)
        named = [None if n is None else scene.frames[n].get("mask_path") for n in numbers]
        unread = outputs.mask_filenames is None and not hasattr(config, "masks_dir")
        if unread and all(named):
            outputs.mask_filenames = [scene.mask(str(path)) for path in named]
        if speak:
            scene_file.say_unused(scene.meta, scene.path, cameras.times is not None)
    made = torch.cat([cameras.width, cameras.height], dim=-1).expand(len(images), -1).tolist()
    sizes = [size_of(*each, factor) for each in zip(images, headers, lenses, made)]
    cameras.width, cameras.height = torch.tensor(sizes).to(cameras.width).split(1, dim=1)
    set_lenses(cameras, lenses, factor)
    _check_focal_lengths(cameras, images)
    turns = [photograph_files.is_turned(header, size) for header, size in zip(headers, sizes)]
    outputs.image_filenames, lines = _plain_pictures(images, headers, turns, derived)
    for line in lines if speak else ():
        say(line)
    if outputs.mask_filenames is not None:
        masks = [Path(path) for path in outputs.mask_filenames]
        masks = photograph_files.convert_masks(masks, images, sizes, derived, speak)
        outputs.mask_filenames = masks
    elif speak and getattr(config, "masks_path", False) is None and (data / "masks").is_dir():
        say(f"{data / 'masks'} is not used: `--masks-path masks` would")
    return outputs


def _check_focal_lengths(cameras: Cameras, images: list[Path]) -> None:
    """InputError where a reader that reads no transforms.json has made a camera that is none."""
    for name in ("fx", "fy"):
        for path, value in zip(images, getattr(cameras, name).flatten().tolist()):
            if not 0.0 < value < float("inf"):
                fault = f"the camera of {path} has {name} {value:g}, which no camera has"
                raise InputError(f"{fault}: mend the intrinsics in the files of the scene")


def size_of(
    path: Path, header: Header, lens: Lens | None, wanted: list[int], factor: int
) -> tuple[int, int]:
    """Width and height of a picture as it will be read. InputError unless they are those of its
    lens or, where that has none, those `wanted` for its camera."""
    slack = 1
    if lens is not None and lens.width is not None and lens.height is not None:
        wanted = [int(lens.width) // factor, int(lens.height) // factor]
        slack = min(1, factor - 1)
    sizes = [header.size] + [header.size[::-1]] * (header.orientation >= 5)
    for size in sizes:
        if all(abs(one - other) <= slack for one, other in zip(size, wanted)):
            return size
    raise InputError(
        f"{path} has {sizes[0][0]} x {sizes[0][1]} pixels, its intrinsics are for "
        f"{wanted[0]} x {wanted[1]}: put photographs of that size there, or scale w, h, fl_x, "
        "fl_y, cx and cy"
    )


def _plain_pictures(
    images: list[Path], headers: list[Header], turns: list[bool], derived: DerivedImages
) -> tuple[list[Path], list[str]]:
    """Files that nerfstudio reads rightly, some turned as EXIF says, and lines on what was done."""
    paths, converted, as_stored = [], Counter[str](), []
    needed = any(turns) or not all(is_plain(header) for header in headers)
    with bar("Converting photographs") if needed else nullcontext(lambda share: None) as progress:
        for path, header, turn in zip(images, headers, turns):
            photograph_files.check_kind(path, header)
            if header.orientation != 1 and not turn:
                as_stored.append(path)
            if is_plain(header) and not turn:
                paths.append(path)
                continue
            is_turned = turn or header.tipped
            converted["turned as EXIF says" if is_turned else f"of mode {header.mode}"] += 1
            paths.append(derived.get(path, f"plain {turn}", partial(decode, path, turn)))
            progress(len(paths) / len(images))
    transparent = [path for path, header in zip(images, headers) if header.transparent]
    if 0 < len(transparent) < len(images):
        have = by_number(len(transparent), "has", "have")
        some = f"{len(transparent)} of {len(images)} images {have} transparency"
        raise InputError(f"{some}, the first is {transparent[0]}: {SAVE_ALIKE}")
    lines = [
        f"{counted(count, 'photograph')} {what} {by_number(count, 'is', 'are')} converted into "
        f"{derived.folder}"
        for what, count in converted.items()
    ]
    if as_stored:
        lines.append(
            counted(
                len(as_stored),
                "photograph is used as it is stored, though EXIF turns it",
                "photographs are used as they are stored, though EXIF turns them",
            )
            + f": that is what the intrinsics are for; the first is {as_stored[0]}. "
            "Where renders are turned, `mogrify -auto-orient` them and make the scene anew"
        )
    return paths, lines
