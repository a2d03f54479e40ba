"""Whether matrices that should be rotations are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from leco_plugin.scenes.input_error import InputError

MOST = 0.05
"""Distance from a rotation that a pose may have."""


def distance_from_rotations(matrices: NDArray[np.floating]) -> NDArray[np.floating]:
    """How far [C, 3, 3] are from rotations: the largest error of R R^T = 1 and of det R = 1, [C].

    A mirrored rotation has 2. The matrices are finite.
    """
    errors = np.abs(matrices @ matrices.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2))
    return np.maximum(errors, np.abs(np.linalg.det(matrices) - 1.0))


def check_poses(poses: NDArray[np.floating], names: list[str]) -> None:
    """Poses [C, 3, 4] or [C, 4, 4] are finite, and their first three columns rotations.

    Args:
        names: of each pose, for errors.
    Raises:
        InputError: one line.
    """
    if poses.shape[1:] not in ((4, 4), (3, 4)):
        raise InputError(f"{names[0]} is no finite 4 x 4 matrix: give it four rows of four")
    broken = ~np.isfinite(poses).all(axis=(1, 2))
    if broken.any():
        worst = names[int(broken.argmax())]
        raise InputError(f"{worst} is no finite 4 x 4 matrix: mend it, or leave its image out")
    with np.errstate(over="ignore", invalid="ignore"):
        distances = np.nan_to_num(distance_from_rotations(poses[:, :3, :3]), nan=np.inf)
    if distances.max() > MOST:
        worst = names[int(distances.argmax())]
        raise InputError(
            f"{worst} is no rotation: remove its scale, shear or mirroring, or leave its image out"
        )
