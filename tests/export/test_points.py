"""Claims about the points that are exported: on the surface, coloured, read by others."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from ball_occupancy import CENTRE, HALF, RADIUS, ball

from leco_plugin.evaluation.inspection import mapped_box
from leco_plugin.export_surface import (
    KeptSurface,
    finest,
    kept_surface,
    shown_part,
    write_ply,
)
from leco_plugin.occupancy import Occupancy
from leco_plugin.scenes.coloured_points import views_of
from leco_plugin.space import Space


@pytest.mark.parametrize("threshold", [0.5, 0.02])
def test_points_lie_on_the_ball_however_much_air_is_kept_around_it(threshold: float) -> None:
    known = ball()
    occupancy = Occupancy(known.gate, known.space, threshold, report=known.report).eval()
    surface = kept_surface(occupancy, 64)
    offsets = surface.positions - torch.tensor(CENTRE)
    cell = 2 * HALF / 64
    assert len(surface.positions) > 600
    # within a cell's diagonal of the kept set's end, which is itself some hundredths off the ball
    assert float((offsets.norm(dim=-1) - RADIUS).abs().quantile(0.95)) < 3**0.5 * cell + 0.1
    assert float(offsets[:, 2].quantile(0.01)) > -0.5 * RADIUS  # no camera is below it
    assert bool(occupancy.occupied(surface.positions).all())
    # alike but for the last digit, in which a batch's end may round otherwise
    again = occupancy.query(surface.positions)
    torch.testing.assert_close(surface.values, again, rtol=1e-6, atol=1e-8)


def test_without_cameras_points_are_where_the_kept_set_ends() -> None:
    known = ball()
    surface = kept_surface(Occupancy(known.gate, known.space, 0.5).eval(), 64)
    offsets = surface.positions - torch.tensor(CENTRE)
    assert len(surface.positions) > 1000 and float(offsets[:, 2].min()) < -0.9 * RADIUS


def test_a_flat_box_has_as_many_cells_as_a_cube() -> None:
    box = mapped_box(ball())
    flat = box.__class__(box.low, torch.lerp(box.low, box.high, torch.tensor([1.0, 1.0, 0.1])))
    assert finest(box.__class__(-torch.ones(3), torch.ones(3))) == 128
    assert finest(flat) > 200 and math.prod(flat.cells(finest(flat))) < 1.1 * 128**3


def test_other_programs_read_places_and_colours(tmp_path: Path) -> None:
    surface = kept_surface(ball(), 24)
    write_ply(surface, tmp_path / "new" / "kept.ply")
    assert (tmp_path / "new" / "kept.ply").read_bytes()[:40].startswith(b"ply\nformat binary")
    cloud = trimesh.load(tmp_path / "new" / "kept.ply")
    assert np.allclose(cloud.vertices, surface.positions.numpy(), atol=1e-5)
    brightness = cloud.colors[:, :3].sum(axis=1).astype(float)
    assert np.corrcoef(brightness, surface.values.numpy())[0, 1] > 0.9
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["kept.ply"]


PINHOLE = {"w": 100, "h": 50, "fl_x": 50.0, "fl_y": 50.0, "cx": 50.0, "cy": 25.0}


def scene_of(tmp_path: Path, *eyes: tuple[float, float, float], **lens: object) -> Path:
    """Cameras that look down, in nerfstudio's format."""
    frames = [
        {"file_path": "a.jpg", "transform_matrix": [[1, 0, 0, x], [0, 1, 0, y], [0, 0, 1, z]]}
        for x, y, z in eyes
    ]
    file = tmp_path / "transforms.json"
    file.write_text(json.dumps({**PINHOLE, **lens, "frames": frames}))
    return file


def test_photographs_show_what_lies_before_them_within_their_images(tmp_path: Path) -> None:
    """A camera 2 above: 2 to each side along x, 1 along y, and a little more."""
    places = np.array(
        [[0, 0, 0], [1.9, 0, 0], [2.3, 0, 0], [0, 0.9, 0], [0, 1.2, 0], [0, 0, 3.0], [4, 0, 0]]
    )
    one, far = scene_of(tmp_path, (0.0, 0.0, 2.0)), (2.0, 0.0, 4.0)
    assert (found := views_of(one, places)) is not None
    assert found.tolist() == [1, 1, 0, 1, 0, 0, 0]
    both = views_of(scene_of(tmp_path, (0.0, 0.0, 2.0), far), places)
    assert both is not None and both.tolist() == [2, 2, 1, 2, 1, 0, 1]
    # the image is flipped upright: rows count downwards
    above = views_of(scene_of(tmp_path, (0.0, 0.0, 2.0), cy=0.0), places)
    assert above is not None and above.tolist() == [1, 1, 0, 0, 0, 0, 0]
    # a barrel draws in what lies outside: 2.3 / 2 -> 1.15 (1 - 0.2 * 1.32) = 0.85
    barrel = views_of(scene_of(tmp_path, (0.0, 0.0, 2.0), k1=-0.2), places)
    assert barrel is not None and barrel.tolist() == [1, 1, 1, 1, 0, 0, 0]  # 4 / 2: folded
    unknown: list[dict[str, object]] = [{"camera_model": "OPENCV_FISHEYE"}, {"is_fisheye": True}]
    for lens in (*unknown, {"fl_x": None}, {"w": "wide"}):
        assert views_of(scene_of(tmp_path, far, **lens), places) is None


def test_what_photographs_show_is_known_by_each_way_to_say_a_lens(tmp_path: Path) -> None:
    places = np.array([[0, 0, 0], [1.9, 0, 0], [2.3, 0, 0], [0, 0.9, 0], [0, 1.2, 0]])
    no_focal = {"fl_x": None, "fl_y": None, "cx": None, "cy": None}
    for said in ({"x_fov": 90.0}, {"camera_angle_x": np.pi / 2}):
        angle = views_of(scene_of(tmp_path, (0.0, 0.0, 2.0), **no_focal, **said), places)
        assert angle is not None and angle.tolist() == [1, 1, 0, 1, 0]
    listed = {"distortion_params": [-0.2, 0.0, 0.0, 0.0, 0.0, 0.0]}
    barrel = views_of(scene_of(tmp_path, (0.0, 0.0, 2.0), **listed), places)
    assert barrel is not None and barrel.tolist() == [1, 1, 1, 1, 0]


def test_points_that_no_two_photographs_show_are_left_out(tmp_path: Path) -> None:
    surface = KeptSurface(torch.tensor([[0.0, 0, 0], [1.9, 0, 0]]), torch.ones(2))
    eyes, back = ((0.0, 0.0, 2.0), (-1.0, 0.0, 2.0)), torch.eye(3, 4).double()
    assert len(shown_part(surface, back, scene_of(tmp_path, *eyes)).positions) == 1
    for unknown in ((None, scene_of(tmp_path, *eyes)), (back, None)):
        assert len(shown_part(surface, *unknown).positions) == 2
    with pytest.raises(ValueError, match=r"no 2 photographs of .* show the surface"):
        shown_part(surface, back, scene_of(tmp_path, *eyes[:1]))


def test_haze_that_fills_what_is_kept_is_no_surface() -> None:
    known = ball()
    occupancy = Occupancy(known.gate, known.space, 1e-6, report=known.report).eval()
    largest = float(kept_surface(known, 64).values.max())
    assert float(kept_surface(occupancy, 64).values.min()) >= 0.5 * largest


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


def test_a_surface_that_no_camera_sees_is_refused_in_one_line() -> None:
    known = ball()
    cameras = {"cameras": [list(CENTRE)]}
    inside = Occupancy(known.gate, known.space, known.threshold, report=cameras).eval()
    with pytest.raises(ValueError, match=r"no camera sees .* lie inside it") as error:
        kept_surface(inside, 16)
    assert "\n" not in str(error.value)


def test_slabs_do_not_change_the_surface(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = kept_surface(ball(), 20)
    monkeypatch.setattr("leco_plugin.export_surface.CELLS_AT_ONCE", 1000)
    parts = kept_surface(ball(), 20)
    assert torch.equal(whole.positions, parts.positions)
    assert torch.equal(whole.values, parts.values)


@pytest.mark.parametrize("resolution", [2000, 10**30])
def test_more_cells_than_memory_holds_are_refused_before_the_gate_is_asked(
    resolution: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("leco_plugin.export_surface.query", None)
    with pytest.raises(ValueError, match=f"^{resolution} along .* too many .* smaller --resol"):
        kept_surface(ball(), resolution)
