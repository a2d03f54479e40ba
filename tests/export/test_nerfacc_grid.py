"""Claims about the exported grid: nerfacc takes it, and it keeps what the gate keeps."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path

import pytest
import torch
from ball_occupancy import CENTRE, ball

from leco_plugin.export import export, grid_buffers, reaching_levels
from leco_plugin.occupancy import Occupancy
from leco_plugin.samplers.boxes import lookup
from leco_plugin.samplers.grid import OccupancyGridEstimator
from leco_plugin.space import Space


def unbounded(**report: object) -> Occupancy:
    known = ball()
    return Occupancy(known.gate, Space("contraction", CENTRE, 0.4), known.threshold, report=report)


def walled() -> Occupancy:
    known = ball()
    walls = torch.tensor([-1e6, -1e6, 0.0, 1e6, 1e6, 2.0])
    return Occupancy(known.gate, known.space, known.threshold, walls=walls)


def test_nerfacc_loads_it_and_sees_the_same_cells(tmp_path: Path) -> None:
    nerfacc = pytest.importorskip("nerfacc")
    walled().save(tmp_path / "occupancy.safetensors")
    export(tmp_path / "occupancy.safetensors", "nerfacc-grid", tmp_path / "grid.pt", 16)
    loaded = torch.load(tmp_path / "grid.pt", weights_only=True)
    theirs = nerfacc.OccGridEstimator([0.0] * 3 + [1.0] * 3, resolution=16, levels=1)
    theirs.load_state_dict(loaded)
    assert theirs.aabbs[0].tolist() == [-1.0, 0.0, 0.0, 3.0, 4.0, 2.0]
    ours = OccupancyGridEstimator([0.0] * 3 + [1.0] * 3, 16)
    ours.load_state_dict(loaded)
    positions = torch.tensor(CENTRE) + 1.5 * torch.randn(2000, 3)
    from nerfacc.grid import _query

    density, _ = _query(positions, theirs.binaries.float(), theirs.aabbs[0])
    assert torch.equal(density > 0.5, ours.occupied(positions))


def test_no_table_of_indices_is_made_for_an_export(monkeypatch: pytest.MonkeyPatch) -> None:
    """nerfacc's takes 32 bytes a cell, all else 5."""
    from nerfacc.estimators import occ_grid

    made, mesh = [], occ_grid._meshgrid3d
    monkeypatch.setattr(
        occ_grid, "_meshgrid3d", lambda *a, **o: made.append(mesh(*a, **o)) or made[-1]
    )
    buffers = grid_buffers(walled(), 16)
    assert buffers["resolution"].tolist() == [16, 16, 16]
    assert sum(len(part.view(-1, 3)) for part in made) <= 1
    assert sum(value.untyped_storage().nbytes() for value in buffers.values()) < 5.1 * 16**3


@pytest.mark.parametrize("levels", [1, 3])
def test_a_cell_is_kept_where_any_probed_point_is(levels: int) -> None:
    occupancy = walled() if levels == 1 else unbounded()
    buffers = grid_buffers(occupancy, 6, levels)
    for level in range(levels):
        low, high = buffers["aabbs"][level].view(2, 3)
        for cell in [(0, 0, 0), (2, 3, 3), (1, 2, 5), (4, 1, 2), (5, 5, 5)]:
            corner = torch.cartesian_prod(*[torch.tensor([0.0, 0.5, 1.0])] * 3)
            probes = low + (torch.tensor(cell) + corner) / 6 * (high - low)
            values = occupancy.query(probes)
            assert buffers["binaries"][(level, *cell)] == bool(occupancy.occupied(probes).any())
            place = level * 216 + cell[0] * 36 + cell[1] * 6 + cell[2]
            assert float(buffers["occs"][place]) == pytest.approx(float(values.max()), abs=1e-4)


def test_next_to_nothing_that_the_gate_keeps_is_lost() -> None:
    occupancy = ball()
    buffers = grid_buffers(occupancy, 32)
    positions = torch.tensor(CENTRE) + 4.0 * (torch.rand(100_000, 3) - 0.5)
    kept = occupancy.occupied(positions)
    by_grid = lookup(buffers["binaries"], buffers["aabbs"][0], positions)
    assert float((kept & ~by_grid).sum() / kept.sum()) < 1e-3
    assert float(by_grid.float().mean()) < 1.5 * float(kept.float().mean())


def test_slabs_do_not_change_the_grid(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = grid_buffers(ball(), 9)
    monkeypatch.setattr("leco_plugin.export.POINTS_AT_ONCE", 1500)
    shares: list[float] = []
    monkeypatch.setattr("leco_plugin.export.bar", lambda what: nullcontext(shares.append))
    parts = grid_buffers(ball(), 9)
    assert torch.equal(whole["binaries"], parts["binaries"])
    assert len(shares) == 5 and shares[-1] == 1.0


def test_an_unbounded_scene_gets_levels_as_far_as_its_rays() -> None:
    far = unbounded(far=3.0, cameras=[[CENTRE[0] + 0.2, CENTRE[1], CENTRE[2]]])
    assert reaching_levels(far) == 4  # 0.4, 0.8, 1.6, 3.2
    farther = unbounded(far=3.0, cameras=[[CENTRE[0], CENTRE[1], CENTRE[2] - 0.3]])
    assert reaching_levels(farther) == 5  # 3.3 is beyond 3.2
    assert grid_buffers(far, 4)["binaries"].shape == (4, 4, 4, 4)
    assert reaching_levels(unbounded()) == 8
    with pytest.raises(ValueError, match="unbounded") as error:
        grid_buffers(unbounded(), 4, levels=1)
    assert "\n" not in str(error.value)


def test_boxes_of_an_unbounded_scene_reach_as_far_with_walls_as_without() -> None:
    """A wall on one side would else make them smaller, and move them to the other side."""
    free = unbounded(far=3.0, cameras=[list(CENTRE)])
    ground = torch.tensor([-1e6, -1e6, CENTRE[2], 1e6, 1e6, 1e6])
    cut = Occupancy(free.gate, free.space, free.threshold, report=free.report, walls=ground)
    assert torch.equal(grid_buffers(cut, 4)["aabbs"], grid_buffers(free, 4)["aabbs"])


@pytest.mark.parametrize(("resolution", "levels"), [(0, 1), (4, 0), (4, 65), (1024, 1)])
def test_sizes_out_of_range_are_refused(resolution: int, levels: int) -> None:
    with pytest.raises(ValueError, match="cells"):
        grid_buffers(ball(), resolution, levels)


def test_a_grid_may_have_one_cell() -> None:
    assert bool(grid_buffers(ball(), 1, 1)["binaries"].all())
