"""What nerfstudio is told of a Mega-NeRF scene: cameras, pictures, masks, points and altitudes. In
the protocol `half` the right halves of validation pictures are scored: pictures of their own, with
cameras of half the width, so that any model is scored in this way."""

from __future__ import annotations

import io
import math
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from numpy.typing import NDArray
from PIL import Image

from leco_plugin.log import for_each, note
from leco_plugin.scenes.coloured_points import points_in_model, read_cloud
from leco_plugin.scenes.frames import ALTITUDES, METRES_PER_UNIT, UP_IS_KNOWN
from leco_plugin.scenes.input_error import InputError, one_line, require_folder
from leco_plugin.scenes.large_coordinates import far_origin, with_transform
from leco_plugin.scenes.mega_nerf_files import Frame, MegaNerfScene, read_scene
from leco_plugin.scenes.photograph_files import (
    DerivedImages,
    check_kind,
    decode,
    header_of,
    is_plain,
)
from leco_plugin.scenes.pt_file import describe, load, read_bytes

if TYPE_CHECKING:
    from leco_plugin.scenes.mega_nerf import MegaNerfDataParserConfig


def read(config: MegaNerfDataParserConfig) -> MegaNerfScene:
    """The scene without its pixels, described in the log. InputError for a wrong option or file."""
    if min(config.train_scale_factor, config.val_scale_factor) < 1:
        raise InputError("train_scale_factor and val_scale_factor are whole numbers from 1 on")
    if config.ray_altitude_range is not None:
        top, ground = config.ray_altitude_range
        if not -math.inf < top < ground < math.inf:
            raise InputError(
                f"ray_altitude_range is the top and then the ground, in metres along the down axis,"
                f" so that the first is less: not {top:g} and {ground:g}"
            )
    if config.masks is not None:
        require_folder(config.masks, "give one with masks, or leave --masks out")
    scene = read_scene(config.data, config.check_axes)
    note(scene.describe())
    for frame in scene.frames:  # now, and not after minutes of resizing for training
        if frame.split == "val":
            scaled(frame, config.val_scale_factor)
    return scene


def outputs_of(
    config: MegaNerfDataParserConfig, scene: MegaNerfScene, training: bool
) -> DataparserOutputs:
    """The pictures to train on, or to score. InputError for a wrong picture, mask or point file."""
    half = config.protocol == "half"
    splits = ("train", "val") if training and half else ("train",) if training else ("val",)
    frames = [frame for frame in scene.frames if frame.split in splits]
    factor = config.train_scale_factor if training else config.val_scale_factor
    derived = DerivedImages(config.cache or config.data / "leco-cache")
    coordinates = scene.coordinates
    transform = torch.from_numpy(coordinates.transform())
    # the poses, scaled back, are in metres
    metadata: dict[str, Any] = {METRES_PER_UNIT: 1.0, UP_IS_KNOWN: True}
    if config.ray_altitude_range is not None:
        top, ground = map(coordinates.height_of, config.ray_altitude_range)
        metadata[ALTITUDES] = ground, top
    points = config.points or config.data / "points.ply"
    if points.is_file():
        metadata |= points_in_model(read_cloud(points), transform / coordinates.metres)
    elif config.points is not None:
        raise InputError(f"there is no file {points} with sparse points")
    masks: list[Path] | None = None
    if training:
        frames, masks = _with_masks(config, frames, derived)
    right = half and not training
    images = for_each(
        "Resizing the pictures", frames, lambda frame: picture_of(frame, factor, right, derived)
    )
    outputs = DataparserOutputs(
        image_filenames=images,
        cameras=_cameras(scene, frames, factor, right),
        mask_filenames=masks,
        metadata=metadata,
        dataparser_transform=transform.float(),
        dataparser_scale=1.0 / coordinates.metres,
    )
    far = far_origin(scene.poses()[:, :, 3] * coordinates.metres + coordinates.origin_drb)
    return outputs if far is None else with_transform(outputs, transform)


def _with_masks(
    config: MegaNerfDataParserConfig, frames: list[Frame], derived: DerivedImages
) -> tuple[list[Frame], list[Path] | None]:
    """Frames that have a pixel to train on, and their masks if any frame has one."""
    folder, factor = config.masks, config.train_scale_factor
    if folder is None and (config.data / "masks").is_dir():
        folder = config.data / "masks"
    if folder is None and all(frame.split == "train" for frame in frames):
        return frames, None
    found = for_each(
        "Unpacking the masks",
        frames,
        lambda frame: mask_of(frame, factor, frame.split == "val", folder, derived),
    )
    seen = [(frame, mask) for frame, mask in zip(frames, found) if mask is not None]
    if not seen:
        raise InputError(f"the masks in {folder} leave no pixel to train on")
    return [frame for frame, _ in seen], [mask for _, mask in seen]


def _cameras(scene: MegaNerfScene, frames: list[Frame], factor: int, right_half: bool) -> Cameras:
    """Cameras of pictures divided by a factor, or of their right halves."""
    poses = scene.coordinates.to_model(np.stack([frame.pose for frame in frames]))
    intrinsics = torch.from_numpy(np.stack([frame.intrinsics for frame in frames]) / factor).float()
    widths = torch.tensor([frame.width // factor for frame in frames])
    heights = torch.tensor([frame.height // factor for frame in frames])
    left = widths // 2 if right_half else torch.zeros_like(widths)
    return Cameras(
        camera_to_worlds=torch.from_numpy(poses).float(),
        fx=intrinsics[:, 0],
        fy=intrinsics[:, 1],
        cx=intrinsics[:, 2] - left,
        cy=intrinsics[:, 3],
        width=widths - left,
        height=heights,
        camera_type=CameraType.PERSPECTIVE,
    )


_MORE = 1 << 16
"""Bytes that a file may have beyond its pixels, one byte each."""


def scaled(frame: Frame, factor: int) -> tuple[int, int]:
    """Width and height of a picture divided by a factor. InputError if that cannot be."""
    if frame.width % factor or frame.height % factor:
        raise InputError(
            f"{frame.image} has metadata for {frame.width} x {frame.height} pixels, "
            f"which a scale factor of {factor} does not divide"
        )
    size = frame.width // factor, frame.height // factor
    if frame.image_size[0] < size[0]:
        raise InputError(
            f"{frame.image} has {frame.image_size[0]} x {frame.image_size[1]} pixels, fewer than "
            f"the {size[0]} x {size[1]} that are asked for; use a larger scale factor"
        )
    return size


def picture_of(frame: Frame, factor: int, right_half: bool, derived: DerivedImages) -> Path:
    """A file with the picture, resized as Mega-NeRF does it, or with its right half only."""
    size = scaled(frame, factor)
    header = header_of(frame.image, turned=False)
    check_kind(frame.image, header)
    if frame.image_size == size and is_plain(header) and not right_half:
        return frame.image

    def make() -> Image.Image:
        image = decode(frame.image, turn=False)
        if image.size != size:
            image = image.resize(size, Image.Resampling.LANCZOS)
        return image.crop((size[0] // 2, 0, *size)) if right_half else image

    return derived.get(frame.image, f"{size} {'right' if right_half else 'whole'}", make)


def mask_of(
    frame: Frame, factor: int, left_half: bool, masks: Path | None, derived: DerivedImages
) -> Path | None:
    """A file with the pixels to train on, or None if there are none; `left_half` leaves out the
    right half of the picture, `masks` is the folder of the scene's masks, if it has any."""
    size = scaled(frame, factor)
    if masks is None:
        part = "left" if left_half else "whole"
        path = derived.folder / f"{part}-{size[0]}x{size[1]}.png"
        if not path.exists():
            derived.put(path, _cut(Image.new("L", size, 255), left_half))
        return path

    source = masks / f"{frame.stem}.pt"
    if not source.is_file():
        raise InputError(f"there is no {source}: each picture needs a mask, or none has one")

    def make() -> Image.Image:
        keep = read_mask(source, frame.width, frame.height)
        mask = Image.fromarray(keep.astype(np.uint8) * 255)
        if mask.size != size:
            mask = mask.resize(size, Image.Resampling.NEAREST)
        mask = _cut(mask, left_half)
        return mask if mask.getbbox() else Image.new("L", (1, 1))

    path = derived.get(source, f"{frame.width, frame.height} {size} {left_half}", make)
    # a mask that keeps nothing is kept as one pixel, so that its header says so
    return None if header_of(path, turned=False).size != size else path


def _cut(mask: Image.Image, left_half: bool) -> Image.Image:
    if left_half:
        mask.paste(0, (mask.width // 2, 0, *mask.size))
    return mask


def read_mask(path: Path, width: int, height: int) -> NDArray[np.bool_]:
    """Pixels of a picture to keep: bool [height, width]. InputError without such a mask there."""
    most = width * height + _MORE
    mask = load(_unpack(path, read_bytes(path, most), most), str(path))
    if not isinstance(mask, torch.Tensor) or mask.dtype != torch.bool or mask.dim() != 2:
        raise InputError(f"{path} holds {describe(mask)}, and a mask is a tensor of bool [H, W]")
    if tuple(mask.shape) != (height, width):
        raise InputError(
            f"{path} is a mask of {mask.shape[1]} x {mask.shape[0]} pixels, "
            f"its picture has {width} x {height}"
        )
    # a byte of a damaged file may be neither 0 nor 1
    keep: NDArray[np.bool_] = mask.view(torch.uint8).numpy() != 0
    return keep


def _unpack(path: Path, data: bytes, most: int) -> bytes:
    """The .pt file in a mask's zip, of at most so many bytes."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            entry = archive.getinfo(f"{path.stem}.pt")
            if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise InputError(f"{path} is compressed in a way that Mega-NeRF does not use")
            with archive.open(entry) as file:
                inside = file.read(most + 1)
    except InputError:
        raise
    except KeyError:
        raise InputError(f"{path} is a zip without {path.stem}.pt, so no mask") from None
    # Damaged archives raise whatever their reader meets; nothing of it is a new fault.
    except Exception as error:  # noqa: BLE001
        said = one_line(error, 120)
        raise InputError(f"{path} is not a zip with a mask: {said}") from None
    if len(inside) > most:
        raise InputError(f"{path} unpacks to more than {most} bytes, too many for its picture")
    return inside
