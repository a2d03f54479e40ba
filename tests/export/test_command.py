"""Points are exported in the coordinates of the data, exact also where those are large."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from ball_occupancy import CENTRE, RADIUS, ball

from leco_plugin.export import export
from leco_plugin.occupancy import Occupancy

UTM = np.array([500_000.25, 5_200_000.5, 300.0])
SCALE = 0.02
TURN = np.array([[0.6, 0.8, 0.0], [-0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])
FRAME = SCALE * np.column_stack([TURN, -TURN @ UTM])
MIDDLE = (np.array(CENTRE) / SCALE) @ TURN + UTM
"""Of the ball, in the data."""


def saved(folder: Path, **report: Any) -> Path:
    known = ball()
    made = Occupancy(known.gate, known.space, known.threshold, report=known.report | report)
    made.save(folder / "occupancy.safetensors")
    return folder / "occupancy.safetensors"


def exported(folder: Path, *frame: Any, **report: Any) -> tuple[dict[str, Any], np.ndarray]:
    """What `export` returns, and the points that another program reads in its file."""
    out = folder / "kept.ply"
    facts = export(saved(folder, **report), "ply", out, 24, None, *frame)
    return facts, np.asarray(trimesh.load(out).vertices)


def test_points_lie_in_the_data_by_default(tmp_path: Path) -> None:
    of_run = exported(tmp_path, "run", frame=FRAME.tolist())[1]
    facts, points = exported(tmp_path, frame=FRAME.tolist())
    assert facts["frame"] == "data" and facts["points"] == len(points) > 100
    expected = (of_run / SCALE) @ TURN + UTM
    np.testing.assert_allclose(points, expected, atol=1e-4, rtol=0)
    distances = np.linalg.norm(points - MIDDLE, axis=1) * SCALE
    assert np.median(distances) == pytest.approx(RADIUS, abs=0.3)


def test_the_frame_of_the_datas_own_files_goes_before_that_of_the_reconstruction(
    tmp_path: Path,
) -> None:
    """They differ by the applied_transform of a transforms.json."""
    facts, points = exported(tmp_path, frame=np.eye(3, 4).tolist(), data_frame=FRAME.tolist())
    assert facts["frame"] == "data"
    assert np.linalg.norm(points - MIDDLE, axis=1).max() < 2 * RADIUS / SCALE


@pytest.mark.parametrize("unknown", [None, "elsewhere", [[1.0]], torch.zeros(3, 4).tolist()])
def test_a_file_that_does_not_know_the_data_is_exported_as_the_run_has_it(
    unknown: Any, tmp_path: Path
) -> None:
    facts, points = exported(tmp_path, frame=unknown)
    assert facts["frame"] == "run"
    assert np.linalg.norm(points - np.array(CENTRE), axis=1).max() < 2 * RADIUS
    with pytest.raises(ValueError, match=r"does not say how its run moved.*give --frame run") as no:
        exported(tmp_path, "data", frame=unknown)
    assert "\n" not in str(no.value)


def test_a_grid_stays_along_the_axes_of_the_run(tmp_path: Path) -> None:
    file, out = saved(tmp_path, frame=FRAME.tolist()), tmp_path / "grid.pt"
    with pytest.raises(ValueError, match=r"along the axes of the run.*goes with --format ply"):
        export(file, "nerfacc-grid", out, 8, None, "data")
    assert not out.exists()
    assert export(file, "nerfacc-grid", out, 8)["frame"] == "run"
