"""Every field of a lens is read, or refused in one line; none is dropped."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import CAMERA_MODEL_TO_TYPE, Cameras, CameraType
from nerfstudio.model_components.ray_generators import RayGenerator
from scene_files import refused

from leco_plugin.scenes.lenses import (
    RENDERED_ONLY,
    UNDISTORTED,
    bend,
    check_together,
    lens_of,
    set_lenses,
)
from leco_plugin.scenes.scene_file import unused_fields

SCENE: dict[str, Any] = {
    "w": 40,
    "h": 30,
    "fl_x": 20.0,
    "fl_y": 21.0,
    "cx": 20,
    "cy": 15,
    "k1": 0.1,
}


def test_a_frame_goes_before_its_scene() -> None:
    frame = {"fl_x": 25.0, "camera_model": "OPENCV_FISHEYE", "k2": 0.2, "k4": 0.4}
    lens = lens_of(SCENE, frame, "here")
    assert (lens.fx, lens.fy, lens.kind) == (25.0, 21.0, CameraType.FISHEYE)
    assert lens.distortion == [0.0, 0.2, 0.0, 0.4, 0.0, 0.0]
    assert lens_of(SCENE, {}, "here").distortion == [0.1, 0, 0, 0, 0, 0]
    assert lens_of({"k4": 0.3}, {}, "here").distortion == [0, 0, 0, 0.3, 0, 0]


def test_fields_of_view_are_focal_lengths() -> None:
    angles = {"w": 40, "h": 30, "camera_angle_x": math.pi / 2, "y_fov": 90.0}
    lens = lens_of(angles, {}, "here")
    assert lens.focal_lengths(40, 30, 1) == pytest.approx((20.0, 15.0))
    assert lens.focal_lengths(20, 15, 2) == pytest.approx((10.0, 7.5))
    assert lens.focal_lengths(13, 10, 3) == pytest.approx((20 / 3, 5.0))  # 13 is rounded
    del angles["y_fov"]
    assert lens_of(angles, {}, "here").focal_lengths(40, 30, 1) == pytest.approx((20.0, 20.0))
    del angles["w"], angles["h"]  # the picture's own
    assert lens_of(angles, {}, "here").focal_lengths(50, 30, 1) == pytest.approx((25.0, 25.0))
    frame = {"camera_angle_x": 2 * math.atan(0.5)}  # goes before its scene, also by another name
    assert lens_of({"fl_x": 7.0}, frame, "here").focal_lengths(50, 30, 1) == pytest.approx((50, 50))


def test_a_lens_without_a_principal_point_has_the_middle_of_its_picture() -> None:
    sides = torch.full((1, 1), 20), torch.full((1, 1), 15)
    cameras = Cameras(torch.eye(4)[None, :3], *torch.ones(4, 1, 1), *sides)
    set_lenses(cameras, [lens_of({"w": 40, "h": 30, "fl_x": 30.0}, {}, "here")], 2)
    found = [float(getattr(cameras, name)) for name in ("fx", "fy", "cx", "cy")]
    assert found == [15.0, 15.0, 10.0, 7.5]


def test_each_camera_has_its_own_lens_and_all_one_circle() -> None:
    sides = torch.full((3, 1), 20), torch.full((3, 1), 15)
    cameras = Cameras(torch.eye(4)[None, :3].repeat(3, 1, 1), *torch.ones(4, 3, 1), *sides)
    frame = {"camera_model": "OPENCV_FISHEYE", "k2": 0.2, "fisheye_crop_radius": 8}
    lenses = [None, lens_of(SCENE, frame, "here"), lens_of(SCENE | {"cy": 11}, {}, "here")]
    set_lenses(cameras, lenses, 2)
    found = {name: getattr(cameras, name).flatten().tolist() for name in ("fx", "fy", "cx", "cy")}
    assert found == {
        "fx": [1, 10, 10],
        "fy": [1, 10.5, 10.5],
        "cx": [1, 10, 10],
        "cy": [1, 7.5, 5.5],
    }
    kinds = [CameraType(kind) for kind in cameras.camera_type.flatten().tolist()]
    assert kinds == [CameraType.PERSPECTIVE, CameraType.FISHEYE, CameraType.PERSPECTIVE]
    assert cameras.distortion_params is not None
    bent = torch.tensor([[0, 0, 0, 0, 0, 0], [0, 0.2, 0, 0, 0, 0], [0.1, 0, 0, 0, 0, 0]])
    torch.testing.assert_close(cameras.distortion_params, bent)
    assert cameras.metadata == {"fisheye_crop_radius": 8.0}
    set_lenses(cameras, [None, None, None], 2)
    assert cameras.metadata == {}


def test_a_fisheye_of_instant_ngp_is_one() -> None:
    assert lens_of({"is_fisheye": True}, {}, "here").kind is CameraType.FISHEYE
    assert lens_of({}, {"is_fisheye": True}, "here").kind is CameraType.FISHEYE
    assert lens_of({"is_fisheye": False}, {}, "here").kind is None


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"camera_model": "OPENCV", "is_fisheye": True}, "is_fisheye is set: remove one"),
        ({"camera_model": "FULL_OPENCV"}, "FULL_OPENCV' is none of"),
        ({"w": 800, "fl_x": 1.2, "cx": 0.5}, "fl_x is 1.2 where w is 800: give .* in pixels"),
        ({"k5": 0.1}, "k5 describes a lens"),
        ({"ftheta_p0": 0.1}, "ftheta_p0 describes a lens"),
        ({"equirectangular": True}, "equirectangular describes a lens"),
        ({"b1": 2.0}, "b1 describes a lens"),
        (
            {"camera_model": "EQUIRECTANGULAR", "k1": 0.1},
            "cannot undo the distortion of EQUIRECTANGULAR",
        ),
        ({"distortion_params": [0.0] * 6, "k1": 0.1}, "differ: remove one"),
        ({"distortion_params": [0.01] * 4}, "has 4 numbers: give k1, k2, k3, k4, p1, p2"),
        ({"from_mitsuba": True}, "from_mitsuba"),
        ({"transform_matrix_start": [1], "transform_matrix": [2]}, "the camera moves"),
        ({"k2": "0.1"}, "k2 is '0.1'"),
        ({"p2": float("nan")}, "p2 is 'nan'"),
        ({"distortion_params": None}, "distortion_params is 'None'"),
        ({"distortion_params": [0.0, float("inf")]}, "distortion_params is 'inf'"),
        ({"camera_model": "FISHEYE624", "k1": 0.1, "distortion_params": [0] * 6}, "12 numbers"),
        ({"camera_model": "FISHEYE624", "k1": 0.1}, "has 12 numbers of distortion_params: give"),
        ({"camera_model": "VR180_L"}, "cannot train: cut the photographs into perspective ones"),
        ({"distortion_params": [0.1] * 12}, "has 12 numbers: give k1"),
        ({"camera_model": ["OPENCV"]}, "is none of"),
        ({"fl_x": 0.0}, "fl_x is '0.0'.*give a positive number"),
        ({"fl_y": float("nan")}, "fl_y is 'nan'"),
        ({"w": True}, "w is 'True'"),
        ({"h": -3}, "h is '-3'"),
        ({"cx": "16"}, "cx is '16'"),
        ({"camera_angle_x": 3.2}, "wider than a plane.*give fl_x"),
        ({"y_fov": -60.0}, "y_fov is '-60.0'"),
        ({"rolling_shutter": [0.0, 0.0, 0.1, 0.0]}, "rolling_shutter.*correct the photographs"),
        ({"rolling_shutter": 0.1}, "rolling_shutter.*correct the photographs"),
        ({"is_fisheye": True, "fisheye_crop_radius": 0}, "fisheye_crop_radius is '0'"),
    ],
)
def test_what_would_be_dropped_is_refused(more: dict[str, Any], message: str) -> None:
    for meta, frame in ((more, {}), ({}, more)):
        with refused(f"here.*{message}"):
            lens_of(meta, frame, "here")


def test_what_says_nothing_is_no_lens_of_another_kind() -> None:
    lens_of({"k5": 0.0, "skew": 0, "lens_mode": "perspective", "rolling_shutter": [0] * 4}, {}, "x")


def test_perspective_and_fisheye_may_be_mixed_and_others_not() -> None:
    def kinds(*models: str) -> list[Any]:
        return [lens_of({}, {"camera_model": model}, "here") for model in models]

    check_together(kinds("OPENCV", "PINHOLE", "OPENCV_FISHEYE"), "here")
    check_together(kinds("EQUIRECTANGULAR", "EQUIRECTANGULAR"), "here")
    with refused("here mixes EQUIRECTANGULAR and PERSPECTIVE"):
        check_together(kinds("OPENCV", "EQUIRECTANGULAR"), "here")


def test_fields_that_are_not_used_are_said() -> None:
    frames = [{"file_path": "a.png", "sharpness": 3.0, "driver_parameters": {"LightX": 1.0}}]
    meta = {"frames": frames, "aabb_scale": 4, "envmap": "sky.png", "sharpen": 0, "mine": [1]}
    assert unused_fields(meta) == ["driver_parameters", "envmap", "mine"]


def rays(kind: CameraType, k1: float) -> torch.Tensor:
    """Origin and direction of a ray of a camera of a type."""
    numbers = 12 if kind is CameraType.FISHEYE624 else 6
    cameras = Cameras(
        torch.eye(4)[None, :3],
        *(torch.full((1, 1), value) for value in (30.0, 30.0, 16.0, 16.0)),
        width=32,
        height=32,
        distortion_params=torch.tensor([[k1] + [0.0] * (numbers - 1)]),
        camera_type=kind,
    )
    ray = cameras.generate_rays(0, coords=torch.tensor([[3.0, 5.0]]))
    return torch.cat([ray.origins, ray.directions], dim=-1)


def test_distortion_is_refused_where_nerfstudio_drops_it() -> None:
    for kind in (CameraType.PERSPECTIVE, CameraType.FISHEYE, CameraType.FISHEYE624):
        assert kind in UNDISTORTED and not torch.equal(rays(kind, 0.2), rays(kind, 0.0))
    for kind in (CameraType.EQUIRECTANGULAR, CameraType.ORTHOPHOTO):
        assert kind not in UNDISTORTED and torch.equal(rays(kind, 0.2), rays(kind, 0.0))
    for model in ("ORTHOPHOTO", "VR180_L", "OMNIDIRECTIONALSTEREO_R"):
        with refused(f"cannot undo the distortion of {model}"):
            lens_of({"camera_model": model}, {"k1": 0.1}, "here")


def test_lenses_of_which_nerfstudio_makes_no_batch_of_rays_are_refused() -> None:
    pixels = torch.tensor([[2, 5, 7], [0, 1, 30], [1, 9, 2], [2, 2, 2]])
    for model, kind in CAMERA_MODEL_TO_TYPE.items():
        said: dict[str, Any] = {"camera_model": model}
        said |= {"distortion_params": [0.0] * 12} if model == "FISHEYE624" else {}
        lens = torch.tensor(said["distortion_params"]).expand(3, -1) if len(said) > 1 else None
        cameras = Cameras(
            *(torch.eye(3, 4).expand(3, -1, -1), 30.0, 30.0, 16.0, 12.0, 32, 24, lens, kind)
        )
        if kind.name.startswith(RENDERED_ONLY):
            with pytest.raises((IndexError, RuntimeError)):
                RayGenerator(cameras)(pixels)
            with refused("cannot train"):
                lens_of(said, {}, "here")
        else:
            assert RayGenerator(cameras)(pixels).directions.shape == (4, 3)
            assert lens_of(said, {}, "here").kind is kind


def test_fisheyes_show_one_circle() -> None:
    def radii(*each: float | None) -> list[Any]:
        fisheye = {"camera_model": "OPENCV_FISHEYE"}
        said = [{} if radius is None else {"fisheye_crop_radius": radius} for radius in each]
        return [lens_of({}, {"fisheye_crop_radius": 7}, "here")] + [
            lens_of(fisheye, frame, "here") for frame in said
        ]

    check_together(radii(9, 9.0), "here")
    check_together(radii(None, None), "here")
    for each in ((9, 8), (9, None)):
        with refused(r"here gives its fisheyes .*masks"):
            check_together(radii(*each), "here")


def test_a_lens_bends_as_opencv_says() -> None:
    slopes = torch.rand(50, 2, generator=torch.Generator().manual_seed(0)) * 1.2 - 0.6
    k1, k2, k3, p1, p2 = 0.1, -0.05, 0.02, 0.03, -0.02
    places = np.pad(slopes.double().numpy(), ((0, 0), (0, 1)), constant_values=1.0)
    still = np.zeros(3)
    expected, _ = cv2.projectPoints(places, still, still, np.eye(3), np.array([k1, k2, p1, p2, k3]))
    found, shown = bend(slopes, [k1, k2, k3, 0.0, p1, p2])
    np.testing.assert_allclose(found.numpy(), expected[:, 0], rtol=1e-5)
    assert bool(shown.all())
    r = slopes.square().sum(dim=-1, keepdim=True)
    torch.testing.assert_close(bend(slopes, [0, 0, 0, 0.3, 0, 0])[0], slopes * (1.0 + 0.3 * r**4))
    assert torch.equal(bend(slopes, None)[0], slopes)


def test_a_lens_shows_nothing_beyond_where_it_folds_and_bends_nothing_far_outside() -> None:
    """With k1 -0.1 radii no longer grow where 3 x 0.1 r^2 is 1."""
    slopes = torch.tensor([3.3, 3.36, 3.9, 4.1]).sqrt()[:, None] * torch.tensor([[0.6, -0.8]])
    bent, shown = bend(slopes, [-0.1, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert shown.tolist() == [True, False, False, False]
    left = torch.tensor([[0.67], [0.664], [0.61], [1.0]])
    torch.testing.assert_close(bent, left * slopes)
