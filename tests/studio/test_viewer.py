"""Where nerfstudio's viewer opens, and when it closes."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
import viser
from nerfstudio.cameras.cameras import Cameras

from leco_plugin.studio.viewer import View, first_view, middle_view, stay_open, upright_look


def looking(directions: list[list[float]], places: list[list[float]]) -> torch.Tensor:
    """Poses [C, 3, 4] that look so from there; where that is down, their top is +y."""
    poses = []
    for direction, place in zip(directions, places):
        back = -torch.nn.functional.normalize(torch.tensor(direction), dim=0)
        top = torch.tensor([0.0, 1.0, 0.0]) if abs(back[2]) > 0.9 else torch.tensor([0.0, 0, 1])
        right = torch.nn.functional.normalize(torch.linalg.cross(top, back), dim=0)
        poses.append(
            torch.stack([right, torch.linalg.cross(back, right), back, torch.tensor(place)], dim=1)
        )
    return torch.stack(poses)


def test_a_survey_opens_on_the_middle_one_of_those_that_look_down() -> None:
    down, slant = [0.0, 0.0, -1.0], [0.5, 0.0, -1.0]
    places = [[-1.0, 0.0, 1.0], [0.1, 0.0, 1.0], [0.0, 0.0, 1.0], [1.0, 0.0, 1.0]]
    assert middle_view(looking([down, down, slant, down], places)) == 1


def test_other_scenes_open_on_the_training_view_in_the_middle() -> None:
    places = [[-1.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.2, 0.0, 0.0], [1.0, 0.0, 0.0]]
    assert middle_view(looking([[0.0, 1.0, 0.0]] * 4, places)) in (1, 2)


def test_a_view_straight_down_keeps_its_heading_and_turns_about_the_ground() -> None:
    poses = looking([[0.0, 0.0, -1.0]] * 3, [[0.0, 0.0, 1.0]] * 3)
    cameras = Cameras(poses, 100.0, 100.0, 100.0, 50.0, width=200, height=100)
    view = first_view(cameras, torch.tensor([[0.3, 0.1, -1.0]] * 9), frustum=0.01)
    assert view.look_at[2] == pytest.approx(-1.0, abs=0.05)
    look = view.look_at - view.position
    assert look[1] > 0.0 and abs(float(look[0])) < 1e-6  # a little to the top of the photograph
    # beyond the picture that the viewer draws before the camera
    assert 0.005 < 1.0 - float(view.position[2]) < 0.1


@pytest.mark.parametrize("tilt", [[0.2, 0.0], [-0.2, 0.0], [0.0, -0.2], [0.0, 0.5]])
def test_a_tilted_photograph_of_the_ground_keeps_its_top(tilt: list[float]) -> None:
    (pose,) = looking([[*tilt, -1.0]], [[0.0, 0.0, 1.0]])  # its top is +y
    look = upright_look(pose)
    assert abs(float(look[0])) < 1e-6 and float(look[1]) > 0.0  # z kept upright, +y is the top
    assert float(look @ -pose[:, 2]) > 0.95


def test_a_level_view_is_looked_along_as_it_is() -> None:
    (pose,) = looking([[0.3, 1.0, -0.2]], [[0.0, 0.0, 1.0]])
    torch.testing.assert_close(upright_look(pose), -pose[:, 2])


@pytest.mark.parametrize(("aspect", "tangent"), [(1.0, 0.5), (2.0, 0.5), (4.0, 0.25)])
def test_no_window_shows_more_than_the_photograph(aspect: float, tangent: float) -> None:
    view = View(torch.zeros(3), torch.ones(3), (1.0, 0.5))
    assert view.field_of_view(aspect) == pytest.approx(2.0 * math.atan(tangent))


class Server(viser.ViserServer):
    """A server that was asked `looks` times before its last page closed."""

    def __init__(self, pages: list[dict[int, Any]]) -> None:
        self.pages = pages

    def get_clients(self) -> dict[int, Any]:
        return self.pages.pop(0)


class Viewer:
    def __init__(self, *pages: int) -> None:
        self.viser_server = Server([dict.fromkeys(range(count)) for count in pages])
        self.drawn = 0

    def _trigger_rerender(self) -> None:
        self.drawn += 1


def test_a_viewer_stays_open_while_a_page_is(printed: Any) -> None:
    viewer = Viewer(2, 1, 1, 0)
    stay_open(viewer)
    assert viewer.viser_server.pages == [] and viewer.drawn == 1
    assert "stays open" in printed()


def test_a_viewer_closes_at_once_where_nobody_is(printed: Any) -> None:
    stay_open(Viewer(0))
    stay_open(None)
    assert printed() == ""
