"""Claims about a case's scene on disk."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from leco_plugin.scenes.photographs import check_scene, read_points
from leco_plugin.stability.capture import Capture
from leco_plugin.stability.matter import Box, Paint
from leco_plugin.stability.scene_folder import TRUTH, digest_of, write_scene
from leco_plugin.stability.stage import Stage
from leco_plugin.stability.stages import STAGES, YARD

SMALL = Capture(views=4, test_views=2, width=16, height=12)


def test_nerfstudio_can_read_it_and_the_truth_lies_beside(tmp_path: Path) -> None:
    folder = write_scene(STAGES["poles-and-wires"], SMALL, tmp_path / "scene")
    meta = check_scene(folder)
    assert len(meta["train_filenames"]) == 4 and len(meta["test_filenames"]) == 2
    for name in meta["test_filenames"]:
        truth = np.load(folder / TRUTH / f"{Path(name).stem}.npz")
        assert truth["depth"].shape == truth["detail"].shape == (12, 16)
        assert np.isfinite(truth["depth"]).mean() > 0.5
        assert truth["shown_by"].shape == (12, 16)
        assert not truth["shown_by"][np.isinf(truth["depth"])].any()
        assert 2 <= truth["shown_by"].max() <= 4  # by training pictures alone
    assert not list(tmp_path.glob(".*"))


def test_sparse_points_lie_on_surfaces_where_the_written_poses_put_them(tmp_path: Path) -> None:
    cube = Stage((Box((-1.0, -1.0, 0.0), (1.0, 1.0, 2.0), Paint((0.5, 0.5, 0.5))),))
    far = Capture(views=4, test_views=2, width=16, height=12, origin=(100.0, 0.0, 0.0))
    folder = write_scene(cube, far, tmp_path / "scene")
    points = read_points(check_scene(folder), folder)
    assert points is not None
    offsets = (points.numpy() - [100.0, 0.0, 1.0]) / 1.0
    assert np.abs(offsets).max(axis=1) == pytest.approx(np.ones(len(points)), abs=1e-3)


def test_a_scene_without_surfaces_has_no_points(tmp_path: Path) -> None:
    folder = write_scene(STAGES["all-empty"], SMALL, tmp_path / "scene")
    assert "ply_file_path" not in check_scene(folder)


def test_pictures_of_three_sizes_fit_their_intrinsics(tmp_path: Path) -> None:
    mixed = Capture(views=6, test_views=2, width=16, height=12, sizes=(1.0, 0.5, 1.5))
    folder = write_scene(YARD, mixed, tmp_path / "scene")
    frames = check_scene(folder)["frames"]
    assert {(frame["w"], frame["h"]) for frame in frames} == {(16, 12), (8, 6), (24, 18)}
    assert {frame["fl_x"] / frame["w"] for frame in frames} == {frames[0]["fl_x"] / frames[0]["w"]}


def test_exposure_changes_the_light_and_not_the_shape(tmp_path: Path) -> None:
    plain = write_scene(YARD, SMALL, tmp_path / "plain")
    exposed = Capture(views=4, test_views=2, width=16, height=12, exposure=0.5)
    other = write_scene(YARD, exposed, tmp_path / "other")
    for name in check_scene(plain)["train_filenames"]:
        one, two = (np.asarray(Image.open(folder / name)) for folder in (plain, other))
        assert np.array_equal(one[..., 3], two[..., 3]) and not np.array_equal(one, two)


def test_a_scene_is_written_once_and_anew_when_it_should_differ(tmp_path: Path) -> None:
    folder = write_scene(YARD, SMALL, tmp_path / "scene")
    marked = folder / "transforms.json"
    marked.write_text(marked.read_text() + " ")
    write_scene(YARD, SMALL, folder)
    assert marked.read_text().endswith(" ")
    write_scene(STAGES["outline"], SMALL, folder)
    json.loads(marked.read_text())
    assert not marked.read_text().endswith(" ")
    assert digest_of(YARD, SMALL) != digest_of(STAGES["outline"], SMALL)
