"""The coordinates of a scene: frames of its readers, lengths and altitudes, poses, what is up.

nerfstudio's readers turn, move and scale a scene, each in its own way. What a reader says it did
leads to the coordinates of another, and back to the units of the data.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.cameras.camera_utils import rotation_matrix_between
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from numpy.typing import NDArray
from torch import Tensor

from leco_plugin.on_cpu import in_float64
from leco_plugin.scenes.bounds import FEWEST_POINTS
from leco_plugin.scenes.input_error import InputError


def frame_of(datamanager: Any) -> list[list[float]] | None:
    """What took the scene's coordinates, before any `applied_transform`, to the model's: [3, 4]."""
    outputs = getattr(datamanager, "train_dataparser_outputs", None)
    return None if outputs is None else parsed_frame(outputs).tolist()


def data_frame_of(datamanager: Any) -> list[list[float]] | None:
    """The same from positions in the data's own files, after any `applied_transform`."""
    frame = frame_of(datamanager)
    if frame is None:
        return None
    metadata = getattr(datamanager.train_dataparser_outputs, "metadata", None) or {}
    applied, scale = metadata.get(APPLIED, (None, 1.0))
    try:
        return from_file(frame, applied, scale, torch.float64).tolist()
    except (ValueError, TypeError, RuntimeError):  # it leads nowhere back
        return None


def parsed_frame(outputs: Any) -> Tensor:
    """What a dataparser says that it did to the scene's coordinates: [3, 4] float64."""
    transform = torch.as_tensor(outputs.dataparser_transform).double()[:3]
    return float(outputs.dataparser_scale) * transform


POINTS = "points3D_xyz"
"""Key of a dataset's metadata, nerfstudio's own: sparse points [P, 3] in model coordinates."""
APPLIED = "leco_applied"
"""Key of a dataparser's metadata: `applied_transform`, or None, and `applied_scale` of its file."""
APPLIED_EARLIER = [[0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0]]
"""What ns-process-data did to COLMAP's coordinates before files said so, as nerfstudio takes it."""
FLAT = 1e-6
"""Volume, of that of a cube with the longest side, below which a transform leads nowhere back."""
SAME_PLACE = 1e-3
"""Of the half extent: two cameras that are no further apart are one."""


def applied_in(meta: dict[str, Any], folder: Path) -> tuple[Any, float]:
    """What was done to the scene's coordinates before a transforms.json was written.

    Args:
        meta: what the file says.
        folder: that it lies in.
    Returns:
        `applied_transform` [3, 4], or None, and `applied_scale`.
    """
    applied = meta.get("applied_transform")
    if applied is None and (folder / "colmap/sparse/0").exists():
        applied = APPLIED_EARLIER
    return applied, float(meta.get("applied_scale", 1.0))


def from_file(
    frame: list[list[float]] | Tensor,
    applied_transform: list[list[float]] | None,
    applied_scale: float = 1.0,
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    """The frame for positions as a transforms.json has them: [3, 4].

    What ns-process-data has done to poses and points before it wrote them, a frame does too.

    Args:
        frame: [3, 4] from the scene's coordinates, as of `frame_of`.
        applied_transform, applied_scale: of that file, as of `applied_in`.
        dtype: of the frame. Coordinates as large as UTM's need float64.
    Raises:
        ValueError: they are not finite, or lead nowhere back.
    """
    frame = torch.as_tensor(frame, dtype=torch.float64)
    applied = torch.eye(3, 4) if applied_transform is None else applied_transform
    matrix = torch.as_tensor(applied, dtype=torch.float64)
    if matrix.shape not in ((3, 4), (4, 4)) or not bool(matrix.isfinite().all()):
        raise ValueError("the applied_transform is no finite [3, 4] matrix")
    longest = float(matrix[:3, :3].norm(dim=0).max())
    if not abs(float(matrix[:3, :3].det())) > FLAT * longest**3:
        raise ValueError("the applied_transform is flat, and cannot be undone")
    if not 0.0 < applied_scale < torch.inf:
        raise ValueError(f"the applied_scale is {applied_scale}, not a positive number")
    back = inverse(matrix[:3])
    shift = frame[:, :3] @ back[:, 3:] + frame[:, 3:]
    return (torch.cat([frame[:, :3] @ back[:, :3], shift], dim=1) / applied_scale).to(dtype)


def between(host: list[list[float]], other: list[list[float]]) -> Tensor:
    """Takes positions of the host to those of the other: [3, 4] float32, of two frames [3, 4] from
    one scene's coordinates; exactly the identity where they agree to a millionth."""
    a, b = (torch.tensor(frame, dtype=torch.float64) for frame in (host, other))
    turn = b[:, :3] @ torch.linalg.inv(a[:, :3])
    frame = torch.cat([turn, (b[:, 3] - turn @ a[:, 3])[:, None]], dim=1).float()
    same = torch.eye(3, 4)
    return same if torch.allclose(frame, same, atol=1e-6) else frame


def inverse(frame: Tensor) -> Tensor:
    """The frame [3, 4] that takes positions back."""
    exact = in_float64(frame)
    turn = torch.linalg.inv(exact[:, :3])
    return torch.cat([turn, -turn @ exact[:, 3:]], dim=1).to(frame)


def turned(directions: Tensor, frame: Tensor) -> Tensor:
    """Directions [N, 3] by turn and scale of a frame [3, 4], in whatever precision a host is."""
    with torch.autocast(directions.device.type, enabled=False):
        return directions @ frame[:, :3].T


def moved(positions: Tensor, frame: Tensor) -> Tensor:
    """Positions [N, 3] taken to another frame [3, 4]."""
    return turned(positions, frame) + frame[:, 3]


def found_again(known: Tensor, here: Tensor, half_extent: float) -> Tensor:
    """Which cameras at places [K, 3] are among those at others [C, 3], of one frame: bool [K]."""
    return torch.cdist(known.float(), here.float()).amin(dim=1) <= SAME_PLACE * half_extent


def box_around(box: Tensor, frame: Tensor) -> Tensor:
    """The smallest box along the axes of a frame that holds a box of the host: [6] from [6]."""
    corners = moved(torch.cartesian_prod(*box.view(2, 3).T), frame)
    return torch.cat([corners.amin(dim=0), corners.amax(dim=0)])


METRES_PER_UNIT, ALTITUDES = "leco_metres_per_unit", "leco_altitudes"
"""Keys of a dataparser's metadata: metres in a unit of the dataset's own poses, float; and z of the
ground and of the top, scene units, two floats."""
UP_IS_KNOWN = "leco_up_is_known"
"""Key that is there where z is up in the dataset already."""
UPRIGHT = 0.94
"""Cosine of 20 degrees: an axis of the dataset that is nearer to the model's z is up there, and
what is nearer to z in a survey may be the slope of a hill."""


@dataclass(frozen=True)
class DatasetUnits:
    """What a scene unit and the scene's z = 0 are in the dataset's own coordinates."""

    per_scene_unit: float
    """Metres, or units of the dataset's poses, in a scene unit."""
    zero: float
    """Altitude of the scene's origin in the same units: along the dataset's own axis where one is
    up (in UTM a hundredth of a degree is a kilometre), else along the model's z."""
    metric: bool
    """Whether these units are metres."""

    def altitude(self, z: float) -> float:
        """Altitude of a scene coordinate z."""
        return self.per_scene_unit * z + self.zero

    @property
    def name(self) -> str:
        return "metres" if self.metric else "data units"


def units_of(datamanager: Any, metres_per_unit: float | None = None) -> DatasetUnits | None:
    """The units of a dataset, or None where its dataparser does not say what it did.
    `metres_per_unit` goes before what that knows; InputError if it is not positive."""
    outputs = getattr(datamanager, "train_dataparser_outputs", None)
    scale = float(getattr(outputs, "dataparser_scale", 0.0))
    if outputs is None or not 0.0 < scale < math.inf:
        return None
    metadata = outputs.metadata or {}
    _, applied_scale = metadata.get(APPLIED, (None, 1.0))  # a part of the scale, and of the poses
    known = metadata.get(METRES_PER_UNIT) if metres_per_unit is None else metres_per_unit
    if known is not None and not 0.0 < float(known) < math.inf:
        raise InputError(f"a unit of the dataset is a positive number of metres, not {known}")
    metres = 1.0 if known is None else float(known)
    frame = parsed_frame(outputs)
    up = frame[2, :3] / scale
    near = up.abs().argmax()
    if float(up[near].abs()) > UPRIGHT:
        up = torch.zeros_like(up).index_fill_(0, near, up[near].sign())
    zero = metres * float(up @ inverse(frame)[:, 3])
    return DatasetUnits(metres * applied_scale / scale, zero, known is not None)


SKEW = 0.05
"""Distance from a rotation that a pose may have."""


def distance_from_rotations(matrices: NDArray[np.floating]) -> NDArray[np.floating]:
    """The largest errors of R R^T = 1 and det R = 1 of finite [C, 3, 3]: [C]; 2 if mirrored."""
    errors = np.abs(matrices @ matrices.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2))
    return np.maximum(errors, np.abs(np.linalg.det(matrices) - 1.0))


def check_poses(poses: NDArray[np.floating], names: list[str]) -> None:
    """InputError, with its name, for a pose [C, 3 or 4, 4] that is not finite or no rotation."""
    if poses.shape[1:] not in ((4, 4), (3, 4)):
        raise InputError(f"{names[0]} is no finite 4 x 4 matrix: give it four rows of four")
    broken = ~np.isfinite(poses).all(axis=(1, 2))
    if broken.any():
        worst = names[int(broken.argmax())]
        raise InputError(f"{worst} is no finite 4 x 4 matrix: mend it, or leave its image out")
    transposed = poses[:, 3:, :3].any(axis=(1, 2))
    if transposed.any():
        worst = names[int(transposed.argmax())]
        remedy = "transpose it where it is listed by columns: the last row is 0, 0, 0, 1"
        raise InputError(f"{worst} has its place in the last row: {remedy}")
    with np.errstate(over="ignore", invalid="ignore"):
        distances = np.nan_to_num(distance_from_rotations(poses[:, :3, :3]), nan=np.inf)
    if distances.max() > SKEW:
        worst = names[int(distances.argmax())]
        remedy = "remove its scale, shear or mirroring, or leave its image out"
        raise InputError(f"{worst} is no rotation: {remedy}")


def check_no_contradiction(poses: NDArray[np.floating], names: list[str]) -> None:
    """InputError for a name of two finite poses [C, 3 or 4, 4] that differ beyond rounding."""
    first: dict[str, int] = {}
    for number, name in enumerate(names):
        before = first.setdefault(name, number)
        if before != number and not np.allclose(poses[number], poses[before], rtol=1e-9, atol=1e-6):
            raise InputError(f"{name} is given twice, and differs: remove one of these frames")


# Structure from motion does not know what is down, and nerfstudio takes the photographs' top edges
# for up: of cameras that look straight down these are level, and point in any direction.

FEWEST_CAMERAS = 4
DOWN, MOSTLY = -0.3, 0.9
"""Height of a unit vector that goes down, and the share of cameras of a survey that look so."""
ABOVE = 0.75
"""Share of a survey's cameras that are above nearly all points."""
LAYER = 0.35
"""Thickness of the ground, and of the layer in which cameras fly, of its lesser width."""
TURNED, LEVEL = 0.3, 0.15
"""Cosines (root mean square) of the cameras' right axes with the second direction in which they
point, if they are turned at all, and with the vertical, if they are level."""
ONE_HEADING = 0.7
"""Length of the mean of the cameras' top axes: with more, all are held alike."""
WIDE = 0.3
"""Least spread of cameras over a survey, as a share of their height: cameras of somebody who stands
before a wall, and holds all photographs alike, are closer together."""


def turn_to_upright(poses: Tensor, points: Tensor | None) -> Tensor | None:
    """The rotation [3, 3] that sets a survey from the air upright; None if it is, or is no survey.
    Up is away from a flat ground, at a right angle to the cameras' level right axes, or across the
    layer in which they fly. Poses are [C, 3, 4] OpenGL's, points [P, 3] or None."""
    poses = poses.detach().double().cpu()
    looks, places = -poses[:, :, 2], poses[:, :, 3]
    if len(poses) < FEWEST_CAMERAS:
        return None
    if points is not None:
        points = _without_strays(points.detach().double().cpu())
    ground = None if points is None else _normal_of_layer(points)
    known = (ground, _vertical_of(poses[:, :, 0]), _normal_of_layer(places))
    axes = [each for each in known if each is not None]
    ups = [-axis if float((looks @ axis).mean()) > 0.0 else axis for axis in axes]
    ups = [up for up in ups if float((looks @ up < DOWN).double().mean()) >= MOSTLY]
    ups = [up for up in ups if _fly_over(poses, points, up)]
    if not ups or any(float(up[2]) > UPRIGHT for up in ups):
        return None
    return rotation_matrix_between(ups[0].float(), torch.tensor([0.0, 0.0, 1.0]))


def turn_outputs(outputs: DataparserOutputs, turn: Tensor) -> DataparserOutputs:
    """What a dataparser says of a scene, turned: cameras, sparse points, and the way back."""
    poses, transform = outputs.cameras.camera_to_worlds, outputs.dataparser_transform[:3]
    outputs.cameras.camera_to_worlds = turn.to(poses) @ poses
    outputs.dataparser_transform = turn.to(transform) @ transform
    if outputs.metadata.get(POINTS) is not None:
        points = torch.as_tensor(outputs.metadata[POINTS])
        outputs.metadata[POINTS] = points @ turn.to(points).T
    return outputs


def _fly_over(poses: Tensor, points: Tensor | None, up: Tensor) -> bool:
    """Whether cameras are above the points, and those that are held alike far from one another."""
    alike = float(poses[:, :, 1].mean(dim=0).norm()) > ONE_HEADING
    if points is None:
        return not alike
    heights, ground = poses[:, :, 3] @ up, points @ up
    above = float((heights > ground.quantile(0.95)).double().mean()) >= ABOVE
    clearance = float(heights.median() - ground.median())
    spread = float(_spreads(poses[:, :, 3])[0][1])
    return above and (not alike or spread >= WIDE * clearance)


def _without_strays(points: Tensor) -> Tensor | None:
    """The nine tenths of points [P, 3] that are nearest to their middle; None of too few."""
    points = points[points.isfinite().all(dim=-1)]
    points = points[:: max(1, len(points) // 100_000)]
    if len(points) < FEWEST_POINTS:
        return None
    distances = (points - points.median(dim=0).values).norm(dim=-1)
    return points[distances <= distances.quantile(0.9)]


def _spreads(places: Tensor) -> tuple[Tensor, Tensor]:
    """Standard deviations [3] of places [N, 3], least first; their principal axes as columns."""
    values, axes = torch.linalg.eigh(torch.cov(places.T))
    return values.clamp(min=0.0).sqrt(), axes


def _normal_of_layer(places: Tensor) -> Tensor | None:
    """The direction [3] across places [N, 3] that lie in a flat layer."""
    spreads, axes = _spreads(places)
    return axes[:, 0] if bool(spreads[0] < LAYER * spreads[1]) else None


def _vertical_of(rights: Tensor) -> Tensor | None:
    """The direction [3] to which the cameras' right axes [C, 3] are level, if they turn enough."""
    _, lengths, directions = torch.linalg.svd(rights, full_matrices=False)
    cosines = lengths / len(rights) ** 0.5
    return directions[2] if bool((cosines[1] > TURNED) & (cosines[2] < LEVEL)) else None
