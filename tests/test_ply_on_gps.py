"""What says how far an exported file is off sees a file that is."""

from __future__ import annotations

import numpy as np
import ply_on_gps


def test_a_file_that_is_moved_up_or_turned_is_found_out() -> None:
    rng = np.random.default_rng(0)
    sparse = rng.uniform(-100.0, 100.0, (4000, 3)) * [1.0, 1.0, 0.0]
    sparse[:, 2] = 0.3 * sparse[:, 0] + rng.normal(size=4000)
    points = rng.uniform(-90.0, 90.0, (500, 3))
    points[:, 2] = 0.3 * points[:, 0]
    assert np.abs(ply_on_gps.heights(points, sparse)).max() < 4.0
    raised = ply_on_gps.heights(points + np.array([0.0, 0.0, 20.0]), sparse)
    assert np.median(raised) > 19.0
    turned = ply_on_gps.heights(points * [-1.0, -1.0, 1.0], sparse)
    assert np.median(np.abs(turned)) > 10.0
    assert len(ply_on_gps.heights(points + 500.0, sparse)) == 0
