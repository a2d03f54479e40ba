"""A placed reconstruction as files: transforms.json, the sparse points, and COLMAP's own model."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leco_plugin.scenes.poses.georeference import Placement
from leco_plugin.scenes.whole_files import write_points, write_whole

Array = NDArray[np.float64]
LARGE = 1e4
"""Coordinates, as of UTM, from which on points are written in float64."""
POINTS, MODEL = "sparse_pc.ply", "colmap/sparse/0"
"""In the folder of the scene, under the names that ns-process-data has for them."""
PARAMETERS = {
    "OPENCV": ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4"),
    "SIMPLE_RADIAL": ("fl_x", "cx", "cy", "k1"),
    "SIMPLE_RADIAL_FISHEYE": ("fl_x", "cx", "cy", "k1"),
}
"""Parameters of COLMAP's lens models, in their order, as nerfstudio names them."""


def poses_of(model: Any) -> tuple[list[str], Array]:
    """Names of a model's photographs, sorted, and their poses [C, 3, 4], OpenGL camera to world."""
    images = sorted((model.images[each] for each in model.reg_image_ids()), key=lambda i: i.name)
    found = [image.cam_from_world().inverse().matrix() for image in images]
    poses = np.array(found).reshape(-1, 3, 4) * np.array([1.0, -1.0, -1.0, 1.0])
    return [image.name for image in images], poses


def points_of(model: Any) -> tuple[Array, NDArray[np.uint8]]:
    """Sparse points [P, 3] of a model, and their colours [P, 3]."""
    points = list(model.points3D.values())
    places = np.array([point.xyz for point in points], dtype=float).reshape(-1, 3)
    return places, np.array([point.color for point in points], dtype=np.uint8).reshape(-1, 3)


def transforms_of(
    model: Any, placement: Placement, origin: tuple[float, float, float] | None
) -> dict[str, Any]:
    """What transforms.json says of a model that already is in world coordinates.

    Args:
        model: of pycolmap.
        placement: by which it came there: whether coordinates are metres.
        origin: latitude, longitude and altitude of the world's origin, if they are.
    """
    lenses = {number: intrinsics(camera) for number, camera in model.cameras.items()}
    names, poses = poses_of(model)
    used = [model.find_image_with_name(name).camera_id for name in names]
    fisheye = any("FISHEYE" in camera.model_name for camera in model.cameras.values())
    one = len({*used}) == 1
    meta: dict[str, Any] = {"camera_model": "OPENCV_FISHEYE" if fisheye else "OPENCV"}
    meta |= lenses[used[0]] if one else {}
    meta |= {"orientation_override": "none", "ply_file_path": POINTS}  # +z is up already
    meta["applied_transform"] = np.eye(3, 4).tolist()  # COLMAP's model has the same coordinates
    if placement.residuals is not None and origin is not None:
        meta["metres_per_unit"] = 1.0
        place = zip(("latitude", "longitude", "altitude"), origin)
        meta["geographic_origin"] = {**dict(place), "axes": "east, north, up"}
    meta["frames"] = [
        {
            "file_path": f"images/{name}",
            **({} if one else lenses[number]),
            "transform_matrix": [*pose.tolist(), [0.0, 0.0, 0.0, 1.0]],
        }
        for name, number, pose in zip(names, used, poses)
    ]
    return meta


def intrinsics(camera: Any) -> dict[str, float]:
    """Intrinsics of a camera of pycolmap, as transforms.json has them."""
    found = dict(zip(PARAMETERS[camera.model_name], map(float, camera.params)))
    found.setdefault("fl_y", found["fl_x"])
    return {"w": camera.width, "h": camera.height, **found}


def write_scene(
    scene: Path, model: Any, meta: dict[str, Any], report: dict[str, Any], report_name: str
) -> None:
    """Writes points, COLMAP's model, the report and, last of all, transforms.json."""
    folder = scene / MODEL
    folder.mkdir(parents=True, exist_ok=True)
    model.write(folder)
    write_sparse_points(scene / POINTS, *points_of(model))
    for name, said in ((report_name, report), ("transforms.json", meta)):
        text = json.dumps(said, indent=1).encode()
        write_whole(scene / name, lambda file, text=text: file.write(text))  # type: ignore[misc]


def write_sparse_points(path: Path, places: Array, colours: NDArray[np.uint8]) -> None:
    """Writes sparse points [P, 3] with their colours [P, 3] as a PLY file."""
    kind = "<f8" if np.abs(places).max(initial=0.0) > LARGE else "<f4"
    rows = np.zeros(len(places), dtype=[("xyz", kind, 3), ("rgb", "u1", 3)])
    rows["xyz"], rows["rgb"] = places, colours
    write_points(path, rows)
