"""Writes Mega-NeRF's format, picture by picture, without masks.

coordinates.pt                    origin_drb [3] metres, pose_scale_factor in metres
mappings.txt                      "<original name>,<metadata file>" in each line
train|val/rgbs/<stem>.png         the pictures
train|val/metadata/<stem>.pt      H, W, c2w [3, 4], intrinsics [4], distortion [4]
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from leco_plugin.scenes.city.shapes import Array
from leco_plugin.scenes.mega_nerf_format.axes import Coordinates
from leco_plugin.scenes.whole_files import write_whole

Split = Literal["train", "val"]


def write_coordinates(folder: Path, coordinates: Coordinates) -> None:
    """Writes `coordinates.pt`."""
    values = {
        "origin_drb": torch.from_numpy(coordinates.origin_drb).float(),
        "pose_scale_factor": float(coordinates.metres),
    }
    write_whole(folder / "coordinates.pt", lambda file: torch.save(values, file))


def write_mappings(folder: Path, stems: dict[str, str]) -> None:
    """Writes `mappings.txt` from the original names of pictures and their stems."""
    text = "".join(f"{name},{stem}.pt\n" for name, stem in stems.items())
    write_whole(folder / "mappings.txt", lambda file: file.write(text.encode()))


def write_view(
    folder: Path,
    split: Split,
    stem: str,
    image: NDArray[np.uint8],
    pose: Array,
    intrinsics: tuple[float, float, float, float],
) -> None:
    """Writes a picture and then its metadata.

    Args:
        image: [H, W, 3] or, with transparency, [H, W, 4].
        pose: [3, 4] camera to world as the file holds it: `Coordinates.to_file`.
        intrinsics: fx, fy, cx, cy in pixels.
    """
    metadata: dict[str, Any] = {
        "H": image.shape[0],
        "W": image.shape[1],
        "c2w": torch.from_numpy(np.ascontiguousarray(pose)).float(),
        "intrinsics": torch.tensor(intrinsics, dtype=torch.float32),
        "distortion": torch.zeros(4),
    }
    rgb, data = folder / split / "rgbs" / f"{stem}.png", folder / split / "metadata" / f"{stem}.pt"
    write_whole(rgb, lambda file: Image.fromarray(image).save(file, format="PNG"))
    write_whole(data, lambda file: torch.save(metadata, file))
