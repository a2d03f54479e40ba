"""What all readers of scenes pass: their pictures, masks and lenses, and their errors.

nerfstudio has some fifteen readers, and packages add more. Each checks something else, so that
what is read wrongly is looked for in what they return.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from nerfstudio.cameras.cameras import CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig, DataparserOutputs
from rich.markup import escape

from leco_plugin.log import bar, say
from leco_plugin.scenes.derived_images import DerivedImages
from leco_plugin.scenes.input_error import InputError, one_line
from leco_plugin.scenes.known_folders import remedy_for
from leco_plugin.scenes.large_coordinates import read_near
from leco_plugin.scenes.lenses import Lens, check_kinds, factor_of, lens_of, set_lenses
from leco_plugin.scenes.photograph_files import (
    Header,
    check_kind,
    decode,
    header_of,
    is_plain,
    is_turned,
)
from leco_plugin.scenes.photograph_masks import check_masked, masks_as_read
from leco_plugin.scenes.scene_fields import say_unused
from leco_plugin.studio.checkpoints import require_data

CHECKED = "leco_checked"
"""Key of a dataparser's metadata: there where `checked` has been at its outputs."""
UNWRITABLE = "make the folder of the scene writable, or convert its pictures and masks by hand"


def read_checked(parser: Any) -> Any:
    """The reader with its outputs checked, large positions shifted, and each error in one line."""
    read_near(parser)
    parser.get_dataparser_outputs = in_one_line(parser.get_dataparser_outputs, parser.config)
    return parser


def set_up_checked(config: Any, **options: Any) -> Any:
    """What a config of `with_checks` sets up: its own reader, as of `read_checked`."""
    return read_checked(_own_target(config)(config, **options))


def with_checks(config: DataParserConfig) -> DataParserConfig:
    """The config of a reader that will be checked in whatever data manager."""
    return replace(config, _target=set_up_checked)  # type: ignore[arg-type]


def _own_target(config: Any) -> Any:
    """The class of a config's reader."""
    if config._target is not set_up_checked:
        return config._target
    return type(config)()._target


def in_one_line(read: Callable[..., DataparserOutputs], config: Any) -> Callable[..., Any]:
    """A reader of splits whose outputs are checked, and each of whose errors is one line.

    Args:
        read: its `get_dataparser_outputs`.
        config: of the reader.
    """

    def outputs_of(split: str = "train", **options: Any) -> DataparserOutputs:
        require_data(Path(config.data))
        try:
            return checked(read(split=split, **options), config, split)
        except InputError:
            raise
        # nerfstudio's readers assert, ask and exit
        except (Exception, SystemExit) as error:
            data = Path(config.data)
            raise InputError(
                f"{data} cannot be read as a scene by {reader_name(config)}: "
                f"{_reason(error)}; {_remedy(error, config)}"
            ) from error

    return outputs_of


def reader_name(config: Any) -> str:
    """What a reader is called on the command line."""
    from nerfstudio.configs.dataparser_configs import all_dataparsers

    names = [name for name, known in all_dataparsers.items() if type(known) is type(config)]
    return names[0] if names else type(config).__name__


def _reason(error: BaseException) -> str:
    said = one_line(error, 200).rstrip(".")
    if isinstance(error, EOFError | SystemExit):
        return "it asks a question, and nobody answered"
    if isinstance(error, AssertionError | OSError | ValueError | RuntimeError) and said:
        return said
    return f"{type(error).__name__} {said}".strip()


def _remedy(error: BaseException, config: Any) -> str:
    """What to do about an error of a reader."""
    data, name = Path(config.data), reader_name(config)
    if not data.exists():
        return "there is no such folder: put it, or a link, there, or give another with --data"
    if isinstance(error, EOFError | SystemExit) and name == "colmap":
        return (
            "it would make smaller copies of photographs of more than 1600 pixels: "
            "`colmap --downscale-factor 1` takes them as they are"
        )
    if name == "colmap" and "camera model" in _reason(error).lower():
        return "undistort the photographs with `colmap image_undistorter`, and give that model"
    if "\\" in str(error).replace("\\\\", "\\"):
        return "its names were written by Windows: write / for each backslash"
    used = f"{name} {getattr(config, 'colmap_path', '')}".strip()
    return remedy_for(data, used) or "mend it, or name another reader after the method"


def checked(outputs: DataparserOutputs, config: Any, split: str) -> DataparserOutputs:
    """What a reader returned, with every picture, mask and lens such as the files say.

    Pictures and masks that nerfstudio would read wrongly are converted into `leco-cache/pictures`
    beside the data, or refused.

    Raises:
        InputError: one line.
    """
    outputs.metadata = dict(outputs.metadata)
    if outputs.metadata.get(CHECKED) or not outputs.image_filenames:
        return outputs
    data, speak = Path(config.data), split == "train"
    derived = DerivedImages(
        (data if data.is_dir() else data.parent) / "leco-cache" / "pictures", UNWRITABLE
    )
    images = [Path(path) for path in outputs.image_filenames]
    if outputs.cameras.camera_to_worlds.shape != (len(images), 3, 4):
        raise InputError(  # as nerfstudio's reader of instant-ngp makes them of one photograph
            f"{data}: {reader_name(config)} makes no cameras of {len(images)} photographs of the "
            f"split {split}: hold out more, or name another reader after the method"
        )
    headers = [header_of(path) for path in images]
    cameras, factors = outputs.cameras, [1] * len(images)
    lenses: list[Lens | None] = [None] * len(images)
    file = _description(config, split)
    if file is not None:
        meta = json.loads(file.read_text(encoding="utf-8"))
        frames = _frames_of(images, meta, file)
        for number, frame in enumerate(frames):
            if frame is not None:
                lenses[number] = lens_of(meta, frame, f"{file}: {frame['file_path']}")
                if hasattr(config, "downscale_factor") or "w" in meta:
                    factors[number] = factor_of(meta, frame, int(cameras.width[number]))
        check_kinds([lens for lens in lenses if lens is not None], str(file))
        radius = meta.get("fisheye_crop_radius")
        if radius is not None and any(lens and lens.kind is CameraType.FISHEYE for lens in lenses):
            cameras.metadata = (cameras.metadata or {}) | {"fisheye_crop_radius": radius}
        check_masked(meta["frames"], file.parent)
        masked = [frame["mask_path"] for frame in frames if frame and "mask_path" in frame]
        if outputs.mask_filenames is None and len(masked) == len(images):
            outputs.mask_filenames = [file.parent / path.replace("\\", "/") for path in masked]
        if speak:
            say_unused(meta, file)
    made = torch.cat([cameras.width, cameras.height], dim=-1).expand(len(images), -1).tolist()
    sizes = [_size_of(*each) for each in zip(images, headers, lenses, made, factors)]
    set_lenses(cameras, lenses, factors)
    cameras.width, cameras.height = torch.tensor(sizes).to(cameras.width).split(1, dim=1)
    outputs.image_filenames = _plain_pictures(images, headers, sizes, derived, speak)
    if outputs.mask_filenames is not None:
        masks = [Path(path) for path in outputs.mask_filenames]
        outputs.mask_filenames = masks_as_read(masks, images, sizes, derived, speak)
    elif speak and getattr(config, "masks_path", False) is None and (data / "masks").is_dir():
        say(f"{escape(str(data / 'masks'))} is not used: `--masks-path masks` would")
    outputs.metadata[CHECKED] = True
    return outputs


def _description(config: Any, split: str) -> Path | None:
    """The transforms.json that a reader reads; None of one that reads something else."""
    from nerfstudio.data.dataparsers.blender_dataparser import Blender
    from nerfstudio.data.dataparsers.dnerf_dataparser import DNeRF
    from nerfstudio.data.dataparsers.instant_ngp_dataparser import InstantNGP
    from nerfstudio.data.dataparsers.nerfstudio_dataparser import Nerfstudio

    data = Path(config.data)
    target = _own_target(config)
    if issubclass(target, Nerfstudio | InstantNGP):
        return data if data.suffix == ".json" else data / "transforms.json"
    return data / f"transforms_{split}.json" if issubclass(target, Blender | DNeRF) else None


def _frames_of(images: list[Path], meta: dict[str, Any], file: Path) -> list[dict[str, Any] | None]:
    """The frame of each picture, which may be a smaller one of the same name.

    Raises:
        InputError: one line; several frames of different folders would have one smaller picture.
    """
    named: dict[str, list[dict[str, Any]]] = {}
    for frame in meta["frames"]:
        named.setdefault(_name_of(frame), []).append(frame)
    found: list[dict[str, Any] | None] = []
    for image in images:
        frames = named.get(image.name) or named.get(image.stem) or []
        ends = [frame for frame in frames if _is_at(image, frame, file.parent)]
        places = {str(frame["file_path"]) for frame in frames}
        if not ends and len(places) > 1:
            raise InputError(
                f"{image} would be the picture of {' and of '.join(sorted(places)[:2])}: "
                "give them names of their own"
            )
        found.append(next(iter(ends or frames), None))
    return found


def _name_of(frame: dict[str, Any]) -> str:
    return str(frame["file_path"]).replace("\\", "/").rsplit("/", 1)[-1]


def _is_at(image: Path, frame: dict[str, Any], folder: Path) -> bool:
    path = folder / str(frame["file_path"]).replace("\\", "/")
    return image in (path, path.with_name(f"{path.name}{image.suffix}"))


def _size_of(
    path: Path, header: Header, lens: Lens | None, wanted: list[int], factor: int
) -> tuple[int, int]:
    """Width and height of a picture as it will be read.

    Args:
        wanted: of its camera, by its reader.
    Raises:
        InputError: they are not those of its lens or, where that is not known, of its camera.
    """
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
        f"{wanted[0]} x {wanted[1]}"
    )


def _plain_pictures(
    images: list[Path],
    headers: list[Header],
    sizes: list[tuple[int, int]],
    derived: DerivedImages,
    speak: bool,
) -> list[Path]:
    """Files of the pictures that nerfstudio reads rightly."""
    paths, converted, as_stored = [], Counter[str](), []
    turns = [is_turned(header, size) for header, size in zip(headers, sizes)]
    needed = any(turns) or not all(is_plain(header) for header in headers)
    with bar("Converting photographs") if needed else nullcontext(lambda share: None) as progress:
        for path, header, turn in zip(images, headers, turns):
            check_kind(path, header)
            if header.orientation != 1 and not turn:
                as_stored.append(path)
            if is_plain(header) and not turn:
                paths.append(path)
                continue
            converted["turned as EXIF says" if turn else f"of mode {header.mode}"] += 1
            paths.append(derived.get(path, f"plain {turn}", partial(decode, path, turn)))
            progress(len(paths) / len(images))
    transparent = [path for path, header in zip(images, headers) if header.transparent]
    if 0 < len(transparent) < len(images):
        raise InputError(
            f"{len(transparent)} of {len(images)} images have transparency, the first is "
            f"{transparent[0]}: save all with an alpha channel or none"
        )
    for what, count in converted.items() if speak else ():
        say(f"{count} photographs {what} are converted into {escape(str(derived.folder))}")
    if as_stored and speak:
        say(
            f"{len(as_stored)} photographs are used as they are stored, though EXIF turns them: "
            f"that is what their intrinsics are for; the first is {escape(str(as_stored[0]))}"
        )
    return paths
