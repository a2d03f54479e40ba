"""Coordinates of two readers of one scene: how positions of one become positions of the other.

nerfstudio's readers turn, move and scale a scene, each in its own way; what was learned in the
coordinates of one is asked in those of another.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor


def frame_of(datamanager: Any) -> list[list[float]] | None:
    """What took the scene's coordinates to the model's: [3, 4], JSON values; None is not known.

    The scene's are those of its reconstruction, before any `applied_transform` of its file, so that
    all readers of it mean the same.
    """
    outputs = getattr(datamanager, "train_dataparser_outputs", None)
    if outputs is None:
        return None
    frame: list[list[float]] = parsed_frame(outputs).tolist()
    return frame


def data_frame_of(datamanager: Any) -> list[list[float]] | None:
    """What took positions as the data's own files have them to the model's: [3, 4], JSON values.

    It differs from `frame_of` where a transforms.json has an `applied_transform`.
    """
    frame = frame_of(datamanager)
    if frame is None:
        return None
    metadata = getattr(datamanager.train_dataparser_outputs, "metadata", None) or {}
    applied, scale = metadata.get(APPLIED, (None, 1.0))
    try:
        of_file: list[list[float]] = from_file(frame, applied, scale, torch.float64).tolist()
    except (ValueError, TypeError, RuntimeError):  # it leads nowhere back
        return None
    return of_file


def parsed_frame(outputs: Any) -> Tensor:
    """What a dataparser says that it did to the scene's coordinates: [3, 4] float64."""
    transform = torch.as_tensor(outputs.dataparser_transform).double()[:3]
    return float(outputs.dataparser_scale) * transform


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
    """Takes positions of the host to those of the other: [3, 4] float32.

    Args:
        host, other: [3, 4] each, from one scene's coordinates, as of `frame_of`.
    Returns:
        The identity, exactly, where the two agree to a millionth.
    """
    a, b = (torch.tensor(frame, dtype=torch.float64) for frame in (host, other))
    turn = b[:, :3] @ torch.linalg.inv(a[:, :3])
    frame = torch.cat([turn, (b[:, 3] - turn @ a[:, 3])[:, None]], dim=1).float()
    same = torch.eye(3, 4)
    return same if torch.allclose(frame, same, atol=1e-6) else frame


def inverse(frame: Tensor) -> Tensor:
    """The frame [3, 4] that takes positions back."""
    turn = torch.linalg.inv(frame[:, :3].double())
    return torch.cat([turn, -turn @ frame[:, 3:].double()], dim=1).to(frame)


def turned(directions: Tensor, frame: Tensor) -> Tensor:
    """Directions [N, 3] by turn and scale of a frame [3, 4], in whatever precision a host is."""
    with torch.autocast(directions.device.type, enabled=False):
        return directions @ frame[:, :3].T


def moved(positions: Tensor, frame: Tensor) -> Tensor:
    """Positions [N, 3] taken to another frame [3, 4]."""
    return turned(positions, frame) + frame[:, 3]


def found_again(known: Tensor, here: Tensor, half_extent: float) -> Tensor:
    """Which of the cameras at places [K, 3] are among those at others [C, 3], one frame: bool [K].

    Args:
        half_extent: of the scene.
    """
    return torch.cdist(known.float(), here.float()).amin(dim=1) <= SAME_PLACE * half_extent


def box_around(box: Tensor, frame: Tensor) -> Tensor:
    """The smallest box along the axes of a frame that holds a box of the host: [6] from [6]."""
    corners = moved(torch.cartesian_prod(*box.view(2, 3).T), frame)
    return torch.cat([corners.amin(dim=0), corners.amax(dim=0)])
