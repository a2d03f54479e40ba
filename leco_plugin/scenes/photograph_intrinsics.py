"""Intrinsics of photographs: numbers that a camera has, for the scene or for each frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from nerfstudio.cameras.cameras import CAMERA_MODEL_TO_TYPE

from leco_plugin.scenes.input_error import InputError

DISTORTIONS = ("k1", "k2", "k3", "k4", "p1", "p2")


def check_intrinsics(meta: dict[str, Any], frames: list[dict[str, Any]], description: Path) -> None:
    """Size, focal length, principal point, lens and distortion are such as a camera has.

    Raises:
        InputError: one line.
    """
    model = meta.get("camera_model")
    if "camera_model" in meta and model not in list(CAMERA_MODEL_TO_TYPE):
        known = ", ".join(CAMERA_MODEL_TO_TYPE)
        raise InputError(f"{description}: camera_model {str(model)[:40]!r} is none of {known}")
    for name in ("w", "h", "fl_x", "fl_y", "cx", "cy"):
        for frame in frames:
            # the scene's own goes before that of a frame, as in nerfstudio
            value = meta.get(name, frame.get(name))
            if value is None:
                raise InputError(f"{description}: {frame['file_path']} has no {name}")
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


def _distortions(owner: dict[str, Any]) -> list[tuple[str, Any]]:
    """Names and values of the distortion of a scene or a frame."""
    found = [(name, owner[name]) for name in DISTORTIONS if name in owner]
    listed = owner.get("distortion_params", [])
    values = listed if isinstance(listed, list) else [listed]
    return found + [("distortion_params", value) for value in values]
