"""A Mega-NeRF folder is read in its order, or what is wrong with it is said in one line."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mega_nerf_scene
import numpy as np
import pytest
import torch
from mega_nerf_scene import COORDINATES, poses
from PIL import Image
from scene_files import refused

from leco_plugin.scenes.city.cameras import look_at
from leco_plugin.scenes.mega_nerf_files import (
    TO_DRB,
    Coordinates,
    around,
    read_scene,
    wrong_axis,
)
from leco_plugin.studio.checkpoints import allow_checkpoint_globals


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return mega_nerf_scene.write(tmp_path / "scene")


def metadata(scene: Path, number: int = 3, split: str = "train") -> Path:
    return scene / split / "metadata" / f"{number:06d}.pt"


def put(**values: Any) -> Callable[[Path], None]:
    """Changes values in the metadata of picture 3; None removes one."""

    def change(scene: Path) -> None:
        _change(metadata(scene), values)

    return change


def _change(path: Path, values: dict[str, Any]) -> None:
    held = torch.load(path, weights_only=True) | values
    torch.save({name: value for name, value in held.items() if value is not None}, path)


def coordinates(**values: Any) -> Callable[[Path], None]:
    return lambda scene: _change(scene / "coordinates.pt", values)


def turn(matrix: np.ndarray) -> Callable[[Path], None]:
    """Applies a matrix to the world of all poses."""

    def change(scene: Path) -> None:
        for path in scene.glob("*/metadata/*.pt"):
            c2w = torch.load(path, weights_only=True)["c2w"]
            _change(path, {"c2w": torch.from_numpy(matrix).float() @ c2w})

    return change


def all_of(*changes: Callable[[Path], object]) -> Callable[[Path], None]:
    def change(scene: Path) -> None:
        for one in changes:
            one(scene)

    return change


EYE = torch.eye(3, 4)
POSE = torch.cat([EYE[:, :3] * 1.2, EYE[:, 3:]], dim=1)
BAD: dict[str, tuple[Callable[[Path], object], str]] = {
    "no folder": (shutil.rmtree, "there is no folder .*scene"),
    "no coordinates": (lambda s: (s / "coordinates.pt").unlink(), r"no .*coordinates\.pt"),
    "no val": (lambda s: shutil.rmtree(s / "val"), "it has no val/rgbs"),
    "no metadata folder": (lambda s: shutil.rmtree(s / "train/metadata"), "no train/metadata"),
    "empty metadata": (
        lambda s: [p.unlink() for p in (s / "val/metadata").iterdir()],
        "val/metadata holds no metadata",
    ),
    "a picture without metadata": (
        lambda s: metadata(s).unlink(),
        "train holds 5 pictures and 4 metadata files; 000003 has no metadata",
    ),
    "metadata without a picture": (
        lambda s: (s / "val/rgbs/000002.png").unlink(),
        "val holds 1 picture and 2 metadata files; 000002 has no picture",
    ),
    "a picture of an unknown ending": (
        lambda s: (s / "val/rgbs/000002.png").rename(s / "val/rgbs/000002.tif"),
        "000002 has no picture",
    ),
    "a picture in both splits": (
        lambda s: [
            shutil.copy(p, s / "val" / p.relative_to(s / "train"))
            for p in (s / "train").glob("*/000003.*")
        ],
        r"000003\.pt is both in train/metadata and in val/metadata",
    ),
    "scale 0": (coordinates(pose_scale_factor=0.0), r"coordinates\.pt: pose_scale_factor is 0"),
    "scale NaN": (coordinates(pose_scale_factor=float("nan")), "pose_scale_factor is nan"),
    "a vast scale": (coordinates(pose_scale_factor=10**400), "too large a number"),
    "no scale": (coordinates(pose_scale_factor=None), r"coordinates\.pt has no pose_scale_factor"),
    "an origin in the plane": (coordinates(origin_drb=torch.zeros(2)), "origin_drb is a tensor"),
    "no c2w": (put(c2w=None), r"000003\.pt has no c2w"),
    "c2w 3x3": (put(c2w=torch.eye(3)), "c2w is a tensor of float32, 3 x 3, and not 3 x 4"),
    "c2w a number": (put(c2w=3), "c2w is a value of type int"),
    "a pose of NaN": (put(c2w=EYE * float("nan")), "c2w holds values that are not finite"),
    "a scaled pose": (put(c2w=POSE), r"000003\.pt: c2w is no rotation"),
    "all mirrored": (turn(np.diag([-1.0, 1.0, 1.0])), "c2w is mirrored, as in all files"),
    "up for down": (turn(np.diag([-1.0, -1.0, 1.0])), "first axis of its world points up"),
    "no height": (put(H=0), "H is 0, and not a number of pixels"),
    "half a pixel": (put(W=24.5), "W is 24.5"),
    "a vast width": (put(W=1 << 40), "not a number of pixels"),
    "a picture of another shape": (put(W=32), "24 x 16 pixels, its metadata are for 32 x 16"),
    "a focal length of 0": (put(intrinsics=torch.tensor([0.0, 1, 1, 1])), "focal length"),
    "a word": (put(name="DJI_0001"), "'name' is a value of type str; only tensors and numbers"),
    "a numpy number": (put(H=np.int64(3)), r"000003\.pt holds numpy.* only tensors and numbers"),
    "a list": (put(intrinsics=[1.0, 1.0, 1.0, 1.0]), "'intrinsics' is a value of type list"),
    "no dictionary": (lambda s: torch.save(EYE, metadata(s)), "and not a dictionary"),
    "no .pt at all": (lambda s: metadata(s).write_bytes(b"c2w"), "is not a file of torch.save"),
    "a folder": (
        all_of(lambda s: metadata(s).unlink(), lambda s: metadata(s).mkdir()),
        "there is no file .*000003",
    ),
    "a picture that is none": (
        lambda s: (s / "train/rgbs/000003.png").write_bytes(b"\x89PNG"),
        r"000003\.png cannot be read as an image",
    ),
    "a picture of another kind": (
        lambda s: Image.new("L", (24, 16)).save(s / "train/rgbs/000003.png", format="GIF"),
        r"000003\.png is a file of GIF: save it as JPEG or PNG",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_gets_one_line_that_names_the_file(name: str, scene: Path) -> None:
    spoil, message = BAD[name]
    spoil(scene)
    with refused(message):
        read_scene(scene)


def test_a_numpy_number_is_named_also_where_checkpoints_of_nerfstudio_are_read(scene: Path) -> None:
    put(H=np.int64(3))(scene)
    before = torch.serialization.get_safe_globals()
    allow_checkpoint_globals()
    try:
        with refused(r"000003\.pt holds numpy.* only tensors and numbers"):
            read_scene(scene)
    finally:
        torch.serialization.clear_safe_globals()
        torch.serialization.add_safe_globals(before)


def test_a_scene_is_read_in_the_order_of_names_across_splits(scene: Path) -> None:
    read = read_scene(scene)
    assert [frame.stem for frame in read.frames] == [f"{n:06d}" for n in range(7)]
    assert [n for n, frame in enumerate(read.frames) if frame.split == "val"] == [2, 5]
    expected = mega_nerf_scene.COORDINATES.to_file(mega_nerf_scene.poses())
    np.testing.assert_allclose(read.poses(), expected, atol=1e-6)
    assert read.frames[0].width == 24 and read.frames[0].height == 16


def test_the_line_for_the_log_has_altitudes_with_their_sign(scene: Path) -> None:
    altitudes = mega_nerf_scene.poses()[:, 2, 3]
    said = read_scene(scene).describe()
    assert "1 unit is 40 m" in said and "2 of them for validation" in said
    assert f"from {altitudes.min():.1f} to {altitudes.max():.1f} m" in said
    assert "below the datum" not in said
    coordinates(origin_drb=torch.tensor([110.0, 0.0, 0.0]))(scene)
    assert "else origin_drb has the wrong sign" in read_scene(scene).describe()


def test_a_world_that_really_looks_up_can_be_read(scene: Path) -> None:
    turn(np.diag([-1.0, -1.0, 1.0]))(scene)
    assert len(read_scene(scene, check_axes=False).frames) == 7


def test_a_jpeg_comes_before_a_png_and_other_files_are_left_out(scene: Path) -> None:
    rgbs = scene / "train" / "rgbs"
    Image.new("RGB", (24, 16)).save(rgbs / "000003.jpg")
    (rgbs / "._000003.jpg").write_text("")
    (rgbs / "Thumbs.db").write_text("")
    frame = read_scene(scene).frames[3]
    assert frame.image == rgbs / "000003.jpg"


def test_numbers_may_be_tensors_and_pictures_smaller_than_their_metadata(scene: Path) -> None:
    put(H=torch.tensor(32), W=torch.tensor([48]))(scene)
    frame = read_scene(scene).frames[3]
    assert (frame.width, frame.height, frame.image_size) == (48, 32, (24, 16))


FILES = COORDINATES.to_file(poses(24))

RING = np.stack(
    [
        look_at(np.array([30 * np.cos(a), 30 * np.sin(a), height]), np.array([0.0, 0.0, 0.0]))
        for a, height in zip(np.linspace(0, 5.5, 12), np.linspace(20, 40, 12))
    ]
)
STREET = np.stack(
    [
        look_at(np.array([x, 0.0, 2.0]), np.array([x + 5.0, y, 2.3]))
        for x, y in zip(range(12), np.linspace(-4, 4, 12))
    ]
)
LAWNMOWER = np.tile(np.eye(3), (8, 1, 1))
LAWNMOWER[1::2] = np.diag([-1.0, -1.0, 1.0])  # to and fro, straight down
LAWNMOWER = np.concatenate([LAWNMOWER, np.zeros((8, 3, 1))], axis=2)
SURVEYS = {"oblique": RING, "street": STREET, "straight down": LAWNMOWER, "drone": poses(24)}


def test_the_axes_are_a_rotation_and_mean_what_they_say() -> None:
    np.testing.assert_array_equal(TO_DRB @ TO_DRB.T, np.eye(3))
    assert np.linalg.det(TO_DRB) == 1
    right, forward, up = np.eye(3)
    np.testing.assert_array_equal(TO_DRB @ up, [-1, 0, 0])
    np.testing.assert_array_equal(TO_DRB @ right, [0, 1, 0])
    np.testing.assert_array_equal(TO_DRB @ forward, [0, 0, -1])


def test_altitude_is_metres_above_the_datum() -> None:
    np.testing.assert_allclose(COORDINATES.altitudes(FILES), poses(24)[:, 2, 3])


def test_the_way_into_the_files_and_to_the_model_differs_by_units_and_origin_only() -> None:
    model, metres = COORDINATES.to_model(FILES), poses(24)
    np.testing.assert_allclose(model[:, :, :3], metres[:, :, :3], atol=1e-12)
    origin = TO_DRB.T @ COORDINATES.origin_drb
    np.testing.assert_allclose(40 * model[:, :, 3] + origin, metres[:, :, 3], atol=1e-9)


def test_the_transform_takes_metric_places_to_the_model() -> None:
    transform = COORDINATES.transform()
    drb = metric = FILES[:, :, 3] * COORDINATES.metres + COORDINATES.origin_drb
    drb = (metric @ transform[:, :3].T + transform[:, 3]) / COORDINATES.metres
    np.testing.assert_allclose(drb, COORDINATES.to_model(FILES)[:, :, 3], atol=1e-12)


def test_coordinates_around_cameras_hold_them() -> None:
    coordinates = around(poses(24)[:, :, 3])
    places = coordinates.to_file(poses(24))[:, :, 3]
    assert np.abs(places).max() == pytest.approx(1)
    assert around(np.zeros((1, 3))).metres > 0


@pytest.mark.parametrize("name", SURVEYS)
def test_a_survey_whose_first_axis_points_down_passes(name: str) -> None:
    assert wrong_axis(TO_DRB @ SURVEYS[name]) is None


@pytest.mark.parametrize("name", ["oblique", "drone"])
@pytest.mark.parametrize("direction", ["up", "left", "right", "back", "forward"])
def test_any_other_direction_of_down_is_named(name: str, direction: str) -> None:
    axis, sign = {
        "up": (0, -1),
        "left": (1, -1),
        "right": (1, 1),
        "back": (2, 1),
        "forward": (2, -1),
    }[direction]
    world = np.zeros((3, 3))
    world[axis, 2] = -sign  # where the scene's "up" goes
    world[(axis + 1) % 3, 0] = 1
    world[(axis + 2) % 3, 1] = np.linalg.det(world + _unit((axis + 2) % 3, 1))
    assert np.linalg.det(world) == pytest.approx(1)
    fault = wrong_axis(world @ SURVEYS[name])
    assert fault is not None and direction in fault


def _unit(row: int, column: int) -> np.ndarray:
    matrix = np.zeros((3, 3))
    matrix[row, column] = 1
    return matrix


def test_the_trap_of_poses_aligned_to_east_north_up_is_found() -> None:
    """colmap_to_mega_nerf.py takes the world to be (right, down, forward)."""
    from_rdf = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    fault = wrong_axis(from_rdf @ SURVEYS["drone"])
    assert fault is not None and "the cameras look back" in fault


def test_coordinates_have_metres_an_origin_and_a_datum() -> None:
    known = Coordinates(np.array([100.0, 20.0, -30.0]), 4.0)
    in_metres = np.random.default_rng(0).normal(size=(5, 3, 4)) * [1.0, 1.0, 1.0, 50.0]
    of_file = known.to_file(in_metres)
    right, forward, up = in_metres[:, :, 3].T
    np.testing.assert_allclose(of_file[:, 0, 3], (-up - 100.0) / 4.0)
    np.testing.assert_allclose(of_file[:, 1, 3], (right - 20.0) / 4.0)
    np.testing.assert_allclose(of_file[:, 2, 3], (-forward + 30.0) / 4.0)
    np.testing.assert_allclose(of_file[:, 0, :3], -in_metres[:, 2, :3])
    np.testing.assert_allclose(known.altitudes(of_file), up)
    model = known.to_model(of_file)
    np.testing.assert_allclose(model[:, 2, 3], (up + 100.0) / 4.0)
    np.testing.assert_allclose(known.height_of(-up[0]), model[0, 2, 3])
    drb = np.array([-up[0], right[0], -forward[0], 1.0])
    np.testing.assert_allclose(known.transform() @ drb / 4.0, model[0, :, 3])


def test_cameras_lie_within_one_unit_of_the_middle_of_their_box() -> None:
    places = np.array([[0.0, 0.0, 10.0], [40.0, 6.0, 12.0], [10.0, 2.0, 30.0]])
    found = around(places)
    assert found.origin_drb.tolist() == [-20.0, 20.0, -3.0] and found.metres == 20.0
    assert around(places[:1]).metres == 1e-3
