"""The page of `leco inspect`, and the photographs' colours in it and under slices."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from ball_occupancy import CENTRE, RADIUS, ball
from browser import needs_chromium, text_of_what_asks_nobody
from page_text import figure_text

from leco_plugin.evaluation.inspection import SceneColours, ViewBox, whole_box
from leco_plugin.evaluation.occupancy_page import _mesh, faces_of, write_page
from leco_plugin.evaluation.occupancy_picture import kept_cells, seen_from_above
from leco_plugin.occupancy import Occupancy
from leco_plugin.scenes.coloured_points import PointCloud

RED, BLUE = (255, 0, 0), (0, 0, 255)


@pytest.fixture(scope="module")
def colours() -> SceneColours:
    """Red west of the ball's middle, blue east of it, in data of twice the size."""
    offsets = np.random.default_rng(0).normal(size=(500, 3))
    places = 2.0 * (np.array(CENTRE) + offsets)
    points = PointCloud(places, np.where(offsets[:, :1] < 0.0, RED, BLUE).astype(np.uint8))
    return SceneColours(points, 2.0 * torch.eye(3, 4, dtype=torch.float64))


@pytest.fixture(scope="module")
def page(colours: SceneColours, tmp_path_factory: pytest.TempPathFactory) -> Path:
    known = ball()
    half_seen = Occupancy(known.gate, known.space, 0.5, report=known.report).eval()
    half_seen.seen.cells[:, :24] = False
    return write_page(half_seen, tmp_path_factory.mktemp("page") / "ball.html", colours)


def test_faces_lie_between_cells_inside_and_outside() -> None:
    box, inside = ViewBox(torch.zeros(3), torch.full((3,), 3.0)), torch.zeros(3, 3, 3).bool()
    inside[1, 1, 1] = True
    faces = faces_of(inside, box, beyond=True)
    assert faces.shape == (6, 4, 3) and (faces.amin(), faces.amax()) == (1.0, 2.0)
    sides = sorted(tuple(middle) for middle in faces.mean(dim=1).tolist())
    assert sides[0] == (1.0, 1.5, 1.5) and sides[-1] == (2.0, 1.5, 1.5) and len(set(sides)) == 6
    assert len(faces_of(~inside, box, beyond=True)) == 6
    assert len(faces_of(~inside, box, beyond=False)) == 6 + 6 * 9


def test_two_triangles_cover_each_face() -> None:
    faces = faces_of(torch.ones(2, 1, 1).bool(), ViewBox(torch.zeros(3), torch.ones(3)), False)
    mesh = _mesh(faces)
    places = torch.stack([torch.from_numpy(mesh[axis]) for axis in "xyz"], dim=-1)
    numbers = torch.stack([torch.from_numpy(mesh[corner]).long() for corner in "ijk"], dim=-1)
    triangles = places[numbers].view(len(faces), 2, 3, 3)
    torch.testing.assert_close(triangles.mean(dim=(1, 2)), faces.mean(dim=1))
    first, second = triangles.diff(dim=2).unbind(dim=2)
    areas = torch.linalg.cross(first, second).norm(dim=-1).sum(dim=1) / 2
    sides = (faces[:, 1:3] - faces[:, :2]).norm(dim=-1)
    torch.testing.assert_close(areas, sides.prod(dim=1))


def test_a_page_is_one_small_file_with_what_is_kept_the_cameras_and_the_bounds(page: Path) -> None:
    assert page.stat().st_size < 3e6
    parts = {part["name"]: part for part in json.loads(figure_text(page))["data"]}
    kept = parts["kept, colours of the photographs"]
    shades = {shade for _, shade in kept["colorscale"]}
    assert {"rgb(255,0,0)", "rgb(0,0,255)"} <= shades
    assert {"cameras", "bounds", "no photograph shows it"} < parts.keys()


def test_a_page_without_a_scene_is_coloured_by_height(tmp_path: Path) -> None:
    text = figure_text(write_page(ball(), tmp_path / "ball.html"))
    assert "kept, height" in text and "no photograph shows it" not in text


def test_slices_lie_on_the_colours_seen_from_above(colours: SceneColours) -> None:
    box = whole_box(ball())
    seen = seen_from_above(kept_cells(ball(), box), colours)
    y, x = torch.meshgrid(box.axis(1, len(seen)), box.axis(0, seen.shape[1]), indexing="ij")
    offsets = torch.stack([x - CENTRE[0], y - CENTRE[1]], dim=-1)
    inside, far = offsets.norm(dim=-1) < 0.8 * RADIUS, offsets.norm(dim=-1) > 1.3 * RADIUS
    west = inside & (offsets[..., 0] < -0.4)
    assert (seen[west.numpy()] == (*RED, 255)).mean() > 0.95
    assert not seen[far.numpy()].any()


@needs_chromium
@pytest.mark.slow
def test_a_browser_shows_the_page_and_asks_nobody_else(page: Path, tmp_path: Path) -> None:
    shown = text_of_what_asks_nobody(page, tmp_path / "profile", ".gl-container canvas")
    assert "kept, colours of the photographs" in shown and "cameras" in shown
