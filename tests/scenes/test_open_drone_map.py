"""A project of OpenDroneMap, through nerfstudio's converter, is a bounded survey in metres."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nerfstudio.process_data.odm_utils import cameras2nerfds
from scene_files import change

from leco_plugin.scenes.city.cameras import look_at
from leco_plugin.scenes.data_manager import LecoDataManagerConfig
from leco_plugin.scenes.photographs import LecoPhotographsDataParserConfig
from leco_plugin.scenes.survey import survey

HEIGHT, GROUND = 120.0, 30.0
"""Metres; of the flight, and of the fields below."""


def rotation_vector(rotation: np.ndarray) -> np.ndarray:
    """The axis of a rotation [3, 3] times its angle."""
    values, vectors = np.linalg.eig(rotation)
    axis = np.real(vectors[:, np.argmin(np.abs(values - 1.0))])
    angle = np.arccos(np.clip((np.trace(rotation) - 1.0) / 2.0, -1.0, 1.0))
    skew = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    turned = np.eye(3) + np.sin(angle) * skew + (1.0 - np.cos(angle)) * skew @ skew
    return axis * angle if np.allclose(turned, rotation, atol=1e-6) else -axis * angle


@pytest.fixture
def scene(tiny_scene: Path, tmp_path: Path) -> Path:
    """Nine photographs over fields, in east, north, up, as the converter leaves them."""
    random = np.random.default_rng(0)
    shots = {}
    for number, (east, north) in enumerate(np.ndindex(3, 3)):
        place = np.array([60.0 * east, 60.0 * north, HEIGHT + random.normal()])
        ahead = [5.0, 8.0 * (-1) ** number, 0.0]
        pose = look_at(place, place + ahead - [0.0, 0.0, 80.0])
        pose[:, 1:3] *= -1  # its cameras look along +z, y down
        rotation = pose[:, :3].T
        shots[f"{number:03d}.png"] = {
            "rotation": rotation_vector(rotation).tolist(),
            "translation": (-rotation @ pose[:, 3]).tolist(),
        }
    points = np.column_stack([random.uniform(-40, 160, (500, 2)), random.normal(GROUND, 2.0, 500)])
    listed = {str(n): {"coordinates": p.tolist(), "color": [1, 2, 3]} for n, p in enumerate(points)}
    project, out = tmp_path / "project", tmp_path / "scene"
    project.mkdir()
    shutil.copytree(tiny_scene / "images", out / "images")
    camera = {"projection_type": "brown", "width": 32, "height": 32, "focal_x": 1.0, "focal_y": 1.0}
    (project / "cameras.json").write_text(json.dumps({"one": camera | {"c_x": 0.0, "c_y": 0.0}}))
    (project / "shots.json").write_text(json.dumps([{"shots": shots, "points": listed}]))
    names = {f"{number:03d}": Path(f"images/{number:03d}.png") for number in range(9)}
    cameras2nerfds(names, project / "cameras.json", Path(), project / "shots.json", out)
    return out


def test_a_project_is_a_bounded_survey_in_metres(scene: Path) -> None:
    change(scene, lambda meta: meta.update(metres_per_unit=1))
    parser = LecoPhotographsDataParserConfig(data=scene, train_split_fraction=0.7)
    manager: Any = LecoDataManagerConfig(dataparser=parser).setup(device="cpu")
    assert bool((manager.train_dataset.cameras.camera_to_worlds[:, 2, 2] > 0.9).all())
    found = survey(manager)
    assert found.bounds.kind == "box" and found.meeting == 1.0
    rows = {line[:9]: line.split() for line in found.lines()}
    assert float(rows["highest c"][-1]) == pytest.approx(HEIGHT, abs=5.0)
    assert float(rows["ground, z"][-1]) < GROUND - 2.0
    assert GROUND < float(rows["top, z   "][-1]) < HEIGHT
