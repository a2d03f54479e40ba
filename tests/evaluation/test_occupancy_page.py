"""The page of `leco inspect`, and the photographs' colours in it and under slices."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from ball_occupancy import CENTRE, RADIUS, ball
from browser import needs_chromium, text_of_what_asks_nobody
from page_text import figure_text

from leco_plugin.evaluation import occupancy_page
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
    box = ViewBox(torch.tensor([1.0, -2.0, 0.0]), torch.tensor([4.0, 2.0, 9.0]))
    inside = torch.zeros(3, 4, 3).bool()
    inside[1, 2, 1] = True
    faces = faces_of(inside, box, beyond=True)
    assert faces.shape == (6, 4, 3)
    assert faces.amin(dim=(0, 1)).tolist() == [2.0, 0.0, 3.0]
    assert faces.amax(dim=(0, 1)).tolist() == [3.0, 1.0, 6.0]
    assert sorted(faces.mean(dim=1).tolist()) == [
        *([2.0, 0.5, 4.5], [2.5, 0.0, 4.5], [2.5, 0.5, 3.0]),
        *([2.5, 0.5, 6.0], [2.5, 1.0, 4.5], [3.0, 0.5, 4.5]),
    ]
    assert len(faces_of(~inside, box, beyond=True)) == 6
    assert len(faces_of(~inside, box, beyond=False)) == 6 + 2 * (3 * 4 + 3 * 3 + 4 * 3)


def test_two_triangles_cover_each_face() -> None:
    box = ViewBox(torch.zeros(3), torch.tensor([1.0, 2.0, 3.0]))
    faces = faces_of(torch.ones(2, 1, 1).bool(), box, False)
    mesh = _mesh(faces)
    places = torch.stack([torch.from_numpy(mesh[axis]) for axis in "xyz"], dim=-1)
    numbers = torch.stack([torch.from_numpy(mesh[corner]).long() for corner in "ijk"], dim=-1)
    triangles = places[numbers].view(len(faces), 2, 3, 3)
    torch.testing.assert_close(triangles.mean(dim=(1, 2)), faces.mean(dim=1))
    first, second = triangles.diff(dim=2).unbind(dim=2)
    areas = torch.linalg.cross(first, second).norm(dim=-1).sum(dim=1) / 2
    sides = (faces[:, 1:3] - faces[:, :2]).norm(dim=-1)
    torch.testing.assert_close(areas, sides.prod(dim=1))


def test_the_bounds_are_the_twelve_edges_of_their_box() -> None:
    box = ViewBox(torch.tensor([1.0, 2.0, 3.0]), torch.tensor([4.0, 6.0, 8.0]))
    line = occupancy_page._edges(box)
    ends = itertools.product((1.0, 4.0), (2.0, 6.0), (3.0, 8.0))
    edges = {
        frozenset(pair)
        for pair in itertools.combinations(ends, 2)
        if sum(a != b for a, b in zip(*pair)) == 1
    }
    assert {frozenset(pair) for pair in itertools.pairwise(map(tuple, line.tolist()))} == edges


def test_faces_are_as_fine_as_their_number_allows_and_begin_below_the_ground(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(occupancy_page, "COARSER", (16,))
    finest, ground = kept_cells(ball(), whole_box(ball()), 32), 0.5
    fine = occupancy_page._kept_faces(ball(), finest, ground)
    tops = fine[..., 2].amax(dim=1)
    assert ground - 2.0 * 4.0 / 32 < float(tops.min()) < ground
    for most, cells in ((len(fine), 32), (len(fine) - 1, 16)):
        monkeypatch.setattr(occupancy_page, "MOST_FACES", most)
        faces = occupancy_page._kept_faces(ball(), finest, ground)
        sides = faces.amax(dim=1) - faces.amin(dim=1)
        torch.testing.assert_close(sides.amax(dim=0), torch.full((3,), 4.0 / cells))


def test_a_face_has_the_colour_of_its_number() -> None:
    colours = np.array([[255, 0, 0], [10, 20, 30], [255, 0, 0], [0, 0, 255]], np.uint8)
    paint = occupancy_page._painted(colours)
    assert (paint["cmin"], paint["cmax"], paint["intensitymode"]) == (0, 255, "cell")
    shades = [shade for _, shade in paint["colorscale"]]
    assert [share for share, _ in paint["colorscale"]] == pytest.approx(np.arange(256) / 255)
    shown = [shades[number] for number in paint["intensity"]]  # of two triangles a face
    assert shown[::2] == shown[1::2] == [f"rgb({r},{g},{b})" for r, g, b in colours]


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
    (kept,) = [part for part in json.loads(text)["data"] if part["name"] == "kept, height"]
    for shade in ("rgb(68,1,84)", "rgb(253,231,36)"):  # the ends of viridis
        assert shade in {shade for _, shade in kept["colorscale"]}


def test_slices_lie_on_the_colours_seen_from_above(colours: SceneColours) -> None:
    box = whole_box(ball())
    box.high[1] -= 1.2
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
