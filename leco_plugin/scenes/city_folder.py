"""The city as a nerfstudio scene on disk, written once and never left half done.

images/*.png       the pictures
depths/*.npy       float32 [h, w], millimetres along the viewing axis, 0 where nothing is met:
                   what nerfstudio's depth methods read by default
transforms.json    cameras and splits
sparse_pc.ply      some visible surface points, like those of structure from motion
city.json          the configuration, from which the exact geometry is built again
"""

from __future__ import annotations

import dataclasses
import json
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from leco_plugin.scenes.city import DESCRIPTION, City, CityConfig, describe, read_description
from leco_plugin.scenes.city_cameras import aerial_cameras, street_cameras
from leco_plugin.scenes.city_lens import Lens
from leco_plugin.scenes.city_shapes import Array

TRANSFORMS = "transforms.json"
_SPARSE_POINTS_PER_VIEW = 100


@dataclass(frozen=True)
class CaptureConfig:
    """How a city is photographed. ValueError for what cannot be taken."""

    width: int = 160
    """Width of the pictures in pixels."""
    height: int = 120
    """Height of the pictures in pixels."""
    field_of_view: float = 60.0
    """Horizontal opening angle in degrees."""
    aerial_per_block: float = 8.5
    """Aerial pictures for each built block."""
    street_per_block: float = 1.5
    """Pictures from the street for each built block."""
    test_every: int = 8
    """Every so many-th picture is held out for testing."""

    def __post_init__(self) -> None:
        if not (8 <= self.width <= 8192 and 8 <= self.height <= 8192):
            raise ValueError(
                f"pictures have 8 to 8192 pixels a side, not {self.width} x {self.height}"
            )
        if not 10 <= self.field_of_view <= 120:
            raise ValueError(f"the field of view is 10 to 120 degrees, not {self.field_of_view}")
        if not (0 <= self.aerial_per_block <= 1000 and 0 <= self.street_per_block <= 1000):
            raise ValueError(
                "the pictures for each block are 0 to 1000 from the air and from the street"
            )
        if self.aerial_per_block + self.street_per_block == 0:
            raise ValueError("no pictures are asked for: both counts for each block are 0")
        if self.test_every < 2:
            raise ValueError(f"test_every is at least 2, not {self.test_every}")

    @property
    def lens(self) -> Lens:
        """The camera they are taken with."""
        return Lens(
            self.width,
            self.height,
            self.width / 2 / float(np.tan(np.deg2rad(self.field_of_view) / 2)),
        )


def write_city(
    config: CityConfig,
    out_dir: Path | str,
    capture: CaptureConfig | None = None,
    progress: bool = True,
) -> Path:
    """Writes the city as a nerfstudio scene, unless `out_dir` already holds just that.

    The folder appears under its name only when it is complete.

    Args:
        config: the city.
        out_dir: the folder to write; its parents are made.
        capture: how it is photographed, by default about 60 small aerial pictures for 3 blocks.
        progress: whether to show a bar.
    Returns:
        `out_dir`.
    Raises:
        FileExistsError: `out_dir` holds something else, and is left alone.
        ValueError: `out_dir` holds a damaged city, and is left alone.
    """
    out_dir, capture = Path(out_dir), capture or CaptureConfig()
    if _holds(out_dir, config, capture):
        return out_dir
    out_dir.parent.mkdir(parents=True, exist_ok=True)
    unfinished = Path(tempfile.mkdtemp(prefix=f".{out_dir.name}-unfinished-", dir=out_dir.parent))
    try:
        unfinished.chmod(0o755)
        _write(config, capture, unfinished, progress)
        try:
            unfinished.replace(out_dir)
        except OSError:
            # Somebody else may have finished the same city in the meantime.
            if not _holds(out_dir, config, capture):
                raise
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    return out_dir


def _holds(folder: Path, config: CityConfig, capture: CaptureConfig) -> bool:
    """Whether `folder` holds these pictures of this city; False if there is nothing yet."""
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return False
    if not (folder / DESCRIPTION).is_file():
        raise FileExistsError(f"{folder} exists and is not a city: choose another folder")
    found = read_description(folder)
    wanted = {"city": dataclasses.asdict(config), "capture": dataclasses.asdict(capture)}
    for part, values in wanted.items():
        there = found.get(part)
        for name, value in values.items():
            other = there.get(name) if isinstance(there, dict) else None
            if other != value:
                difference = f"{name} is {other} there, not {value}"
                raise FileExistsError(
                    f"{folder} holds another city ({difference}): choose another folder"
                )
    for frame in read_transforms(folder)["frames"]:
        for path in (frame["file_path"], frame["depth_file_path"]):
            if not (folder / path).is_file():
                raise ValueError(
                    f"{folder} is damaged: {path} is missing; delete the folder to write it anew"
                )
    return True


def read_transforms(folder: Path) -> dict[str, Any]:
    """A city's `transforms.json`. ValueError, in one line, if it is incomplete."""
    try:
        transforms = json.loads((folder / TRANSFORMS).read_text())
        needed = {"file_path", "depth_file_path", "transform_matrix"}
        if not all(needed <= set(frame) for frame in transforms["frames"]):
            raise ValueError("a frame is incomplete")
    except (OSError, ValueError, KeyError, TypeError) as error:
        message = f"{folder} is damaged: {TRANSFORMS}: {' '.join(str(error).split())}"
        raise ValueError(message) from error
    return dict(transforms)


def _write(config: CityConfig, capture: CaptureConfig, folder: Path, progress: bool) -> None:
    """Builds, photographs and writes everything; `city.json` comes last."""
    from rich.progress import track

    from leco_plugin.scenes.city_render import Tracer

    city = City(config)
    tracer, lens = Tracer(city), capture.lens
    blocks = int(city.built.sum())
    aerial = aerial_cameras(city, round(capture.aerial_per_block * blocks), config.seed)
    street = street_cameras(city, round(capture.street_per_block * blocks), config.seed)
    names = [f"aerial_{i:05d}" for i in range(len(aerial))] + [
        f"street_{i:05d}" for i in range(len(street))
    ]
    poses = np.concatenate([aerial, street])
    if len(poses) < 2:
        raise ValueError(
            f"{len(poses)} pictures are too few: at least one is trained on and one held out"
        )

    (folder / "images").mkdir()
    (folder / "depths").mkdir()
    random = np.random.default_rng([config.seed, 13])
    frames, points, colours = [], [], []
    jobs = track(
        list(zip(names, poses)), "Photographing the city", transient=True, disable=not progress
    )
    for name, pose in jobs:
        image, depth = tracer.photograph(pose, lens)
        picture, depths = f"images/{name}.png", f"depths/{name}.npy"
        Image.fromarray(image if config.sky else _with_alpha(image, depth)).save(folder / picture)
        np.save(folder / depths, lens.axial(depth))
        matrix = [*pose.tolist(), [0.0, 0.0, 0.0, 1.0]]
        frames.append({"file_path": picture, "depth_file_path": depths, "transform_matrix": matrix})
        seen = np.argwhere(np.isfinite(depth))
        chosen = seen[random.permutation(len(seen))[:_SPARSE_POINTS_PER_VIEW]]
        points.append(lens.points(pose, depth)[tuple(chosen.T)])
        colours.append(image[tuple(chosen.T)])

    paths = [str(frame["file_path"]) for frame in frames]
    held_out = paths[capture.test_every // 2 :: capture.test_every] or paths[-1:]
    transforms = {
        "camera_model": "OPENCV",
        "w": lens.width,
        "h": lens.height,
        "fl_x": lens.focal,
        "fl_y": lens.focal,
        "cx": lens.width / 2,
        "cy": lens.height / 2,
        "orientation_override": "none",
        "ply_file_path": "sparse_pc.ply",
        "frames": frames,
        "train_filenames": [path for path in paths if path not in set(held_out)],
        "val_filenames": held_out,
        "test_filenames": held_out,
    }
    _write_points(folder / "sparse_pc.ply", np.concatenate(points), np.concatenate(colours))
    (folder / TRANSFORMS).write_text(json.dumps(transforms, indent=1) + "\n")
    (folder / DESCRIPTION).write_text(describe(config, capture=dataclasses.asdict(capture)))


def _with_alpha(image: NDArray[np.uint8], depth: NDArray[np.float32]) -> NDArray[np.uint8]:
    """[h, w, 4]: transparent where a ray meets nothing, so that no method has to model the void."""
    alpha = np.where(np.isfinite(depth), 255, 0).astype(np.uint8)
    return np.concatenate([image, alpha[..., None]], axis=-1)


def _write_points(path: Path, points: Array, colours: NDArray[np.uint8]) -> None:
    """Writes points [N, 3] (metres) and colours [N, 3] as a binary PLY file."""
    rows = np.empty(len(points), dtype=[("xyz", "<f4", 3), ("rgb", "u1", 3)])
    rows["xyz"], rows["rgb"] = points, colours
    fields = [f"property float {axis}" for axis in "xyz"]
    fields += [f"property uchar {name}" for name in ("red", "green", "blue")]
    head = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(points)}",
        *fields,
        "end_header",
        "",
    ]
    path.write_bytes("\n".join(head).encode() + rows.tobytes())
