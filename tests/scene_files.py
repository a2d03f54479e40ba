"""Scenes as tests of their readers write and change them, and errors that are one line."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from leco_plugin.scenes.coloured_points import read_cloud
from leco_plugin.scenes.input_error import InputError


@contextmanager
def refused(message: str) -> Iterator[pytest.ExceptionInfo[InputError]]:
    """What is done here ends in an `InputError` of one line that matches."""
    with pytest.raises(InputError, match=message) as caught:
        yield caught
    assert "\n" not in str(caught.value)


def described(scene: Path) -> dict[str, Any]:
    """What a scene's transforms.json says."""
    meta: dict[str, Any] = json.loads((scene / "transforms.json").read_text())
    return meta


def change(scene: Path, edit: Callable[[dict[str, Any]], object]) -> dict[str, Any]:
    """Edits a scene's transforms.json; returns what it says then."""
    meta = described(scene)
    edit(meta)
    (scene / "transforms.json").write_text(json.dumps(meta))
    return meta


def write_ply(path: Path, points: np.ndarray) -> None:
    """Points [P, 3] as an ascii file."""
    axes = "".join(f"property double {axis}\n" for axis in "xyz")
    rows = "".join(" ".join(f"{value:.9f}" for value in row) + "\n" for row in points)
    head = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n{axes}end_header\n"
    path.write_text(head + rows)


def write_colmap(scene: Path, model: Path, camera: str, points: np.ndarray) -> None:
    """The cameras of a scene, and points [P, 3], as COLMAP's own files."""
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text(f"1 {camera}\n")
    lines = []
    for number, frame in enumerate(described(scene)["frames"]):
        pose = np.array(frame["transform_matrix"])[:3]
        turn = (pose[:, :3] * [1.0, -1.0, -1.0]).T
        x, y, z, w = Rotation.from_matrix(turn).as_quat()
        values = " ".join(f"{value:.17g}" for value in (w, x, y, z, *(-turn @ pose[:, 3])))
        lines.append(f"{number + 1} {values} 1 {Path(frame['file_path']).name}\n\n")
    (model / "images.txt").write_text("".join(lines))
    places = (" ".join(f"{value:.9f}" for value in point) for point in points)
    rows = [f"{number + 1} {place} 9 9 9 0.5 1 0\n" for number, place in enumerate(places)]
    (model / "points3D.txt").write_text("".join(rows))


def read_ply(path: Path, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    """The vertices [P, 3] of a file of points."""
    return torch.from_numpy(read_cloud(path).positions).to(dtype)
