"""Coordinates of two readers of one scene: how positions of one become positions of the other.

nerfstudio's readers turn, move and scale a scene, each in its own way; what was learned in the
coordinates of one is asked in those of another.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


def frame_of(datamanager: Any) -> list[list[float]] | None:
    """What took the scene's coordinates to the model's: [3, 4], JSON values; None is not known."""
    outputs = getattr(datamanager, "train_dataparser_outputs", None)
    if outputs is None:
        return None
    transform = torch.as_tensor(outputs.dataparser_transform).double()[:3]
    frame: list[list[float]] = (float(outputs.dataparser_scale) * transform).tolist()
    return frame


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


def box_around(box: Tensor, frame: Tensor) -> Tensor:
    """The smallest box along the axes of a frame that holds a box of the host: [6] from [6]."""
    corners = moved(torch.cartesian_prod(*box.view(2, 3).T), frame)
    return torch.cat([corners.amin(dim=0), corners.amax(dim=0)])
