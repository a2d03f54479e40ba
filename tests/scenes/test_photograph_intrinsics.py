"""Intrinsics that no camera has are refused in one line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.photograph_intrinsics import check_intrinsics

SOUND: dict[str, Any] = {"w": 4, "h": 3, "fl_x": 2.0, "fl_y": 2.0, "cx": 2, "cy": -1.5}
FRAMES = [{"file_path": "a.png"}, {"file_path": "b.png"}]


@pytest.mark.parametrize(
    "more",
    [
        {},
        {"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k4": 0},
        {"distortion_params": [0.1, 0, 0, 0, 0, 0]},
    ],
)
def test_what_a_camera_has_is_accepted(more: dict[str, Any]) -> None:
    check_intrinsics(SOUND | more, FRAMES, Path("scene"))
    check_intrinsics({}, [frame | SOUND | more for frame in FRAMES], Path("scene"))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"camera_model": "PINHOLE_OF_MINE"}, "camera_model 'PINHOLE_OF_MINE' is none of"),
        ({"camera_model": ["OPENCV"]}, "camera_model .* is none of"),
        ({"k1": float("nan")}, "k1 of the scene is 'nan'"),
        ({"p2": "0.1"}, "p2 of the scene is '0.1'"),
        ({"distortion_params": [0.0, float("inf")]}, "distortion_params of the scene is 'inf'"),
        ({"distortion_params": None}, "distortion_params of the scene is 'None'"),
        ({"fl_x": 0.0}, "fl_x of a.png is '0.0'"),
        ({"w": True}, "w of a.png is 'True'"),
    ],
)
def test_what_no_camera_has_is_refused_in_one_line(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        check_intrinsics(SOUND | wrong, FRAMES, Path("scene"))
    assert "\n" not in str(caught.value)


def test_a_frame_may_have_intrinsics_of_its_own_and_is_named() -> None:
    frames = [frame | SOUND for frame in FRAMES]
    frames[1]["k2"] = float("nan")
    with pytest.raises(InputError, match=r"k2 of b\.png"):
        check_intrinsics({}, frames, Path("scene"))
    del frames[1]["k2"], frames[1]["h"]
    with pytest.raises(InputError, match=r"b\.png has no h"):
        check_intrinsics({}, frames, Path("scene"))
