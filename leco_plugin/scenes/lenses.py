"""The lens of each frame of a transforms.json, whichever program wrote it.

nerfstudio's readers know one lens model per scene, and each of them leaves out some fields. What a
file says is read here, so that every reader's cameras can be held to it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from nerfstudio.cameras.cameras import CAMERA_MODEL_TO_TYPE, Cameras, CameraType

from leco_plugin.scenes.input_error import InputError

DISTORTIONS = ("k1", "k2", "k3", "k4", "p1", "p2")
"""In the order of nerfstudio's `distortion_params`."""
COUNTS = (len(DISTORTIONS), 12)
"""Numbers in `distortion_params`; 12 are those of FISHEYE624."""
PINHOLE_FIELDS = ("w", "h", "fl_x", "fl_y", "cx", "cy")
ANGLES = ("x_fov", "y_fov", "camera_angle_x", "camera_angle_y", "fovx", "fovy")
"""Fields of view: what instant-ngp and Blender write beside or instead of focal lengths."""
KINDS = ("camera_model", "is_fisheye")
OTHER_LENSES = ("k5", "k6", "s1", "s2", "s3", "s4", "b1", "b2", "skew", "omega", "xi")
"""Coefficients that programs write and nerfstudio's cameras lack."""
OTHER_MODES = ("latlong", "equirectangular", "orthographic", "lens_mode", "lens_model")
FTHETA = tuple(f"ftheta_p{number}" for number in range(5))
LENS_FIELDS = {*DISTORTIONS, *PINHOLE_FIELDS, *ANGLES, *KINDS, *OTHER_LENSES, *OTHER_MODES, *FTHETA}
LENS_FIELDS |= {"distortion_params", "rolling_shutter", "fisheye_crop_radius"}
MIXED = {CameraType.PERSPECTIVE, CameraType.FISHEYE}
"""Types that one scene may have side by side."""
STRAIGHT = {CameraType.EQUIRECTANGULAR, CameraType.ORTHOPHOTO}
"""Types for which nerfstudio undoes no distortion."""


@dataclass(frozen=True)
class Lens:
    """The lens of a frame in pixels of its full size; None is not said."""

    kind: CameraType | None
    fx: float | None
    fy: float | None
    cx: float | None
    cy: float | None
    width: float | None
    height: float | None
    distortion: list[float] | None


def lens_of(meta: dict[str, Any], frame: dict[str, Any], where: str) -> Lens:
    """The lens of a frame. What the frame says goes before what the scene says.

    Args:
        where: the file and the frame, for errors.
    Raises:
        InputError: one line; a number is none, or the lens is not one of nerfstudio's.
    """

    def said(name: str) -> float | None:
        value = frame.get(name, meta.get(name))
        return None if value is None else _number(value, name, where)

    _refuse_other_lenses(meta, frame, where)
    width, height = said("w"), said("h")
    fx = said("fl_x") or _focal(said("x_fov"), said("camera_angle_x"), width)
    fy = said("fl_y") or _focal(said("y_fov"), said("camera_angle_y"), height)
    kind, distortion = _kind(meta, frame, where), None
    owner = next((each for each in (frame, meta) if _distortion(each, where) is not None), None)
    if owner is not None:
        distortion = _distortion(owner, where)
    if kind in STRAIGHT and any(distortion or ()):
        raise InputError(
            f"{where}: nerfstudio undoes no distortion of {kind.name}: set it to 0, or undistort"
        )
    return Lens(kind, fx or fy, fy or fx, said("cx"), said("cy"), width, height, distortion)


def set_lenses(cameras: Cameras, lenses: list[Lens | None], factors: list[int]) -> None:
    """Gives each camera its lens; of None it keeps its own.

    Args:
        cameras: as a reader made them; changed in place.
        factors: by which pictures are smaller than the sizes that lenses are for.
    """
    for name in ("fx", "fy", "cx", "cy", "camera_type", "distortion_params"):
        shared = getattr(cameras, name)  # by all cameras, where they were given one value
        own = None if shared is None else shared.expand(len(lenses), -1).clone()
        setattr(cameras, name, own)
    for number, (lens, factor) in enumerate(zip(lenses, factors)):
        if lens is None:
            continue
        for name in ("fx", "fy", "cx", "cy"):
            value = getattr(lens, name)
            if value is not None:
                getattr(cameras, name)[number] = value / factor
        if lens.kind is not None:
            cameras.camera_type[number] = lens.kind.value
        if lens.distortion is not None:
            if cameras.distortion_params is None:
                cameras.distortion_params = torch.zeros(len(lenses), len(lens.distortion))
            cameras.distortion_params[number] = torch.tensor(lens.distortion)


def factor_of(meta: dict[str, Any], frame: dict[str, Any], width: int) -> int:
    """By which whole number a reader made a camera smaller than its file says.

    Args:
        width: of that camera; nerfstudio's readers take the scene's before the frame's.
    """
    full = meta.get("w", frame.get("w"))
    return 1 if full is None else max(1, round(float(full) / width))


def check_kinds(lenses: list[Lens], where: str) -> None:
    """All frames are of one type, or perspective and fisheye.

    Raises:
        InputError: one line.
    """
    kinds = {lens.kind or CameraType.PERSPECTIVE for lens in lenses}
    if len(kinds) > 1 and not kinds <= MIXED:
        names = " and ".join(sorted(kind.name for kind in kinds))
        raise InputError(f"{where} mixes {names}: make a scene of each")


def _number(value: Any, name: str, where: str) -> float:
    if type(value) not in (int, float) or not abs(value) < 1e9:
        raise InputError(f"{where}: {name} is {str(value)[:40]!r}, and not what a camera has")
    return float(value)


def _focal(degrees: float | None, radians: float | None, size: float | None) -> float | None:
    angle = math.radians(degrees) if degrees else radians
    return None if not angle or size is None else 0.5 * size / math.tan(0.5 * angle)


def _kind(meta: dict[str, Any], frame: dict[str, Any], where: str) -> CameraType | None:
    """The type of a frame's camera; None where nothing is said."""
    model = frame.get("camera_model", meta.get("camera_model"))
    if model is not None and model not in list(CAMERA_MODEL_TO_TYPE):
        known = ", ".join(CAMERA_MODEL_TO_TYPE)
        raise InputError(f"{where}: camera_model {str(model)[:40]!r} is none of {known}")
    kind = None if model is None else CAMERA_MODEL_TO_TYPE[model]
    if not frame.get("is_fisheye", meta.get("is_fisheye", False)):
        return kind
    if kind not in (None, CameraType.FISHEYE, CameraType.FISHEYE624):
        raise InputError(f"{where}: camera_model is {model}, and is_fisheye is set: remove one")
    return kind or CameraType.FISHEYE


def _distortion(owner: dict[str, Any], where: str) -> list[float] | None:
    """In nerfstudio's order; None where a scene or a frame says nothing."""
    named = [_number(owner.get(name, 0), name, where) for name in DISTORTIONS]
    if "distortion_params" not in owner:
        return named if any(name in owner for name in DISTORTIONS) else None
    listed = owner["distortion_params"]
    if not isinstance(listed, list):
        raise InputError(
            f"{where}: distortion_params is {str(listed)[:40]!r}, and not a list of numbers"
        )
    listed = [_number(value, "distortion_params", where) for value in listed]
    if len(listed) not in COUNTS:
        raise InputError(
            f"{where}: distortion_params has {len(listed)} numbers: give {', '.join(DISTORTIONS)}"
        )
    if any(named) and named != listed:
        raise InputError(f"{where}: distortion_params and {DISTORTIONS[0]}.. differ: remove one")
    return listed


def _refuse_other_lenses(meta: dict[str, Any], frame: dict[str, Any], where: str) -> None:
    """InputError for what would be dropped."""
    owner = meta | frame
    for name in (*OTHER_LENSES, *OTHER_MODES, *FTHETA):
        if owner.get(name) not in (None, 0, False, "perspective", "Perspective", "OpenCV"):
            raise InputError(
                f"{where}: {name} describes a lens that nerfstudio's cameras lack: undistort the "
                "photographs, and give the camera_model of the new ones"
            )
    if owner.get("from_mitsuba") or "normal_mts_args" in owner:
        raise InputError(
            f"{where}: from_mitsuba says that cameras look along +z: turn the poses to OpenGL's "
            "axes, and remove it"
        )
    still = owner.get("transform_matrix")
    if any(owner.get(f"transform_matrix_{end}", still) != still for end in ("start", "end")):
        raise InputError(
            f"{where}: the camera moves from transform_matrix_start to transform_matrix_end while "
            "it exposes, which nerfstudio's cameras do not: give one transform_matrix"
        )
