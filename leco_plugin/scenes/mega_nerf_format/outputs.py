"""What nerfstudio is told of a Mega-NeRF scene: cameras, pictures, masks, points and altitudes.

The model's coordinates are (right, forward, up) in units of `pose_scale_factor` metres. The
dataparser's transform leads from metres (down, right, back), as in the files, to them.

In the protocol `half` the pictures of the validation set are trained on with their left halves and
scored with their right halves. Those are pictures of their own here, with cameras of half the
width, so that any model is scored in this way.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from torch import Tensor

from leco_plugin.log import bar, console
from leco_plugin.scenes.dataset_units import ALTITUDES, METRES_PER_UNIT, UP_IS_KNOWN
from leco_plugin.scenes.derived_images import DerivedImages
from leco_plugin.scenes.frames import moved
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.large_coordinates import far_origin, with_transform
from leco_plugin.scenes.mega_nerf_format.files import Frame, MegaNerfScene, read_scene
from leco_plugin.scenes.mega_nerf_format.images import mask_of, picture_of
from leco_plugin.scenes.photographs import POINTS, read_ply

if TYPE_CHECKING:
    from leco_plugin.scenes.mega_nerf import MegaNerfDataParserConfig


def read(config: MegaNerfDataParserConfig) -> MegaNerfScene:
    """The scene without its pixels, and a line in the log that says what it is.

    Raises:
        InputError: an option or a file is wrong.
    """
    if min(config.train_scale_factor, config.val_scale_factor) < 1:
        raise InputError("train_scale_factor and val_scale_factor are whole numbers from 1 on")
    if config.ray_altitude_range is not None:
        top, ground = config.ray_altitude_range
        if not -math.inf < top < ground < math.inf:
            raise InputError(
                f"ray_altitude_range is the top and then the ground, in metres along the down axis,"
                f" so that the first is less: not {top:g} and {ground:g}"
            )
    if config.masks is not None and not config.masks.is_dir():
        raise InputError(f"there is no folder {config.masks} with masks")
    with bar("Reading the scene") as progress:
        scene = read_scene(config.data, config.check_axes, progress)
    console().log(scene.describe())
    return scene


def outputs_of(
    config: MegaNerfDataParserConfig, scene: MegaNerfScene, training: bool
) -> DataparserOutputs:
    """The pictures that are trained on, or those that are scored, as nerfstudio takes them.

    Raises:
        InputError: a picture, a mask or the file of points is wrong.
    """
    half = config.protocol == "half"
    frames = [
        frame
        for frame in scene.frames
        if frame.split == ("train" if training else "val") or (training and half)
    ]
    factor = config.train_scale_factor if training else config.val_scale_factor
    derived = DerivedImages(config.cache or config.data / "leco-cache")
    masks: list[Path] | None = None
    if training:
        frames, masks = _with_masks(config, frames, derived)
    right = half and not training
    images = _for_each(
        "Resizing the pictures", frames, lambda frame: picture_of(frame, factor, right, derived)
    )
    coordinates = scene.coordinates
    transform = torch.from_numpy(coordinates.transform())
    # the poses, scaled back, are in metres
    metadata: dict[str, Any] = {METRES_PER_UNIT: 1.0, UP_IS_KNOWN: True}
    if config.ray_altitude_range is not None:
        top, ground = config.ray_altitude_range
        metadata[ALTITUDES] = coordinates.height_of(ground), coordinates.height_of(top)
    points = _points(config)
    if points is not None:
        metadata[POINTS] = (moved(points, transform) / coordinates.metres).float()
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
    found = _for_each(
        "Unpacking the masks",
        frames,
        lambda frame: mask_of(frame, factor, frame.split == "val", folder, derived),
    )
    seen = [(frame, mask) for frame, mask in zip(frames, found) if mask is not None]
    if not seen:
        raise InputError(f"the masks in {folder} leave no pixel to train on")
    return [frame for frame, _ in seen], [mask for _, mask in seen]


def _for_each(what: str, frames: list[Frame], make: Callable[[Frame], Any]) -> list[Any]:
    """What `make` makes of each frame, under a progress bar."""
    made = []
    with bar(what) as progress:
        for number, frame in enumerate(frames):
            made.append(make(frame))
            progress((number + 1) / len(frames))
    return made


def _points(config: MegaNerfDataParserConfig) -> Tensor | None:
    """Sparse points [P, 3] as the file has them, if there is one."""
    path = config.points or config.data / "points.ply"
    if path.is_file():
        return read_ply(path, torch.float64)
    if config.points is not None:
        raise InputError(f"there is no file {path} with sparse points")
    return None


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
