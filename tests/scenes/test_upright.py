"""Surveys are set upright in whatever coordinates they come; nothing else is touched."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from scene_files import change, described, read_ply, write_ply
from torch import Tensor

from leco_plugin.scenes import data_manager
from leco_plugin.scenes.city.cameras import look_at
from leco_plugin.scenes.data_manager import LecoDataManagerConfig, upright_outputs
from leco_plugin.scenes.frames import _fly_over, _normal_of_layer, _vertical_of, turn_to_upright
from leco_plugin.scenes.photographs import LecoPhotographsDataParserConfig
from leco_plugin.scenes.survey import survey

UP = torch.tensor([0.0, 0.0, 1.0])


def flight(tilt: float, headings: int, rows: int = 5) -> Tensor:
    """[C, 3, 4] poses over a square of side 2 at a height of about 1.

    Args:
        tilt: of the cameras, degrees off straight down.
        headings: directions in which they fly, in turn.
    """
    random = np.random.default_rng(5)
    poses = []
    for number, (x, y) in enumerate(np.ndindex(rows, rows)):
        place = np.array([x, y, 0]) * 2 / (rows - 1) - [1, 1, 0] + random.normal(0, 0.03, 3)
        place[2] += 1.0
        angle = 2 * np.pi * (number % headings) / headings + 0.3
        reach = np.tan(np.deg2rad(tilt)) + 0.01
        ahead = reach * np.array([np.cos(angle), np.sin(angle), 0.0])
        poses.append(look_at(place, place + ahead - [0, 0, 1]))
    return torch.tensor(np.stack(poses)).float()


def ground(relief: float = 0.05) -> Tensor:
    """[2000, 3] points around z = 0, and a few strays far below them."""
    random = torch.Generator().manual_seed(2)
    points = torch.rand(2000, 3, generator=random) * 4 - 2
    points[:, 2] = relief * torch.randn(2000, generator=random)
    points[:20, 2] -= 50.0
    return points


def around(count: int, height: float, radius: float = 1.0) -> Tensor:
    """[count, 3, 4] cameras on a ring that look at its middle on the ground."""
    angles = np.arange(count) * 2 * np.pi / count
    x, y = radius * np.cos(angles), radius * np.sin(angles)
    places = np.column_stack([x, y, np.full(count, height)])
    return torch.tensor(np.stack([look_at(place, np.zeros(3)) for place in places]))


def any_rotation(seed: int) -> Tensor:
    values = torch.randn(3, 3, generator=torch.Generator().manual_seed(seed))
    rotation, _ = torch.linalg.qr(values)
    return rotation * torch.linalg.det(rotation).sign()


# of the first camera of a survey, structure from motion makes (right, down, ahead); nerfstudio then
# has z where the tops of the photographs are
SIDEWAYS = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
TURNS = {"sideways": SIDEWAYS, "upside down": torch.diag(torch.tensor([1.0, -1.0, -1.0]))}
TURNS |= {f"anyhow {seed}": any_rotation(seed) for seed in range(3)}


@pytest.mark.parametrize("turn", TURNS)
@pytest.mark.parametrize(("tilt", "headings"), [(0, 1), (3, 2), (10, 4), (40, 4), (40, 2)])
def test_a_survey_is_set_upright_from_any_side(tilt: float, headings: int, turn: str) -> None:
    poses, points = TURNS[turn] @ flight(tilt, headings), ground() @ TURNS[turn].T
    found = turn_to_upright(poses, points)
    assert found is not None
    torch.testing.assert_close(found @ found.T, torch.eye(3), atol=1e-5, rtol=0)
    up = found @ TURNS[turn] @ UP
    assert float(up[2]) > np.cos(np.deg2rad(3))


def test_without_points_cameras_of_several_headings_show_what_is_up() -> None:
    found = turn_to_upright(SIDEWAYS @ flight(10, 4), None)
    assert found is not None and float((found @ SIDEWAYS @ UP)[2]) > np.cos(np.deg2rad(3))


@pytest.mark.parametrize(("roll", "known"), [(5.0, True), (8.5, True), (8.8, False), (20.0, False)])
def test_right_axes_show_the_vertical_where_they_are_level(roll: float, known: bool) -> None:
    """Of cameras that turn, and lean to the left and to the right in turns."""
    lean = torch.deg2rad(torch.tensor([roll, -roll])).repeat(12)
    angles = torch.arange(24) * math.tau / 24
    along = torch.stack([angles.cos(), angles.sin(), lean.tan()], dim=-1)
    found = _vertical_of(torch.nn.functional.normalize(along, dim=-1).double())
    assert (found is not None) == known
    assert found is None or float(found[2].abs()) > 0.99


@pytest.mark.parametrize(("turned", "known"), [(17.2, False), (17.7, True)])
def test_right_axes_show_the_vertical_where_they_turn(turned: float, known: bool) -> None:
    """By a sine of 0.3 to either side."""
    angles = torch.deg2rad(torch.tensor([turned, -turned])).repeat(12)
    rights = torch.stack([angles.cos(), angles.sin(), torch.zeros(24)], dim=-1).double()
    assert (_vertical_of(rights) is not None) == known


@pytest.mark.parametrize(("thickness", "flat"), [(0.34, True), (0.36, False)])
def test_a_layer_is_thin_beside_its_lesser_width(thickness: float, flat: bool) -> None:
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3).double()
    normal = _normal_of_layer(corners * torch.tensor([2.0, thickness, 1.0]))
    assert (normal is not None) == flat
    assert normal is None or normal.abs().tolist() == pytest.approx([0.0, 1.0, 0.0])


def test_without_points_cameras_that_are_held_alike_may_stand_before_a_wall() -> None:
    assert turn_to_upright(SIDEWAYS @ flight(0, 1), None) is None


def test_a_survey_that_is_upright_stays_as_it_is() -> None:
    for tilt, headings in ((0, 1), (10, 2), (45, 4)):
        assert turn_to_upright(flight(tilt, headings), ground()) is None
    slope = torch.tensor([[0.94, 0.0, 0.34], [0.0, 1.0, 0.0], [-0.34, 0.0, 0.94]])
    assert turn_to_upright(flight(0, 2), ground() @ slope.T) is None


@pytest.mark.parametrize(
    ("axis", "share", "wide"), [(0, 0.33, True), (0, 0.27, False), (1, 0.27, False)]
)
def test_cameras_that_are_held_alike_fly_where_they_spread_over_their_height(
    axis: int, share: float, wide: bool
) -> None:
    """By three tenths of it, in the direction in which they spread less."""
    poses, points = flight(3, 1).double(), ground().double()
    places = poses[:, :, 3]
    clearance = float(places[:, 2].median() - points[:, 2].median())
    places[:, axis] *= share * clearance / float(places[:, axis].std())
    assert _fly_over(poses, points, UP.double()) is wide


@pytest.mark.parametrize(("below", "above"), [(6, True), (7, False)])
def test_three_quarters_of_the_cameras_of_a_flight_are_above_nearly_all_points(
    below: int, above: bool
) -> None:
    poses, points = flight(3, 4).double(), ground().double()
    poses[:below, 2, 3] = points[:, 2].quantile(0.94)
    poses[below:, 2, 3] = points[:, 2].quantile(0.96)
    assert _fly_over(poses, points, UP.double()) is above


def test_photographs_of_other_things_stay_as_they_are() -> None:
    at_eye_level = around(24, 0.05), ground(0.4)
    wall = SIDEWAYS @ flight(3, 1), ground() @ SIDEWAYS.T
    few_steps = wall[0].clone()
    places = few_steps[:, :, 3] - few_steps[:, :, 3].mean(dim=0)
    few_steps[:, :, 3] -= 0.8 * places * torch.tensor([1.0, 0.0, 1.0])
    street = torch.stack([flight(89, 8)[n] for n in range(25)]), ground(0.02)
    for poses, points in (at_eye_level, (few_steps, wall[1]), street):
        assert turn_to_upright(poses, points) is None
    assert turn_to_upright(SIDEWAYS @ flight(3, 2)[:3], None) is None


@pytest.mark.scenes
@pytest.mark.parametrize("name", ["brighton_beach", "caliterra", "banana", "fox"])
def test_real_surveys_are_set_upright_and_a_statue_is_not(name: str, scenes: Path) -> None:
    meta = described(scenes / name)
    poses = torch.tensor([frame["transform_matrix"] for frame in meta["frames"]])[:, :3]
    points = read_ply(scenes / name / meta["ply_file_path"])
    assert turn_to_upright(poses, points) is None
    for turn in TURNS.values():
        found = turn_to_upright(turn @ poses, points @ turn.T)
        assert (found is None) == (name == "fox")
        assert found is None or float((found @ turn @ UP)[2]) > np.cos(np.deg2rad(5))


@pytest.fixture
def colmap_scene(scene: Path) -> Path:
    """A survey in the coordinates that structure from motion and nerfstudio leave it in."""

    def lay_down(meta: dict[str, Any]) -> None:
        for frame, pose in zip(meta["frames"], SIDEWAYS @ flight(3, 2, rows=3)):
            frame["transform_matrix"] = [*pose.tolist(), [0.0, 0.0, 0.0, 1.0]]
        meta.pop("orientation_override", None)
        meta["ply_file_path"] = "points.ply"

    change(scene, lay_down)
    write_ply(scene / "points.ply", (ground() @ SIDEWAYS.T).numpy())
    return scene


READERS: dict[str, Any] = {
    "leco-photographs": LecoPhotographsDataParserConfig,
    "nerfstudio-data": NerfstudioDataParserConfig,
}


@pytest.mark.parametrize("reader", READERS)
def test_a_survey_from_structure_from_motion_is_bounded_whatever_reads_it(
    reader: str, colmap_scene: Path
) -> None:
    config = LecoDataManagerConfig(dataparser=READERS[reader](data=colmap_scene))
    manager: Any = config.setup(device="cpu")
    for dataset in (manager.train_dataset, manager.eval_dataset):
        assert bool((dataset.cameras.camera_to_worlds[:, 2, 2] > 0.9).all())
    split = manager.dataparser.get_dataparser_outputs("test")  # as ns-render does
    assert bool((split.cameras.camera_to_worlds[:, 2, 2] > 0.9).all())
    if reader == "leco-photographs":  # nerfstudio's own leaves the points out
        found = survey(manager).bounds
        assert found.kind == "box" and "photographed from above" in found.reason
    _leads_back(manager.train_dataparser_outputs, colmap_scene)


def _leads_back(outputs: Any, scene: Path) -> None:
    """What the outputs say they did takes the file's cameras to the model's."""
    frames = {f["file_path"]: f["transform_matrix"] for f in described(scene)["frames"]}
    transform, scale = outputs.dataparser_transform.double(), outputs.dataparser_scale
    for path, camera in zip(outputs.image_filenames, outputs.cameras.camera_to_worlds):
        pose = torch.tensor(frames[f"images/{path.name}"], dtype=torch.float64)
        place = scale * (transform[:, :3] @ pose[:3, 3] + transform[:, 3])
        torch.testing.assert_close(place.float(), camera[:, 3], atol=1e-5, rtol=0)
        turned = (transform[:, :3] @ pose[:3, :3]).float()
        torch.testing.assert_close(turned, camera[:, :3], atol=1e-5, rtol=0)


def test_a_file_that_says_z_is_up_where_it_is_not_is_believed_and_doubted(
    colmap_scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    monkeypatch.setattr(data_manager, "say", said.append)
    change(colmap_scene, lambda meta: meta.update(orientation_override="none"))
    parser = LecoPhotographsDataParserConfig(data=colmap_scene)
    manager: Any = LecoDataManagerConfig(dataparser=parser).setup(device="cpu")
    assert not bool((manager.train_dataset.cameras.camera_to_worlds[:, 2, 2] > 0.9).any())
    assert sum("take orientation_override out of the file" in line for line in said) == 1


def test_it_is_left_on_its_side_where_that_is_asked_for(colmap_scene: Path) -> None:
    parser = LecoPhotographsDataParserConfig(data=colmap_scene)
    manager: Any = LecoDataManagerConfig(dataparser=parser, upright=False).setup(device="cpu")
    assert not bool((manager.train_dataset.cameras.camera_to_worlds[:, 2, 2] > 0.9).any())


def test_all_splits_are_turned_by_the_training_cameras(colmap_scene: Path) -> None:
    parser = LecoPhotographsDataParserConfig(data=colmap_scene).setup()
    read = upright_outputs(parser.get_dataparser_outputs)
    held_out = read("test")  # two cameras, of which nobody could tell what is up
    assert len(held_out.cameras) == 2
    assert bool((held_out.cameras.camera_to_worlds[:, 2, 2] > 0.9).all())
