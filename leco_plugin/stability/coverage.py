"""How many training pictures show what a held-out picture shows.

What one picture shows alone has no depth that anybody could learn: whether it is kept is chance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from leco_plugin.scenes.city.cameras import Lens
from leco_plugin.stability.matter import Array

SAME_PLACE = 0.05
"""Share of the distance by which a surface in a picture may be off: pixels are wide at the size of
these pictures."""


@dataclass(frozen=True)
class View:
    """A picture that was taken, and how far away what it shows is."""

    pose: Array
    """[3, 4] camera to world, metres, OpenGL axes."""
    lens: Lens
    depth: NDArray[np.floating]
    """[h, w] metres along the rays; inf for no surface."""

    @property
    def points(self) -> Array:
        """[h, w, 3] what it shows, metres; not finite where there is no surface."""
        return self.lens.points(self.pose, self.depth)

    def shows(self, points: Array) -> NDArray[np.bool_]:
        """Which points [N, 3] lie in the picture and are hidden by nothing."""
        seen = (points - self.pose[:, 3]) @ self.pose[:, :3]
        ahead = -seen[:, 2]
        shown = ahead > 0
        ahead = np.where(shown, ahead, 1.0)
        columns = np.floor(self.lens.focal * seen[:, 0] / ahead + self.lens.width / 2)
        rows = np.floor(self.lens.height / 2 - self.lens.focal * seen[:, 1] / ahead)
        shown &= (columns >= 0) & (columns < self.lens.width)
        shown &= (rows >= 0) & (rows < self.lens.height)
        depth = np.full(len(points), np.inf)
        depth[shown] = self.depth[rows[shown].astype(int), columns[shown].astype(int)]
        distance = np.linalg.norm(seen, axis=-1)
        return shown & (np.abs(depth - distance) <= SAME_PLACE * distance)


def shown_by(view: View, others: Sequence[View]) -> NDArray[np.int32]:
    """[h, w] how many of the other pictures show what a picture shows; 0 where it shows nothing."""
    counts = np.zeros(view.depth.shape, dtype=np.int32)
    there = np.isfinite(view.depth)
    points = view.points[there]
    for other in others:
        counts[there] += other.shows(points)
    return counts
