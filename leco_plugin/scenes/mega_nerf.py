"""`ns-train METHOD mega-nerf --data DIR`: scenes in Mega-NeRF's format, with its protocol.

Imported whenever an ns-* command starts: what reads files is imported when it is needed.

The model's coordinates are (right, forward, up) in units of `pose_scale_factor` metres, and the
dataparser's transform leads from metres (down, right, back), as in the files, to them. In the
protocol `half` the pictures of the validation set are trained on with their left halves and scored
with their right halves; those are pictures of their own here, with cameras of half the width, so
that any model is scored in this way.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.dataparsers.base_dataparser import (
    DataParser,
    DataParserConfig,
    DataparserOutputs,
)
from nerfstudio.plugins.registry_dataparser import DataParserSpecification
from torch import Tensor

if TYPE_CHECKING:
    from leco_plugin.scenes.derived_images import DerivedImages
    from leco_plugin.scenes.mega_nerf_format.files import Frame, MegaNerfScene


@dataclass
class MegaNerfDataParserConfig(DataParserConfig):
    """A scene in Mega-NeRF's format: Mill 19, UrbanScene3D, or your own"""

    _target: type = field(default_factory=lambda: MegaNerf)
    """target class to instantiate"""
    data: Path = Path()
    """Folder with coordinates.pt, train/ and val/."""
    protocol: Literal["half", "full"] = "half"
    """half: train on the left halves of the validation pictures, score the right halves, as
    Mega-NeRF and Switch-NeRF do. full: leave them out of training, score them whole."""
    train_scale_factor: int = 1
    """Divides the size of the pictures that are trained on."""
    val_scale_factor: int = 4
    """Divides the size of the pictures that are scored."""
    masks: Path | None = None
    """Folder of masks, say those of one cluster; by default DATA/masks where there is one."""
    cache: Path | None = None
    """Folder for resized pictures, right halves and unpacked masks; by default
    DATA/leco-cache."""
    points: Path | None = None
    """A .ply of sparse points in metres (down, right, back), which say where the ground is; by
    default DATA/points.ply where there is one."""
    ray_altitude_range: tuple[float, float] | None = None
    """Metres along the down axis at which rays are cut, top and ground, as in Mega-NeRF's own
    configurations: less is higher."""
    check_axes: bool = True
    """Whether to refuse a scene whose cameras show that its first axis does not point down."""


class MegaNerf(DataParser):
    """Reads a Mega-NeRF scene."""

    config: MegaNerfDataParserConfig
    _scene: MegaNerfScene | None = None

    def _generate_dataparser_outputs(
        self, split: str = "train", **kwargs: Any
    ) -> DataparserOutputs:
        config, scene = self.config, self._read()
        training, half = split == "train", config.protocol == "half"
        frames = [
            frame
            for frame in scene.frames
            if frame.split == ("train" if training else "val") or (training and half)
        ]
        factor = config.train_scale_factor if training else config.val_scale_factor
        masks: list[Path] | None = None
        if training:
            frames, images, masks = self._training_files(frames, factor)
        else:
            images = self._scored_files(frames, factor)
        cameras = _cameras(scene, frames, factor, right_half=half and not training)
        from leco_plugin.scenes.dataset_units import ALTITUDES, METRES_PER_UNIT, UP_IS_KNOWN
        from leco_plugin.scenes.frames import moved
        from leco_plugin.scenes.large_coordinates import far_origin, with_transform
        from leco_plugin.scenes.photographs import POINTS

        coordinates = scene.coordinates
        transform = torch.from_numpy(coordinates.transform())
        # the poses, scaled back, are in metres
        metadata: dict[str, Any] = {METRES_PER_UNIT: 1.0, UP_IS_KNOWN: True}
        if config.ray_altitude_range is not None:
            top, ground = config.ray_altitude_range
            metadata[ALTITUDES] = coordinates.height_of(ground), coordinates.height_of(top)
        points = self._points()
        if points is not None:
            metadata[POINTS] = (moved(points, transform) / coordinates.metres).float()
        outputs = DataparserOutputs(
            image_filenames=images,
            cameras=cameras,
            mask_filenames=masks,
            metadata=metadata,
            dataparser_transform=transform.float(),
            dataparser_scale=1.0 / coordinates.metres,
        )
        far = far_origin(scene.poses()[:, :, 3] * coordinates.metres + coordinates.origin_drb)
        return outputs if far is None else with_transform(outputs, transform)

    def _read(self) -> MegaNerfScene:
        """The scene, read once, with a line that says what it is."""
        if self._scene is None:
            from leco_plugin.log import bar, console
            from leco_plugin.scenes.mega_nerf_format.files import read_scene

            _check(self.config)
            with bar("Reading the scene") as progress:
                self._scene = read_scene(self.config.data, self.config.check_axes, progress)
            console().log(self._scene.describe())
        return self._scene

    def _points(self) -> Tensor | None:
        """Sparse points [P, 3] as the file has them, if there is one."""
        from leco_plugin.scenes.input_error import InputError
        from leco_plugin.scenes.photographs import read_ply

        path = self.config.points or self.config.data / "points.ply"
        if path.is_file():
            return read_ply(path, torch.float64)
        if self.config.points is not None:
            raise InputError(f"there is no file {path} with sparse points")
        return None

    def _derived(self) -> DerivedImages:
        from leco_plugin.scenes.derived_images import DerivedImages

        return DerivedImages(self.config.cache or self.config.data / "leco-cache")

    def _training_files(
        self, frames: list[Frame], factor: int
    ) -> tuple[list[Frame], list[Path], list[Path] | None]:
        """Frames that have a pixel to train on, their pictures, and their masks if any has one."""
        from leco_plugin.scenes.mega_nerf_format.images import mask_of, picture_of

        derived = self._derived()
        folder = self.config.masks
        if folder is None and (self.config.data / "masks").is_dir():
            folder = self.config.data / "masks"
        masks: list[Path] | None = None
        if folder is not None or any(frame.split == "val" for frame in frames):
            found = self._each(
                "Unpacking the masks",
                frames,
                lambda frame: mask_of(frame, factor, frame.split == "val", folder, derived),
            )
            seen = [(frame, mask) for frame, mask in zip(frames, found) if mask is not None]
            if not seen:
                from leco_plugin.scenes.input_error import InputError

                raise InputError(f"the masks in {folder} leave no pixel to train on")
            frames, masks = [frame for frame, _ in seen], [mask for _, mask in seen]
        images = self._each(
            "Resizing the pictures", frames, lambda frame: picture_of(frame, factor, False, derived)
        )
        return frames, images, masks

    def _scored_files(self, frames: list[Frame], factor: int) -> list[Path]:
        from leco_plugin.scenes.mega_nerf_format.images import picture_of

        derived, half = self._derived(), self.config.protocol == "half"
        return self._each(
            "Resizing the pictures", frames, lambda frame: picture_of(frame, factor, half, derived)
        )

    def _each(self, what: str, frames: list[Frame], make: Callable[[Frame], Any]) -> list[Any]:
        """What `make` makes of each frame, under a progress bar."""
        from leco_plugin.log import bar

        made = []
        with bar(what) as progress:
            for number, frame in enumerate(frames):
                made.append(make(frame))
                progress((number + 1) / len(frames))
        return made


def _check(config: MegaNerfDataParserConfig) -> None:
    from leco_plugin.scenes.input_error import InputError

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


def _cameras(scene: MegaNerfScene, frames: list[Frame], factor: int, right_half: bool) -> Cameras:
    """Cameras of pictures divided by a factor, or of their right halves."""
    import numpy as np

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


mega_nerf_dataparser = DataParserSpecification(
    config=MegaNerfDataParserConfig(),
    description="A scene in Mega-NeRF's format: --protocol half|full, --val-scale-factor, --masks.",
)
