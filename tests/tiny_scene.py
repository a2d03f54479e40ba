"""A scene small enough to train on in seconds: a ball on a chequered floor, cast in closed form."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from PIL import Image

BALL_CENTRE = np.array([0.0, 0.0, 0.3])
BALL_RADIUS = 0.3


def camera_to_world(azimuth: float, radius: float = 1.0, height: float = 0.7) -> np.ndarray:
    """[4, 4] pose of a camera on a circle that looks at the ball (x right, y up, z back)."""
    position = np.array([radius * np.cos(azimuth), radius * np.sin(azimuth), height])
    back = position - BALL_CENTRE
    back /= np.linalg.norm(back)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(back, right), back, position], axis=1)
    return pose


def shade(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """[N, 3] colours in 0..1 of rays [N, 3]: the ball first, then the floor z = 0, then the sky."""
    colours = np.tile([0.6, 0.75, 0.95], (len(origins), 1))

    with np.errstate(divide="ignore", invalid="ignore"):
        to_floor = -origins[:, 2] / directions[:, 2]
    floor = origins + to_floor[:, None] * directions
    on_floor = (to_floor > 0) & (np.abs(floor[:, :2]).max(axis=1) < 1.5)
    chequer = (np.floor(4 * floor[:, 0]) + np.floor(4 * floor[:, 1])) % 2
    colours[on_floor] = np.where(chequer[on_floor, None] > 0, [0.85, 0.8, 0.7], [0.3, 0.35, 0.3])

    offset = origins - BALL_CENTRE
    half_b = (offset * directions).sum(axis=1)
    discriminant = half_b**2 - (offset**2).sum(axis=1) + BALL_RADIUS**2
    on_ball = discriminant > 0
    hit = origins - (half_b + np.sqrt(np.maximum(discriminant, 0)))[:, None] * directions
    normals = (hit - BALL_CENTRE) / BALL_RADIUS
    colours[on_ball] = (0.55 + 0.45 * normals)[on_ball]
    return colours


def write(folder: Path, train: int = 7, test: int = 2, size: int = 32) -> Path:
    """Writes the scene in nerfstudio's format, the split in transforms.json; returns `folder`."""
    images = folder / "images"
    images.mkdir(parents=True)
    focal = float(size)
    rows, columns = np.mgrid[:size, :size] + 0.5
    in_camera = np.stack(
        [(columns - size / 2) / focal, (size / 2 - rows) / focal, -np.ones_like(rows)], axis=-1
    )

    names = [f"images/{index:03d}.png" for index in range(train + test)]
    frames = []
    for index, name in enumerate(names):
        pose = camera_to_world(2 * np.pi * index / len(names))
        directions = in_camera.reshape(-1, 3) @ pose[:3, :3].T
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        colours = shade(np.broadcast_to(pose[:3, 3], directions.shape), directions)
        pixels = np.round(255 * colours.clip(0, 1)).astype(np.uint8).reshape(size, size, 3)
        Image.fromarray(pixels).save(folder / name)
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})

    held_out = names[:: len(names) // test][:test]
    scene = {
        "camera_model": "OPENCV",
        "w": size,
        "h": size,
        "fl_x": focal,
        "fl_y": focal,
        "cx": size / 2,
        "cy": size / 2,
        "orientation_override": "none",
        "train_filenames": [name for name in names if name not in held_out],
        "test_filenames": held_out,
        "val_filenames": held_out,
        "frames": frames,
    }
    (folder / "transforms.json").write_text(json.dumps(scene, indent=1))
    return folder
