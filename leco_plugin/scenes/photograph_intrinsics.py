"""Intrinsics of photographs: numbers that a camera has, for the scene or for each frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from nerfstudio.cameras.cameras import CAMERA_MODEL_TO_TYPE

from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.lenses import ANGLES, DISTORTIONS, PINHOLE_FIELDS, check_kinds, lens_of


def check_intrinsics(meta: dict[str, Any], frames: list[dict[str, Any]], description: Path) -> None:
    """Size, focal length, principal point, lens and distortion are such as a camera has.

    Raises:
        InputError: one line.
    """
    model = meta.get("camera_model")
    if "camera_model" in meta and model not in list(CAMERA_MODEL_TO_TYPE):
        known = ", ".join(CAMERA_MODEL_TO_TYPE)
        raise InputError(f"{description}: camera_model {str(model)[:40]!r} is none of {known}")
    for name in PINHOLE_FIELDS:
        for frame in frames:
            value = frame.get(name, meta.get(name))
            if value is None:
                hint = (
                    "; `ns-train METHOD --data DIR instant-ngp-data` reads fields of view instead"
                    if any(angle in meta for angle in ANGLES)
                    else ""
                )
                raise InputError(f"{description}: {frame['file_path']} has no {name}{hint}")
            sound = type(value) in (int, float) and abs(value) < 1e9
            if not sound or (name[0] != "c" and not value >= 1e-3):
                raise InputError(
                    f"{description}: {name} of {frame['file_path']} is {str(value)[:40]!r}, and "
                    "not what a camera has"
                )
    for owner, who in ((meta, "the scene"), *((frame, frame["file_path"]) for frame in frames)):
        for name, value in _distortions(owner):
            # nerfstudio would take what it cannot undo for no distortion at all
            if type(value) not in (int, float) or not abs(value) < 1e9:
                raise InputError(
                    f"{description}: {name} of {who} is {str(value)[:40]!r}, and not a number"
                )
    check_kinds(
        [lens_of(meta, frame, f"{description}: {frame['file_path']}") for frame in frames],
        str(description),
    )


def _distortions(owner: dict[str, Any]) -> list[tuple[str, Any]]:
    """Names and values of the distortion of a scene or a frame."""
    found = [(name, owner[name]) for name in DISTORTIONS if name in owner]
    listed = owner.get("distortion_params", [])
    values = listed if isinstance(listed, list) else [listed]
    return found + [("distortion_params", value) for value in values]
