"""Claims about the points that are exported: on the surface, coloured, read by others."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from ball_occupancy import CENTRE, HALF, RADIUS, ball

from leco_plugin.export import kept_surface, write_ply
from leco_plugin.occupancy import Occupancy
from leco_plugin.space import Space


def test_points_lie_on_the_ball() -> None:
    surface = kept_surface(ball(), 64)
    distances = (surface.positions - torch.tensor(CENTRE)).norm(dim=-1)
    cell = 2 * HALF / 64
    assert len(surface.positions) > 1000
    # within a cell's diagonal of the kept set's end, which is itself some hundredths off the ball
    assert float((distances - RADIUS).abs().quantile(0.95)) < 3**0.5 * cell + 0.1
    assert bool(ball().occupied(surface.positions).all())
    assert torch.equal(surface.values, ball().query(surface.positions))


def test_other_programs_read_places_and_colours(tmp_path: Path) -> None:
    surface = kept_surface(ball(), 24)
    write_ply(surface, tmp_path / "new" / "kept.ply")
    assert (tmp_path / "new" / "kept.ply").read_bytes()[:40].startswith(b"ply\nformat binary")
    cloud = trimesh.load(tmp_path / "new" / "kept.ply")
    assert np.allclose(cloud.vertices, surface.positions.numpy(), atol=1e-5)
    brightness = cloud.colors[:, :3].sum(axis=1).astype(float)
    assert np.corrcoef(brightness, surface.values.numpy())[0, 1] > 0.9
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["kept.ply"]


def test_an_unbounded_scene_has_points_beyond_its_inner_cube() -> None:
    known = ball()
    # half the mapped cube is uncontracted, and the ball just fills that half
    far = Occupancy(known.gate, Space("contraction", CENTRE, 0.2), 0.02)
    surface = kept_surface(far, 32)
    assert bool(surface.positions.isfinite().all())
    assert float((surface.positions - torch.tensor(CENTRE)).abs().max()) > 0.2


def test_an_occupancy_that_keeps_nothing_is_refused_in_one_line() -> None:
    nothing = Occupancy(ball().gate, Space("box", (50.0, 0.0, 0.0), 1.0), 1.0)
    with pytest.raises(ValueError, match="keeps nothing") as error:
        kept_surface(nothing, 8)
    assert "\n" not in str(error.value)
    with pytest.raises(ValueError, match="at least 2 cells"):
        kept_surface(ball(), 1)


def test_slabs_do_not_change_the_surface(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = kept_surface(ball(), 20)
    monkeypatch.setattr("leco_plugin.export.CELLS_AT_ONCE", 1000)
    parts = kept_surface(ball(), 20)
    assert torch.equal(whole.positions, parts.positions)
    assert torch.equal(whole.values, parts.values)


@pytest.mark.parametrize("resolution", [2000, 10**30])
def test_more_cells_than_memory_holds_are_refused_before_the_gate_is_asked(
    resolution: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("leco_plugin.export.query", None)
    with pytest.raises(ValueError, match=f"^{resolution} along .* too many .* smaller --resol"):
        kept_surface(ball(), resolution)
