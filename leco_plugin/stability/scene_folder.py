"""A case's scene on disk: a scene in nerfstudio's format, and beside it what is really there.

truth/NAME.npz holds, for each held-out picture, `depth` [h, w] in metres along the rays (inf for no
surface), `detail` [h, w], the pixels in which something is seen that the case is about, and
`shown_by` [h, w], how many training pictures show the same surface.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from leco_plugin.evaluation.report import read_object
from leco_plugin.scenes.city.layouts import POINTS, TRANSFORMS
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.whole_files import write_points
from leco_plugin.stability.capture import Capture, Shot, shots_of
from leco_plugin.stability.coverage import View, shown_by
from leco_plugin.stability.matter import Array
from leco_plugin.stability.stage import Seen, Stage, photograph
from leco_plugin.stability.stages import moving_car

DESCRIPTION, TRUTH = "stability.json", "truth"
_POINTS_PER_VIEW = 60


def write_scene(stage: Stage, capture: Capture, folder: Path) -> Path:
    """Writes the scene, unless `folder` holds just this one; it appears only when it is complete.

    Returns:
        `folder`.
    Raises:
        InputError: `folder` holds no scene of ours.
    """
    digest = digest_of(stage, capture)
    shots = shots_of(capture)
    if folder.exists() and not (folder / DESCRIPTION).is_file():
        raise InputError(f"{folder} holds something else; delete it, or name a new --out")
    if folder.exists():
        if _is_whole(folder, digest, shots):
            return folder
        shutil.rmtree(folder)
    unfinished = folder.with_name(f".{folder.name}-{os.getpid()}")
    shutil.rmtree(unfinished, ignore_errors=True)
    for name in ("images", TRUTH):
        (unfinished / name).mkdir(parents=True)
    all_seen: list[Seen] = []
    for number, shot in enumerate(shots):
        with_car = stage.with_shapes(moving_car(number)) if shot.moving else stage
        all_seen.append(photograph(with_car, shot.pose, capture.lens(shot.size)))
        _write_image(unfinished, shot, all_seen[-1])
    _write_truth(unfinished, capture, shots, all_seen)
    points = (
        _points(seen, shot, capture, n) for n, (seen, shot) in enumerate(zip(all_seen, shots))
    )
    cloud = np.concatenate(list(points))
    if len(cloud):
        write_points(unfinished / POINTS, cloud)
    transforms = _transforms(shots, capture, bool(len(cloud)))
    (unfinished / TRANSFORMS).write_text(json.dumps(transforms, indent=1) + "\n")
    described = {"digest": digest, "capture": dataclasses.asdict(capture)}
    (unfinished / DESCRIPTION).write_text(json.dumps(described, indent=1) + "\n")
    unfinished.replace(folder)
    return folder


def digest_of(stage: Stage, capture: Capture) -> str:
    """The same for the same pictures."""
    return hashlib.sha256(repr((stage, capture)).encode()).hexdigest()[:16]


def _is_whole(folder: Path, digest: str, shots: list[Shot]) -> bool:
    """Whether a folder holds all files of the scene with this digest."""
    try:
        if read_object(folder / DESCRIPTION, "is damaged").get("digest") != digest:
            return False
    except InputError:
        return False
    files = [TRANSFORMS, *(_file(shot) for shot in shots)]
    files += [_truth(shot) for shot in shots if shot.held_out]
    return all((folder / name).is_file() for name in files)


def _write_image(folder: Path, shot: Shot, seen: Seen) -> None:
    image = seen.image.copy()
    if shot.gain != 1.0:
        light = image[..., :3].astype(float) * shot.gain
        image[..., :3] = np.rint(light.clip(0, 255)).astype(np.uint8)
    Image.fromarray(image).save(folder / _file(shot))


def _write_truth(folder: Path, capture: Capture, shots: list[Shot], all_seen: list[Seen]) -> None:
    views = [
        View(shot.pose, capture.lens(shot.size), seen.depth) for shot, seen in zip(shots, all_seen)
    ]
    trained = [view for shot, view in zip(shots, views) if not shot.held_out]
    for shot, seen, view in zip(shots, all_seen, views):
        if shot.held_out:
            facts = {
                "depth": seen.depth,
                "detail": seen.detail,
                "shown_by": shown_by(view, trained),
            }
            np.savez(folder / _truth(shot), **facts)


def _file(shot: Shot) -> str:
    return f"images/{shot.name}.png"


def _truth(shot: Shot) -> str:
    return f"{TRUTH}/{shot.name}.npz"


def _points(seen: Seen, shot: Shot, capture: Capture, number: int) -> NDArray[Any]:
    """Some surface points, where the written poses put them: [N] rows of `xyz` and `rgb`."""
    random = np.random.default_rng([capture.seed, 23, number])
    hits = np.argwhere(np.isfinite(seen.depth))
    chosen = tuple(hits[random.permutation(len(hits))[:_POINTS_PER_VIEW]].T)
    row = np.empty(len(chosen[0]), dtype=[("xyz", "<f4", 3), ("rgb", "u1", 3)])
    row["xyz"] = capture.lens(shot.size).points(shot.written, seen.depth)[chosen]
    row["rgb"] = seen.image[chosen][:, :3]
    return row


def _matrix(pose: Array) -> list[list[float]]:
    return [*pose.tolist(), [0.0, 0.0, 0.0, 1.0]]


def _transforms(shots: list[Shot], capture: Capture, with_points: bool) -> dict[str, Any]:
    frames = []
    for shot in shots:
        lens = capture.lens(shot.size)
        size = {"w": lens.width, "h": lens.height, "cx": lens.width / 2, "cy": lens.height / 2}
        focal = {"fl_x": lens.focal, "fl_y": lens.focal}
        pose = {"file_path": _file(shot), "transform_matrix": _matrix(shot.written)}
        frames.append({**pose, **size, **focal})
    trained = [_file(shot) for shot in shots if not shot.held_out]
    held_out = [_file(shot) for shot in shots if shot.held_out]
    return {
        "camera_model": "OPENCV",
        "orientation_override": "none",
        **({"ply_file_path": POINTS} if with_points else {}),
        "frames": frames,
        "train_filenames": trained,
        "val_filenames": held_out,
        "test_filenames": held_out,
    }
