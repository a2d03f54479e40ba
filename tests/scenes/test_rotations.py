"""Rotations are told from what is nearly one."""

import numpy as np

from leco_plugin.scenes.frames import distance_from_rotations


def test_rotations_are_at_no_distance_and_others_at_theirs() -> None:
    random = np.random.default_rng(0)
    rotation = np.linalg.qr(random.normal(size=(3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    cases = np.stack([rotation, -rotation, 1.1 * rotation, rotation @ np.diag([2, 0.5, 1])])
    distances = distance_from_rotations(cases)
    assert distances[0] < 1e-12
    np.testing.assert_allclose(distances[1:3], [2.0, 1.1**3 - 1], atol=1e-9)
    assert distances[3] > 0.5
