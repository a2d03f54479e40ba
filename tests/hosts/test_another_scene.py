"""A run on another scene than its occupancy's is refused where that is certain, else warned of."""

from __future__ import annotations

import copy
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from ball_occupancy import ball_of_the_tiny_scene
from scene_readers import Data, Pipe, started
from torch import nn

from leco_plugin.hosts.guide import Guide
from leco_plugin.hosts.guided_start import (
    GuidedStart,
    OccupancyConfig,
    refuse_another_scene,
)
from leco_plugin.learning.run import LearningOnly
from leco_plugin.occupancy import Occupancy
from leco_plugin.scenes.frames import frame_of
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.survey import MOST_CAMERAS

pytestmark = pytest.mark.usefixtures("without_cache")


def test_an_occupancy_of_another_scene_is_refused_unless_the_run_began_with_it(data: Data) -> None:
    elsewhere = ball_of_the_tiny_scene([[1, 0, 0, 50.0], [0, 1, 0, 50.0], [0, 0, 1, 50.0]])
    elsewhere.report = {"frame": torch.eye(3, 4).tolist()}
    with pytest.raises(InputError, match=r"keeps nothing .* learned on another scene") as error:
        started(elsewhere, data)
    assert "\n" not in str(error.value)
    (guide := Guide()).set_occupancy(elsewhere)
    (resumed := LearningOnly()).start = 90
    GuidedStart(nn.Module(), guide, OccupancyConfig(), Pipe(data), resumed)


ANOTHER = "the occupancy seems to be of another scene"


def learned_by(data: Data, **report: Any) -> Occupancy:
    """The ball, as a run on these cameras would leave it."""
    occupancy = ball_of_the_tiny_scene(frame_of(data) or [])
    places = data.train_dataset.cameras.camera_to_worlds[:, :3, 3]
    occupancy.report |= {"cameras": places.tolist()} | report
    return occupancy


def of_other_cameras(data: Data, by: float = 0.05, times: int = 1) -> Occupancy:
    """The ball, as if learned on cameras that lie elsewhere: as many as a file names, at most."""
    places = data.train_dataset.cameras.camera_to_worlds[:, :3, 3] + by
    return learned_by(data, cameras=(times * places.tolist())[:MOST_CAMERAS])


def with_points(data: Data, *place: float) -> Data:
    """The scene with its sparse points around a place."""
    made = copy.copy(data)
    points = torch.tensor(place) + 0.01 * torch.randn(64, 3)
    metadata = {"points3D_xyz": points}
    made.train_dataset = SimpleNamespace(cameras=data.train_dataset.cameras, metadata=metadata)
    return made


IN_THE_BALL, IN_THE_AIR = (0.0, 0.0, 0.3), (0.9, 0.9, 0.3)


def test_an_occupancy_of_other_cameras_is_refused_in_a_line_that_names_the_way_to_insist(
    data: Data, capsys: pytest.CaptureFixture[str]
) -> None:
    other, eye = of_other_cameras(data), torch.eye(3, 4)
    many = of_other_cameras(data, times=MOST_CAMERAS // 7 + 1)
    with pytest.raises(InputError, match="is of another scene"):
        refuse_another_scene(many, with_points(data, *IN_THE_AIR), eye)
    for here in (data, with_points(data, *IN_THE_BALL)):
        with pytest.raises(InputError, match="is of another scene: none of the 7 cameras") as error:
            refuse_another_scene(other, here, eye)
        said = str(error.value)
        assert "\n" not in said and "--other-scene" in said
        assert "--pipeline.model.occupancy.other-scene True" in said
    assert ANOTHER not in " ".join(capsys.readouterr().out.split())
    with pytest.raises(InputError, match="is of another scene"):
        started(other, data)
    (guide := Guide()).set_occupancy(other)
    GuidedStart(nn.Module(), guide, OccupancyConfig(other_scene=True), Pipe(data))
    (resumed := LearningOnly()).start = 90
    GuidedStart(nn.Module(), guide, OccupancyConfig(), Pipe(data), resumed)
    said = " ".join(capsys.readouterr().out.split())
    assert said.count(ANOTHER) == 2 and "of the 7 cameras that its file names 0" in said


def test_cameras_that_may_be_of_the_same_scene_are_only_warned_of(
    data: Data, capsys: pytest.CaptureFixture[str]
) -> None:
    """Some of many photographs, and coordinates that a reader rounds."""
    eye = torch.eye(3, 4)
    rounded = of_other_cameras(data, 2e-3 * 3.0**-0.5 * float(learned_by(data).space.half_extent))
    refuse_another_scene(rounded, data, eye)
    many = of_other_cameras(data, times=MOST_CAMERAS // 7 + 1)
    refuse_another_scene(many, with_points(data, *IN_THE_BALL), eye)
    refuse_another_scene(many, data, eye)
    assert " ".join(capsys.readouterr().out.split()).count(ANOTHER) == 3


@pytest.mark.parametrize("kept", [1, 3, 9])
def test_photographs_that_were_added_or_taken_away_are_no_other_scene(
    kept: int, readers: dict[str, Data], capsys: pytest.CaptureFixture[str]
) -> None:
    """Nor is another reader."""
    occupancy = learned_by(readers["turned by pca"])
    occupancy.report["cameras"] = occupancy.report["cameras"][:kept]
    started(occupancy, readers["turned up"])
    assert ANOTHER not in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(("found", "named", "here"), [(1, 10, 40), (1, 40, 7), (2, 30, 17)])
def test_a_tenth_of_the_fewer_cameras_is_enough(
    found: int, named: int, here: int, data: Data, capsys: pytest.CaptureFixture[str]
) -> None:
    """Whether the file names fewer cameras or the run has fewer; one less is warned of."""
    places = data.train_dataset.cameras.camera_to_worlds[:1].repeat(here, 1, 1)
    places[:, 0, 3] += torch.arange(here)
    run = SimpleNamespace(
        train_dataset=SimpleNamespace(cameras=SimpleNamespace(camera_to_worlds=places))
    )
    for same, is_warned in ((found, False), (found - 1, True)):
        cameras = places[:same, :, 3].tolist() + (named - same) * [[0.0, 90.0, 0.0]]
        occupancy = learned_by(data, cameras=cameras)
        refuse_another_scene(occupancy, run, torch.eye(3, 4), insists=True)
        assert (ANOTHER in " ".join(capsys.readouterr().out.split())) == is_warned


def test_another_split_is_no_other_scene(data: Data, capsys: pytest.CaptureFixture[str]) -> None:
    """It was learned on what is tested on here."""
    data = copy.copy(data)
    occupancy = learned_by(data)
    data.eval_dataset = data.train_dataset
    data.train_dataset = SimpleNamespace(
        cameras=copy.copy(data.eval_dataset.cameras), metadata=data.eval_dataset.metadata
    )
    data.train_dataset.cameras.camera_to_worlds = (
        data.eval_dataset.cameras.camera_to_worlds + torch.tensor([0.0, 0.0, 0.0, 0.03])
    )
    frame = torch.eye(3, 4)
    refuse_another_scene(occupancy, data, frame)
    assert ANOTHER not in capsys.readouterr().out
    data.eval_dataset = None
    with pytest.raises(InputError, match="another scene"):
        refuse_another_scene(occupancy, data, frame)


@pytest.mark.parametrize("cameras", [None, [], "none", [[0.0]]])
def test_a_file_that_names_no_cameras_is_not_compared(
    cameras: Any, data: Data, capsys: pytest.CaptureFixture[str]
) -> None:
    started(learned_by(data, cameras=cameras), data)
    assert ANOTHER not in " ".join(capsys.readouterr().out.split())
