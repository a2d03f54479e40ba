"""How the pictures of a city lie on disk: as a nerfstudio scene, or as a Mega-NeRF scene.

nerfstudio:
images/*.png       the pictures
depths/*.npy       float32 [h, w], millimetres along the viewing axis, 0 where nothing is met:
                   what nerfstudio's depth methods read by default
transforms.json    cameras and splits
sparse_pc.ply      some visible surface points, like those of structure from motion

Mega-NeRF: as `mega_nerf_format.files` says.
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from leco_plugin.scenes.city.cameras import Lens, View
from leco_plugin.scenes.mega_nerf_format.files import (
    Coordinates,
    Split,
    around,
    write_coordinates,
    write_mappings,
    write_view,
)
from leco_plugin.scenes.whole_files import write_points, write_whole

Image8 = NDArray[np.uint8]
LayoutName = Literal["nerfstudio", "mega-nerf"]
TRANSFORMS = "transforms.json"
MAPPINGS = "mappings.txt"
PARTS = (("rgbs", "png"), ("metadata", "pt"))
"""Of a view in Mega-NeRF's format: the folders, and how the names in them end."""
POINTS = "sparse_pc.ply"
_SPARSE_POINTS_PER_VIEW = 100


@dataclass
class Layout(ABC):
    """Writes pictures one by one, so that a city may be larger than memory, then the rest."""

    views: list[View]
    lens: Lens
    seed: int

    @abstractmethod
    def files(self, view: View) -> list[str]:
        """What is there, relative to the folder, when a view is written."""

    @abstractmethod
    def write(self, folder: Path, view: View, image: Image8, depth: NDArray[np.float32]) -> None:
        """Writes a view: `image` [h, w, 3 or 4], `depth` [h, w] metres along the rays."""

    @abstractmethod
    def finish(self, folder: Path) -> None:
        """Writes what is about all views."""


class NerfstudioLayout(Layout):
    """transforms.json, with depths and sparse points."""

    def files(self, view: View) -> list[str]:
        return [f"images/{view.name}.png", f"depths/{view.name}.npy"]

    def write(self, folder: Path, view: View, image: Image8, depth: NDArray[np.float32]) -> None:
        picture, depths = self.files(view)
        write_whole(folder / picture, lambda f: Image.fromarray(image).save(f, format="PNG"))
        write_whole(folder / depths, lambda f: np.save(f, self.lens.axial(depth)))

    def finish(self, folder: Path) -> None:
        write_points(folder / POINTS, self._points(folder))
        transforms = json.dumps(self._transforms(), indent=1) + "\n"
        write_whole(folder / TRANSFORMS, lambda f: f.write(transforms.encode()))

    def _transforms(self) -> dict[str, Any]:
        frames: list[dict[str, Any]] = []
        trained: list[str] = []
        held_out: list[str] = []
        for view in self.views:
            picture, depths = self.files(view)
            matrix = [*view.pose.tolist(), [0.0, 0.0, 0.0, 1.0]]
            frames.append(
                {"file_path": picture, "depth_file_path": depths, "transform_matrix": matrix}
            )
            (held_out if view.held_out else trained).append(picture)
        lens = self.lens
        return {
            "camera_model": "OPENCV",
            "w": lens.width,
            "h": lens.height,
            "fl_x": lens.focal,
            "fl_y": lens.focal,
            "cx": lens.width / 2,
            "cy": lens.height / 2,
            "orientation_override": "none",
            "ply_file_path": POINTS,
            "metres_per_unit": 1.0,
            "frames": frames,
            "train_filenames": trained,
            "val_filenames": held_out,
            "test_filenames": held_out,
        }

    def _points(self, folder: Path) -> NDArray[Any]:
        """Some surface points of each view, read back from its files: what a killed run wrote too.

        Returns:
            [N] rows of `xyz` (metres) and `rgb`.
        """
        random = np.random.default_rng([self.seed, 13])
        rows = []
        for view in self.views:
            picture, depths = self.files(view)
            depth = self.lens.along_ray(np.load(folder / depths, allow_pickle=False))
            seen = np.argwhere(np.isfinite(depth))
            chosen = tuple(seen[random.permutation(len(seen))[:_SPARSE_POINTS_PER_VIEW]].T)
            row = np.empty(len(chosen[0]), dtype=[("xyz", "<f4", 3), ("rgb", "u1", 3)])
            row["xyz"] = self.lens.points(view.pose, depth)[chosen]
            with Image.open(folder / picture) as image:
                row["rgb"] = np.asarray(image)[chosen][:, :3]
            rows.append(row)
        return np.concatenate(rows)


class MegaNerfLayout(Layout):
    """Mega-NeRF's folders; held-out pictures are its validation set."""

    @cached_property
    def coordinates(self) -> Coordinates:
        return around(np.stack([view.pose[:, 3] for view in self.views]))

    def files(self, view: View) -> list[str]:
        split = "val" if view.held_out else "train"
        return [f"{split}/{folder}/{self._stem(view)}.{ending}" for folder, ending in PARTS]

    def write(self, folder: Path, view: View, image: Image8, depth: NDArray[np.float32]) -> None:
        lens = self.lens
        split: Split = "val" if view.held_out else "train"
        intrinsics = lens.focal, lens.focal, lens.width / 2, lens.height / 2
        pose = self.coordinates.to_file(view.pose[None])[0]
        write_view(folder, split, self._stem(view), image, pose, intrinsics)

    def finish(self, folder: Path) -> None:
        write_coordinates(folder, self.coordinates)
        write_mappings(folder, {f"{view.name}.png": self._stem(view) for view in self.views})

    @staticmethod
    def _stem(view: View) -> str:
        return f"{view.number:06d}"


LAYOUTS: dict[LayoutName, type[Layout]] = {
    "nerfstudio": NerfstudioLayout,
    "mega-nerf": MegaNerfLayout,
}


def with_alpha(image: NDArray[np.uint8], depth: NDArray[np.floating]) -> NDArray[np.uint8]:
    """[h, w, 4]: transparent where a ray meets nothing, so that no method has to model the void."""
    alpha = np.where(np.isfinite(depth), 255, 0).astype(np.uint8)
    return np.concatenate([image, alpha[..., None]], axis=-1)
