"""The lens of each frame of a transforms.json. nerfstudio's readers know one lens model per scene,
and each leaves out some fields: what a file says is read here, and their cameras are held to it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from nerfstudio.cameras.cameras import CAMERA_MODEL_TO_TYPE, Cameras, CameraType
from torch import Tensor

from leco_plugin.scenes.input_error import InputError

DISTORTIONS = ("k1", "k2", "k3", "k4", "p1", "p2")
"""In the order of nerfstudio's `distortion_params`."""
PINHOLE_FIELDS = ("w", "h", "fl_x", "fl_y", "cx", "cy")
ANGLES = ("x_fov", "y_fov", "camera_angle_x", "camera_angle_y")
"""Fields of view: what instant-ngp and Blender write beside or instead of focal lengths."""
SHORTEST = 0.05
"""Of the width, the least focal length: a plane would show 169 degrees, and no lens bends so."""
OTHER_LENSES = ("k5", "k6", "s1", "s2", "s3", "s4", "b1", "b2", "skew", "omega", "xi")
"""Coefficients that programs write and nerfstudio's cameras lack."""
OTHER_MODES = ("latlong", "equirectangular", "orthographic", "lens_mode", "lens_model")
FTHETA = tuple(f"ftheta_p{number}" for number in range(5))
OTHERS = (*OTHER_LENSES, *OTHER_MODES, *FTHETA)
LENS_FIELDS = {*DISTORTIONS, *PINHOLE_FIELDS, *ANGLES, *OTHERS, "camera_model", "is_fisheye"}
LENS_FIELDS |= {"distortion_params", "rolling_shutter", "fisheye_crop_radius"}
MIXED = {CameraType.PERSPECTIVE, CameraType.FISHEYE}
"""Types that one scene may have side by side."""
FISHEYES = {CameraType.FISHEYE, CameraType.FISHEYE624}
UNDISTORTED = {CameraType.PERSPECTIVE, *FISHEYES}
"""Types for whose rays nerfstudio undoes the distortion."""
RENDERED_ONLY = ("OMNIDIRECTIONALSTEREO", "VR180")
"""How names of types begin of which nerfstudio makes whole pictures and no batch of rays."""
COEFFICIENTS_624 = 12
"""Of a FISHEYE624: nerfstudio makes no ray of one that has others."""
FAR_OUTSIDE = 4.0
"""Square of the normalised radius beyond which no image shows anything."""


@dataclass(frozen=True)
class Lens:
    """The lens of a frame, in pixels of its full size; None is not said. Without cx and cy it has
    the middle, if its size is said."""

    kind: CameraType | None
    fx: float | None
    fy: float | None
    cx: float | None
    cy: float | None
    width: float | None
    height: float | None
    distortion: list[float] | None
    angle_x: float | None = None
    """Field of view in radians, where it is said instead of `fx`."""
    angle_y: float | None = None
    crop_radius: float | None = None
    """Of the circle that a fisheye shows; None of other lenses."""

    def focal_lengths(
        self, width: float, height: float, factor: int
    ) -> tuple[float, float] | tuple[None, None]:
        """Focal lengths in pixels of a picture smaller by `factor`; None if the lens has none."""
        across = self.fx, self.angle_x, width if self.width is None else self.width / factor
        down = self.fy, self.angle_y, height if self.height is None else self.height / factor
        found = [
            0.5 * side / math.tan(0.5 * angle) if angle else focal and focal / factor
            for focal, angle, side in (across, down)
        ]
        one = found[0] or found[1]
        return (None, None) if one is None else (found[0] or one, found[1] or one)


def lens_of(meta: dict[str, Any], frame: dict[str, Any], where: str) -> Lens:
    """The lens of a frame: what it says goes before what its scene says. InputError, with `where`
    that is, for a number that is none, or a lens that nerfstudio lacks."""

    def said(name: str, positive: bool = True) -> float | None:
        value = frame.get(name, meta.get(name))
        return None if value is None else _number(value, name, where, positive)

    _refuse_other_lenses(meta | frame, where)
    (fx, angle_x), (fy, angle_y) = (_focal(meta, frame, axis, where) for axis in "xy")
    kind = _kind(meta | frame, where)
    distortion = _distortion(frame, kind, where) or _distortion(meta, kind, where)
    _refuse_without_rays(kind, distortion, where)
    cx, cy = said("cx", positive=False), said("cy", positive=False)
    width, height = said("w"), said("h")
    given, full = "", math.inf if width is None else width
    if fx and width and fx < SHORTEST * width and kind in (None, *MIXED):
        given = f"fl_x is {fx:g} where w is {width:g}"
    elif cx is not None and cy is not None and 0.0 <= min(cx, cy) <= max(cx, cy) <= 1.0 < full / 2:
        given = f"cx is {cx:g} and cy is {cy:g}"
    if given:
        remedy = "give focal lengths and cx, cy in pixels, not in shares"
        raise InputError(f"{where}: {given}: {remedy}")
    cx = width / 2 if cx is None and width is not None else cx
    cy = height / 2 if cy is None and height is not None else cy
    radius = said("fisheye_crop_radius") if kind in FISHEYES else None
    return Lens(kind, fx, fy, cx, cy, width, height, distortion, angle_x, angle_y, radius)


def set_lenses(cameras: Cameras, lenses: list[Lens | None], factor: int) -> None:
    """Gives each camera its lens, in place, or leaves it its own for None. Pictures are smaller by
    `factor` than lenses are for."""
    for name in ("fx", "fy", "cx", "cy", "camera_type", "distortion_params"):
        if (shared := getattr(cameras, name)) is not None:  # by all, where they had one value
            setattr(cameras, name, shared.expand(len(lenses), -1).clone())
    for number, lens in enumerate(lenses):
        if lens is None:
            continue
        size = float(cameras.width[number]), float(cameras.height[number])
        middle = (place and place / factor for place in (lens.cx, lens.cy))
        values = (*lens.focal_lengths(*size, factor), *middle)
        for name, value in zip(("fx", "fy", "cx", "cy"), values):
            if value is not None:
                getattr(cameras, name)[number] = value
        if lens.kind is not None:
            cameras.camera_type[number] = lens.kind.value
        if lens.distortion is not None:
            if cameras.distortion_params is None:
                cameras.distortion_params = torch.zeros(len(lenses), len(lens.distortion))
            cameras.distortion_params[number] = torch.tensor(lens.distortion)
    radius = next((lens.crop_radius for lens in lenses if lens and lens.crop_radius), None)
    if radius is not None:
        cameras.metadata = (cameras.metadata or {}) | {"fisheye_crop_radius": radius}
    elif cameras.metadata is not None:
        cameras.metadata.pop("fisheye_crop_radius", None)


def bend(slopes: Tensor, distortion: list[float] | None) -> tuple[Tensor, Tensor]:
    """Normalised image places [N, 2], x and y, as a lens distorts them (`DISTORTIONS`, OpenCV's),
    and whether it shows them: bool [N]. Radial distortion that no longer grows with the radius
    folds what is beyond back into the image. Far outside of any image places are left unbent."""
    k1, k2, k3, k4, p1, p2 = distortion or [0.0] * len(DISTORTIONS)
    (x, y), r = slopes.unbind(dim=-1), slopes.square().sum(dim=-1)
    radial = 1.0 + r * (k1 + r * (k2 + r * (k3 + r * k4)))
    bent_x = x * radial + 2.0 * p1 * x * y + p2 * (r + 2.0 * x * x)
    bent_y = y * radial + 2.0 * p2 * x * y + p1 * (r + 2.0 * y * y)
    bent = torch.stack([bent_x, bent_y], dim=-1)
    powers, squares = torch.arange(1, 5), torch.linspace(0.0, FAR_OUTSIDE, 1001)
    growth = (2 * powers + 1) * torch.tensor([k1, k2, k3, k4]) * squares[:, None] ** powers
    folded = squares[1.0 + growth.sum(dim=1) <= 0.0]
    folds_at = float(folded[0]) if len(folded) else math.inf
    return torch.where((r < FAR_OUTSIDE)[:, None], bent, slopes), r < folds_at


def check_together(lenses: list[Lens], where: str) -> None:
    """InputError for kinds that do not mix, or fisheyes with circles of several sizes."""
    kinds = {lens.kind or CameraType.PERSPECTIVE for lens in lenses}
    if len(kinds) > 1 and not kinds <= MIXED:
        names = " and ".join(sorted(kind.name for kind in kinds))
        raise InputError(f"{where} mixes {names}: make a scene of each")
    radii = {str(lens.crop_radius) for lens in lenses if lens.kind in FISHEYES}
    if len(radii) > 1:
        raise InputError(
            f"{where} gives its fisheyes a fisheye_crop_radius of {' and of '.join(sorted(radii))}:"
            " give all the same, or none and masks (mask_path) that hide what a lens does not show"
        )


def _number(value: Any, name: str, where: str, positive: bool = False) -> float:
    sound = type(value) in (int, float) and abs(value) < 1e9
    if not sound or (positive and not value >= 1e-3):
        wanted = "a positive number" if positive else "a number"
        given = f"{where}: {name} is {str(value)[:40]!r}, and not what a camera has"
        raise InputError(f"{given}: give {wanted}")
    return float(value)


def _focal(
    meta: dict[str, Any], frame: dict[str, Any], axis: str, where: str
) -> tuple[float | None, float | None]:
    """Focal length in pixels, or else the field of view in radians, of an axis."""
    for owner in (frame, meta):
        for name in (f"fl_{axis}", f"{axis}_fov", f"camera_angle_{axis}"):
            if owner.get(name) is None:
                continue
            value = _number(owner[name], name, where, positive=True)
            if name[:2] == "fl":
                return value, None
            angle = math.radians(value) if name[0] == axis else value
            if angle >= math.pi:
                wide = f"{name} is {value:g}, wider than a plane can show"
                raise InputError(f"{where}: {wide}: give fl_{axis}")
            return None, angle
    return None, None


def _kind(owner: dict[str, Any], where: str) -> CameraType | None:
    """The type of a frame's camera; None where nothing is said."""
    model = owner.get("camera_model")
    if "camera_model" in owner and model not in list(CAMERA_MODEL_TO_TYPE):
        known = ", ".join(CAMERA_MODEL_TO_TYPE)
        raise InputError(f"{where}: camera_model {str(model)[:40]!r} is none of {known}")
    kind = None if model is None else CAMERA_MODEL_TO_TYPE[model]
    if not owner.get("is_fisheye"):
        return kind
    if kind not in (None, *FISHEYES):
        raise InputError(f"{where}: camera_model is {model}, and is_fisheye is set: remove one")
    return kind or CameraType.FISHEYE


def _distortion(owner: dict[str, Any], kind: CameraType | None, where: str) -> list[float] | None:
    """In nerfstudio's order; None if nothing is said. InputError if nerfstudio would drop some."""
    values = [_number(owner.get(name, 0), name, where) for name in DISTORTIONS]
    if "distortion_params" in owner:
        listed = owner["distortion_params"]
        if not isinstance(listed, list):
            given = f"{where}: distortion_params is {str(listed)[:40]!r}"
            raise InputError(f"{given}: give a list of numbers")
        listed = [_number(value, "distortion_params", where) for value in listed]
        is_624 = kind is CameraType.FISHEYE624
        wanted = f"{COEFFICIENTS_624} numbers" if is_624 else ", ".join(DISTORTIONS)
        if len(listed) != (COEFFICIENTS_624 if is_624 else len(DISTORTIONS)):
            raise InputError(f"{where}: distortion_params has {len(listed)} numbers: give {wanted}")
        if any(values) and values != listed:
            raise InputError(f"{where}: distortion_params and k1.. differ: remove one")
        values = listed
    elif not any(name in owner for name in DISTORTIONS):
        return None
    if kind is not None and kind not in UNDISTORTED and any(values):
        fault = f"nerfstudio cannot undo the distortion of {kind.name}"
        raise InputError(f"{where}: {fault}: set it to 0, or undistort")
    return values


def _refuse_without_rays(
    kind: CameraType | None, distortion: list[float] | None, where: str
) -> None:
    """InputError for a lens of which nerfstudio makes no batch of rays."""
    if kind is not None and kind.name.startswith(RENDERED_ONLY):
        remedy = "cut the photographs into perspective ones, and give their camera_model"
        raise InputError(
            f"{where}: nerfstudio renders with a {kind.name}, it cannot train: {remedy}"
        )
    if kind is CameraType.FISHEYE624 and len(distortion or ()) != COEFFICIENTS_624:
        fault = f"a {kind.name} has {COEFFICIENTS_624} numbers of distortion_params"
        raise InputError(f"{where}: {fault}: give them, zeros where it has fewer")


def _refuse_other_lenses(owner: dict[str, Any], where: str) -> None:
    for name in OTHERS:
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
    shutter = owner.get("rolling_shutter")
    if any(shutter) if isinstance(shutter, list) else shutter:
        raise InputError(
            f"{where}: rolling_shutter is {str(shutter)[:60]}, and nerfstudio's cameras expose all "
            "rows at once: correct the photographs, or remove it where cameras stood still"
        )
    still = owner.get("transform_matrix")
    if any(owner.get(f"transform_matrix_{end}", still) != still for end in ("start", "end")):
        raise InputError(
            f"{where}: the camera moves from transform_matrix_start to transform_matrix_end while "
            "it exposes, which nerfstudio's cameras do not: give one transform_matrix"
        )
