"""The lens agrees with nerfstudio's cameras, and depth files lead back to the same points."""

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras

from leco_plugin.scenes.city.cameras import look_at
from leco_plugin.scenes.city.lens import Lens

LENS = Lens(40, 30, 33.0)


def test_rays_are_those_of_nerfstudio() -> None:
    pose = look_at(np.array([3.0, -2.0, 8.0]), np.array([0.5, 1.0, 0.0]))
    camera = Cameras(torch.tensor(pose[None]).float(), 33.0, 33.0, 20.0, 15.0, 40, 30)
    rays = camera.generate_rays(camera_indices=0)
    ours = LENS.directions() @ pose[:, :3].T
    np.testing.assert_allclose(ours, rays.directions.numpy(), atol=1e-5)


def test_axial_depth_leads_back_to_depth_along_the_ray() -> None:
    depth = np.random.default_rng(0).uniform(1, 100, (30, 40))
    depth[3, 4] = np.inf
    axial = LENS.axial(depth)
    assert axial[3, 4] == 0
    np.testing.assert_allclose(LENS.along_ray(axial), depth, rtol=1e-6)


def test_a_wall_square_to_the_view_has_one_axial_depth() -> None:
    depth = 7.0 / -LENS.directions()[..., 2]
    np.testing.assert_allclose(LENS.axial(depth), 7000.0, rtol=1e-6)
