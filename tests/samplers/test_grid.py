"""The baselines: the occupancy grid's lookup and update against their definitions."""

from __future__ import annotations

import nerfacc
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from samplers.analytic_occupancy import Balls, camera_rays

from leco_plugin.samplers import grid as module
from leco_plugin.samplers.base import DenseEstimator
from leco_plugin.samplers.boxes import lookup
from leco_plugin.samplers.grid import OccupancyGridEstimator

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


@pytest.mark.parametrize("shape", [(-1,), (-1, 1)])
def test_updates_are_nerfaccs_in_parts_that_fit_memory(shape, monkeypatch):
    monkeypatch.setattr(module, "CELLS_AT_ONCE", 100)
    ours = OccupancyGridEstimator(BOX, resolution=8, levels=2).train()
    theirs = nerfacc.OccGridEstimator(BOX, resolution=8, levels=2).train()
    assert ours.state_dict().keys() == theirs.state_dict().keys()
    asked = []

    def occ_eval_fn(positions):
        asked.append(len(positions))
        return (positions * 7.0).sin().abs().sum(dim=-1).view(shape) * 0.01

    for grid, field in ((ours, occ_eval_fn), (theirs, lambda x: occ_eval_fn(x).view(-1, 1))):
        torch.manual_seed(0)
        asked.clear()
        for step in (0, 7, 16, 256, 272):
            grid.update_every_n_steps(step, field)
        assert (max(asked) <= 100) == (grid is ours)
    assert all(map(torch.equal, ours.state_dict().values(), theirs.state_dict().values()))
    assert 0 < int(ours.binaries.sum()) < ours.binaries.numel()
    with pytest.raises(RuntimeError, match="only during training"):
        ours.eval().update_every_n_steps(0, occ_eval_fn)


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
