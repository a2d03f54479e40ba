"""A grid over a scene's bounds."""

from __future__ import annotations

import torch

from leco_plugin.models.switch_nerf import scene_grid
from leco_plugin.space import Space


def test_the_grid_ends_at_the_walls_of_a_slab() -> None:
    space = Space("box", (1.0, 0.0, 0.0), 2.0)
    grid = scene_grid(space, torch.tensor([-1e6, -1e6, -0.5, 1e6, 1e6, 0.25]), 8, 1)
    assert grid.aabbs.tolist() == [[-1.0, -2.0, -0.5, 3.0, 2.0, 0.25]]
    assert grid.binaries.shape == (1, 8, 8, 8)


def test_levels_reach_beyond_the_uncontracted_cube() -> None:
    space = Space("contraction", half_extent=0.5)
    grid = scene_grid(space, torch.tensor([-1e6] * 3 + [1e6] * 3), 4, 3)
    assert grid.aabbs[:, 3].tolist() == [0.5, 1.0, 2.0]
