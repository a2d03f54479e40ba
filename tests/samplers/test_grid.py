"""The baselines: the occupancy grid's lookup and update against their definitions."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from samplers.analytic_occupancy import Balls, camera_rays

from leco_plugin.samplers.grid import DenseEstimator, OccupancyGridEstimator, lookup

BOX = [-0.5, -0.4, -0.3, 0.7, 0.8, 0.5]


def slow_lookup(binaries, boxes, position):
    """The innermost box that holds a position, then the cell by truncation."""
    for level, box in enumerate(boxes):
        low, high = box[:3], box[3:]
        if bool(((position >= low) & (position <= high)).all()):
            shape = torch.tensor(binaries.shape[1:])
            cell = ((position - low) / (high - low) * shape).long().minimum(shape - 1)
            return bool(binaries[level, cell[0], cell[1], cell[2]])
    return False


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 2**16), levels=st.integers(1, 4))
def test_a_position_is_looked_up_in_the_innermost_box_that_holds_it(seed, levels):
    torch.manual_seed(seed)
    grid = OccupancyGridEstimator(BOX, resolution=[4, 5, 6], levels=levels)
    grid.binaries.copy_(torch.rand(levels, 4, 5, 6) < 0.5)
    positions = torch.randn(60, 3) * 2.0
    expected = [slow_lookup(grid.binaries, grid.aabbs, position) for position in positions]
    assert grid.occupied(positions).tolist() == expected


def test_positions_on_faces_or_nowhere_are_answered():
    binaries = torch.ones(1, 2, 2, 2, dtype=torch.bool)
    box = torch.tensor([0.0, 0.0, 0.0, 1.0, 1.0, 1.0])
    positions = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [torch.nan] * 3, [torch.inf] * 3])
    assert lookup(binaries, box, positions).tolist() == [True, True, False, False]


def test_levels_are_nested_boxes_of_twice_the_size():
    grid = OccupancyGridEstimator(BOX, resolution=4, levels=3)
    low, high = grid.aabbs[:, :3], grid.aabbs[:, 3:]
    torch.testing.assert_close((low + high)[1:], (low + high)[:-1])
    torch.testing.assert_close((high - low)[1:], (high - low)[:-1] * 2.0)
    assert grid.bounds().equal(grid.aabbs[-1])


def test_an_update_keeps_the_larger_of_faded_and_new_and_thresholds_at_the_mean():
    grid = OccupancyGridEstimator(BOX, resolution=8).train()
    grid.occs.fill_(0.5)
    left = grid.aabbs[0, :3] + torch.tensor([0.6, 0.0, 0.0])
    grid.update_every_n_steps(0, lambda x: (x[:, :1] < left[0]) * 0.9, occ_thre=10.0)
    occs = grid.occs.view(8, 8, 8)
    torch.testing.assert_close(occs[:4], torch.full((4, 8, 8), 0.9))
    torch.testing.assert_close(occs[4:], torch.full((4, 8, 8), 0.5 * 0.95))
    assert grid.binaries[0, :4].all()
    assert not grid.binaries[0, 4:].any()
    grid.update_every_n_steps(16, lambda x: x[:, 0] * 0.0, occ_thre=1e-2)
    assert grid.binaries.all()  # the threshold is the lesser of occ_thre and the mean


def test_after_warm_up_a_share_of_the_cells_is_asked_every_n_steps():
    grid = OccupancyGridEstimator(BOX, resolution=8, levels=2).train()
    asked = []

    def occ_eval_fn(positions):
        asked.append(len(positions))
        return torch.zeros(len(positions), 1)

    grid.update_every_n_steps(7, occ_eval_fn)
    assert not asked
    grid.update_every_n_steps(16, occ_eval_fn)
    assert asked == [512, 512]
    grid.update_every_n_steps(256, occ_eval_fn)
    assert asked[2:] == [128, 128]
    with pytest.raises(RuntimeError, match="in training only"):
        grid.eval().update_every_n_steps(0, occ_eval_fn)


def test_a_filled_grid_finds_the_scene():
    balls = Balls()
    grid = OccupancyGridEstimator([-1.0] * 3 + [1.0] * 3, resolution=48).train()
    for step in range(0, 128, 16):
        grid.update_every_n_steps(step, balls.query)
    origins, directions = camera_rays(300)
    sampled = grid.sampling(origins, directions, render_step_size=0.02)
    dense = DenseEstimator(grid.aabbs[0]).sampling(origins, directions, render_step_size=0.02)
    positions = origins[dense[0]] + directions[dense[0]] * ((dense[1] + dense[2]) / 2)[:, None]
    core = balls.query(positions) > 0.5
    kept = set(zip(sampled[0].tolist(), sampled[1].tolist(), strict=True))
    wanted = set(zip(dense[0][core].tolist(), dense[1][core].tolist(), strict=True))
    assert len(wanted & kept) > 0.995 * len(wanted)
    assert len(kept) < 0.4 * len(dense[0])


def test_impossible_grids_are_refused():
    with pytest.raises(ValueError, match="positive sizes"):
        OccupancyGridEstimator(BOX, resolution=0)
    with pytest.raises(ValueError, match="positive sizes"):
        OccupancyGridEstimator(BOX, levels=0)


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 2**16), levels=st.integers(1, 3))
def test_the_value_at_a_position_is_that_of_the_cell_that_answers(seed, levels):
    torch.manual_seed(seed)
    grid = OccupancyGridEstimator(BOX, resolution=[4, 5, 6], levels=levels)
    grid.occs.copy_(torch.rand(levels * 120))
    grid.binaries.copy_(grid.occs.view_as(grid.binaries) > 0.5)
    positions = torch.randn(60, 3) * 2.0
    assert torch.equal(grid.values(positions) > 0.5, grid.occupied(positions))
