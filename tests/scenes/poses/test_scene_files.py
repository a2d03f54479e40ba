"""Claims about the files of a placed reconstruction; a model of pycolmap has a stand-in."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scene_files import read_ply

from leco_plugin.scenes.coloured_points import read_points
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.photographs import LecoPhotographsDataParserConfig
from leco_plugin.scenes.poses import ASKED
from leco_plugin.scenes.poses.command import _finished
from leco_plugin.scenes.poses.georeference import (
    Placement,
    intrinsics,
    transforms_of,
    write_scene,
    write_sparse_points,
)
from leco_plugin.scenes.scene_file import unused_fields
from leco_plugin.scenes.whole_files import write_json

IN_METRES = Placement(1.0, np.eye(3), np.zeros(3), residuals=np.zeros(3))
OPENCV = [30.0, 31.0, 16.0, 12.0, 0.1, 0.01, 0.001, 0.002]


class StandIn:
    """What of pycolmap's Reconstruction is used: three cameras that look down, and points."""

    def __init__(self, lenses: int = 1) -> None:
        self.cameras = {
            number: SimpleNamespace(
                model_name="OPENCV", params=OPENCV, width=32 + number, height=24
            )
            for number in range(lenses)
        }
        self.images = {}
        for number in range(3):
            pose = np.column_stack([np.diag([1.0, -1.0, -1.0]), [number, 0.0, 10.0]])
            inverse = SimpleNamespace(matrix=lambda pose=pose: pose)
            self.images[number] = SimpleNamespace(
                name=f"{2 - number}.png",
                camera_id=number % lenses,
                cam_from_world=lambda inverse=inverse: SimpleNamespace(inverse=lambda: inverse),
            )
        points = np.random.default_rng(0).uniform(size=(40, 3))
        self.points3D = {
            number: SimpleNamespace(xyz=xyz, color=np.array([1, 2, 3], dtype=np.uint8))
            for number, xyz in enumerate(points)
        }

    def reg_image_ids(self) -> list[int]:
        return list(self.images)

    def find_image_with_name(self, name: str) -> Any:
        return next(image for image in self.images.values() if image.name == name)

    def write(self, folder: Path) -> None:
        (folder / "cameras.bin").touch()


def test_one_lens_stands_once_and_several_stand_with_their_frames() -> None:
    one = transforms_of(StandIn(), IN_METRES, (41.0, -83.0, 0.0))
    assert one["fl_y"] == 31.0 and one["p2"] == 0.002 and one["w"] == 32
    assert "fl_x" not in one["frames"][0]
    several = transforms_of(StandIn(2), IN_METRES, (41.0, -83.0, 0.0))
    assert "fl_x" not in several
    assert [frame["w"] for frame in several["frames"]] == [32, 33, 32]


def test_cameras_look_along_minus_z_in_the_order_of_names() -> None:
    frames = transforms_of(StandIn(), IN_METRES, None)["frames"]
    assert [frame["file_path"] for frame in frames] == [
        "images/0.png",
        "images/1.png",
        "images/2.png",
    ]
    pose = np.array(frames[0]["transform_matrix"])
    np.testing.assert_array_equal(pose[:3, :3], np.eye(3))
    np.testing.assert_array_equal(pose[:, 3], [2.0, 0.0, 10.0, 1.0])


def test_metres_and_the_origin_are_there_by_gps_only() -> None:
    known = transforms_of(StandIn(), IN_METRES, (41.0, -83.0, 0.0))
    assert known["metres_per_unit"] == 1.0
    assert known["geographic_origin"] == {
        **{"latitude": 41.0, "longitude": -83.0, "altitude": 0.0},
        "axes": "east, north, up",
    }
    assert unused_fields(known) == []
    without = Placement(1.0, np.eye(3), np.zeros(3), reason="none")
    assert not {"metres_per_unit", "geographic_origin"} & {
        *transforms_of(StandIn(), without, (41.0, -83.0, 0.0))
    }


@pytest.mark.parametrize(
    ("model", "params", "wanted"),
    [
        ("SIMPLE_RADIAL", [9, 4, 3, 0.5], {"fl_x": 9, "fl_y": 9, "cx": 4, "cy": 3, "k1": 0.5}),
        (
            "OPENCV_FISHEYE",
            [9, 8, 4, 3, 1, 2, 3, 4],
            {"fl_x": 9, "fl_y": 8, "cx": 4, "cy": 3, "k1": 1, "k2": 2, "k3": 3, "k4": 4},
        ),
    ],
)
def test_lens_models_of_colmap_have_nerfstudios_names(
    model: str, params: list[float], wanted: dict[str, float]
) -> None:
    camera = SimpleNamespace(model_name=model, params=params, width=8, height=6)
    assert intrinsics(camera) == {"w": 8, "h": 6, **wanted}


def test_what_is_written_is_read(tmp_path: Path) -> None:
    for number in range(3):
        (tmp_path / "images").mkdir(exist_ok=True)
        Image.new("RGB", (32, 24), (90, 80, number)).save(tmp_path / "images" / f"{number}.png")
    model = StandIn()
    meta = transforms_of(model, IN_METRES, (41.0, -83.0, 0.0))
    write_scene(tmp_path, model, meta)
    points = np.array([point.xyz for point in model.points3D.values()])
    np.testing.assert_allclose(read_ply(tmp_path / "sparse_pc.ply"), points, atol=1e-6)
    config = LecoPhotographsDataParserConfig(data=tmp_path, train_split_fraction=1.0)
    outputs = config.setup().get_dataparser_outputs("train")
    assert len(outputs.image_filenames) == 3
    assert float(outputs.cameras.camera_to_worlds[0, 2, 2]) == 1.0


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_points_with_large_coordinates_keep_their_digits(sign: float, tmp_path: Path) -> None:
    places = sign * np.array([[500_000.123, 4_600_000.456, 10.0], [500_000.623, 4_600_001.0, 9.0]])
    write_sparse_points(tmp_path / "points.ply", places, np.zeros((2, 3), np.uint8))
    found = read_points({"ply_file_path": "points.ply"}, tmp_path)
    assert found is not None
    np.testing.assert_allclose(found.positions, places, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("edited", ['{"frames": [', "[]", '{"frames": [{}]}'])
def test_a_description_that_was_edited_wrongly_is_named(edited: str, tmp_path: Path) -> None:
    asked = {"format": 2, "photographs": 3}
    write_json(tmp_path / ASKED, asked)
    (tmp_path / "sparse_pc.ply").touch()
    (tmp_path / "transforms.json").write_text(edited)
    with pytest.raises(InputError, match=r"transforms\.json is no scene .*: mend it, or delete it"):
        _finished(tmp_path, asked)
