"""Whether matrices that should be rotations are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def distance_from_rotations(matrices: NDArray[np.floating]) -> NDArray[np.floating]:
    """How far [C, 3, 3] are from rotations: the largest error of R R^T = 1 and of det R = 1, [C].

    A mirrored rotation has 2. The matrices are finite.
    """
    errors = np.abs(matrices @ matrices.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2))
    return np.maximum(errors, np.abs(np.linalg.det(matrices) - 1.0))
