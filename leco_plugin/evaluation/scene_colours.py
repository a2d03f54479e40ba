"""Colours of a scene's photographs at places in the coordinates of a run."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from leco_plugin.evaluation.inspection import to_the_data
from leco_plugin.occupancy import Occupancy
from leco_plugin.scenes.coloured_points import ColouredPoints, coloured_points, colours_near
from leco_plugin.scenes.frames import moved


class SceneColours(NamedTuple):
    """The scene's sparse points, and how the run lies in their coordinates."""

    points: ColouredPoints
    back: Tensor
    """[3, 4] float64, from the run to the data."""

    def at(self, positions: Tensor) -> NDArray[np.uint8]:
        """Colours [N, 3] of the sparse points nearest to positions [N, 3] of the run."""
        return colours_near(self.points, moved(positions.double(), self.back).numpy())


def scene_colours(occupancy: Occupancy, description: Path | None) -> SceneColours | None:
    """Colours for an occupancy of a scene; None where points, colours or coordinates are not known.

    Args:
        description: the scene's transforms.json.
    Raises:
        InputError: the file of the points cannot be read.
    """
    points = None if description is None else coloured_points(description)
    back = to_the_data(occupancy)
    return None if points is None or back is None else SceneColours(points, back)
