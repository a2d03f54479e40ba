"""Large coordinates, as of UTM: positions are shifted in float64 before a reader casts them.

nerfstudio's readers make poses and points float32 before they centre them, and float32 keeps
northings to half a metre. The shift is part of `dataparser_transform`, which is float64 then.
"""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from types import FunctionType
from typing import Any

import numpy as np
import torch
from nerfstudio.data.dataparsers import base_dataparser
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataparserOutputs
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParser
from nerfstudio.data.dataparsers.nerfstudio_dataparser import Nerfstudio
from nerfstudio.data.utils import colmap_parsing_utils
from numpy.typing import NDArray
from torch import Tensor

from leco_plugin.log import say
from leco_plugin.scenes.frames import APPLIED, applied_in, inverse, moved, parsed_frame
from leco_plugin.scenes.scene_file import file_in, load_json, poses_in

FAR = 100.0
"""Times the cameras' spread. Nearer to the origin float32 rounds to less than 1e-5 of it."""
SEAMS = {"load_from_json", "_get_all_images_and_cameras"}
"""What nerfstudio's readers call for the poses of a file, float64 still."""

COUNT_BYTES = 8
"""Of a points3D.bin the number of points, before these."""

Array = NDArray[np.float64]


def far_origin(positions: Array) -> Array | None:
    """The middle [3] of camera positions [C, 3] that lie far from the origin; None of others."""
    middle: Array = np.median(positions, axis=0)
    distances = np.linalg.norm(positions - middle, axis=1)
    spread = float(np.median(distances) or distances.max())
    return middle if 0.0 < FAR * spread < float(np.linalg.norm(middle)) < np.inf else None


class ExactOutputs(DataparserOutputs):
    """Outputs of a reader with a float64 `dataparser_transform`."""

    def transform_poses_to_original_space(
        self, poses: Tensor, camera_convention: Any = "opencv"
    ) -> Tensor:
        """As nerfstudio's, in float64."""
        given = self.dataparser_transform, self.dataparser_scale, camera_convention
        return base_dataparser.transform_poses_to_original_space(poses.double(), *given)


def with_transform(outputs: DataparserOutputs, transform: Tensor) -> DataparserOutputs:
    """The outputs with a `dataparser_transform` [3, 4] that stays float64."""
    values = {each.name: getattr(outputs, each.name) for each in fields(outputs)}
    return ExactOutputs(**values | {"dataparser_transform": transform.double()})


class ReadsNear(DataParser):
    """Stands before a reader among the bases of a class, and shifts the positions that it reads:
    every `transform_matrix` of a JSON file, every pose of a COLMAP model, and the sparse points."""

    shift: Array | None = None
    """[3] taken off the positions in the files; zeros where they are near. None before reading."""
    _meta: dict[str, Any] | None = None
    _applied: tuple[Any, float] = None, 1.0
    """As of `applied_in`, of nerfstudio's format."""

    def _generate_dataparser_outputs(
        self, split: str = "train", **kwargs: Any
    ) -> DataparserOutputs:
        read: Any = super()._generate_dataparser_outputs  # type: ignore[safe-super]
        names = {**read.__globals__, "load_from_json": lambda path: self._near(load_json(path))}
        near = FunctionType(
            read.__code__, names, read.__name__, read.__defaults__, read.__func__.__closure__
        )
        near.__kwdefaults__ = read.__kwdefaults__
        outputs: DataparserOutputs = near(self, split, **kwargs)
        if isinstance(self, Nerfstudio):
            outputs.metadata[APPLIED] = self._applied
        if self.shift is None or not self.shift.any():
            return outputs
        transform = torch.as_tensor(outputs.dataparser_transform).double()[:3].clone()
        transform[:, 3] -= transform[:, :3] @ torch.from_numpy(self._in_the_data())
        return with_transform(outputs, transform)

    def _get_all_images_and_cameras(self, *arguments: Any) -> dict[str, Any]:
        """COLMAP's poses, shifted."""
        return self._near(super()._get_all_images_and_cameras(*arguments))  # type: ignore[misc]

    def _load_3D_points(self, path: Path, *given: Any) -> dict[str, Tensor] | None:
        """Sparse points in model coordinates; {} of a model of COLMAP made without any."""
        if path.is_dir() and not _has_points(path):
            return {}
        found: dict[str, Tensor] | None = super()._load_3D_points(path, *given)  # type: ignore[misc]
        if found and self.shift is not None and self.shift.any():
            config: Any = self.config
            transform, scale = given[:2] if given else (torch.eye(3, 4), config.scale_factor)
            points = torch.from_numpy(self._points(path))
            found["points3D_xyz"] = (scale * moved(points, transform.double())).float()
        return found

    def _near(self, meta: dict[str, Any]) -> dict[str, Any]:
        """What a file says, its poses shifted by what the first file shows to be far."""
        try:
            poses = poses_in(meta["frames"])
            positions = poses[:, :3, 3]
        except (KeyError, TypeError, ValueError, IndexError):
            return meta  # no poses, or none that any reader takes
        if isinstance(self, Nerfstudio):  # else it is not the same by the folder and by the file
            self._applied = applied, _ = applied_in(meta, file_in(self.config.data).parent)
            meta = meta if applied is None else meta | {"applied_transform": applied}
        self._meta = meta
        if self.shift is None:
            origin = far_origin(positions)
            self.shift = np.zeros(3) if origin is None else origin
            if origin is not None:
                large = f"float32 would round them to {_rounding(origin):.2g}"
                near = f"They are read relative to ({_listed(self._in_the_data())})"
                say(f"coordinates are large: {large}. {near}")
        if self.shift.any():
            positions -= self.shift
            for frame, pose in zip(meta["frames"], poses.tolist()):
                frame["transform_matrix"] = pose
        return meta

    def _in_the_data(self) -> Array:
        """The shift [3] in coordinates of the data: before the `applied_transform` of a reader."""
        assert self.shift is not None
        applied = (self._meta or {}).get("applied_transform")
        if applied is None or not isinstance(self, Nerfstudio | ColmapDataParser):
            return self.shift
        return np.linalg.solve(np.array(applied, dtype=float)[:3, :3], self.shift)

    def _points(self, path: Path) -> Array:
        """Shifted sparse points [P, 3] of a .ply, or of the folder of a COLMAP model."""
        if not path.is_dir():
            import open3d  # as nerfstudio reads it, all points in the same order

            return np.asarray(open3d.io.read_point_cloud(path).points) - self.shift
        read, name = colmap_parsing_utils.read_points3D_binary, "points3D.bin"
        if not (path / name).exists():
            read, name = colmap_parsing_utils.read_points3D_text, "points3D.txt"
        points = np.array([point.xyz for point in read(path / name).values()], dtype=float)
        return points - self._in_the_data()


def _has_points(model: Path) -> bool:
    """Whether a COLMAP model may have points: their file is there, not whole and empty."""
    if (file := model / "points3D.bin").exists():
        return file.stat().st_size != COUNT_BYTES or any(file.read_bytes())
    if not (file := model / "points3D.txt").exists():
        return False
    with file.open("rb") as lines:
        return any(line.strip() and not line.startswith(b"#") for line in lines)


def near_bases(kind: type[DataParser]) -> tuple[type[DataParser], ...]:
    """Bases of a class, with `ReadsNear` before the reader that reads its poses, if it is known."""
    for owner in kind.__mro__ if not issubclass(kind, ReadsNear) else ():
        read = vars(owner).get("_generate_dataparser_outputs")
        if SEAMS & {*getattr(getattr(read, "__code__", None), "co_names", ())}:
            near = type(owner.__name__, (ReadsNear, owner), {})
            return (near,) if owner is kind else (kind, near)
    return (kind,)


def rounded_by(datamanager: Any) -> str | None:
    """A line on large coordinates that a data manager's reader has rounded; None if it has not."""
    outputs = getattr(datamanager, "train_dataparser_outputs", None)
    if outputs is None or not 0.0 < float(outputs.dataparser_scale) < np.inf:
        return None
    if torch.as_tensor(outputs.dataparser_transform).dtype == torch.float64:
        return None
    places = datamanager.train_dataset.cameras.camera_to_worlds[:, :3, 3].double().cpu()
    origin = far_origin(moved(places, inverse(parsed_frame(outputs))).numpy())
    if origin is None:
        return None
    reader = type(getattr(datamanager, "dataparser", None)).__name__
    return (
        f"the reader {reader} rounds large coordinates to {_rounding(origin):.2g}: take "
        f"({_listed(origin)}) off all poses and points of the data, or read a transforms.json by "
        "leco-photographs, which does not round"
    )


def _rounding(origin: Array) -> float:
    """The distance between neighbours in float32 at the largest of these coordinates."""
    return float(np.spacing(np.float32(np.abs(origin).max())))


def _listed(origin: Array) -> str:
    return ", ".join(f"{value:.8g}" for value in origin)
