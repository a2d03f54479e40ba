"""How far a PLY file of `leco export` is off, by GPS and by the scene's sparse points.

GPS says where the photographs were taken. Receivers scatter by some metres each; the mean offset of
the photographs around a place says how the model is bent there. It was fitted to the same GPS.
Whether the file fits the model is seen from the heights of its vertices above the sparse points
around them.

python benchmarks/ply_on_gps.py SCENE PHOTOS export/kept.ply
"""

from __future__ import annotations

import argparse
from pathlib import Path

import checkout  # noqa: F401
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from leco_plugin.scenes.coloured_points import read_cloud
from leco_plugin.scenes.poses.georeference import Array
from leco_plugin.scenes.poses.originals import find_photographs
from leco_plugin.scenes.poses.reconstruction import load_pycolmap
from leco_plugin.scenes.scene_file import load_json

AROUND = 8
"""Photographs, or sparse points, around a place."""
NEAR = 20.0
"""Metres within which those points lie at least; other vertices are not judged."""
BAR = 5.0
"""Metres."""


def from_gps(scene: Path, photographs: Path) -> tuple[Array, Array]:
    """Where a scene's photographs were taken [C, 3], and how far that is from GPS [C, 3], both
    metres east, north and up."""
    meta = load_json(scene / "transforms.json")
    if "geographic_origin" not in meta:
        raise SystemExit(f"{scene} has no geographic_origin: GPS was not used")
    origin = [meta["geographic_origin"][name] for name in ("latitude", "longitude", "altitude")]
    found = find_photographs(photographs, scene).photographs
    positions = {f"images/{each.name}": each.exif.position for each in found}
    frames = [frame for frame in meta["frames"] if positions[frame["file_path"]] is not None]
    known = np.array([positions[frame["file_path"]] for frame in frames])
    gps = load_pycolmap().GPSTransform().ellipsoid_to_enu(known, *origin)
    places = np.array([frame["transform_matrix"] for frame in frames])[:, :3, 3]
    return places, places - gps


def around(of: Array, places: Array) -> tuple[Array, NDArray[np.int64]]:
    """In plan, the distance [N] of places [N, 3] to the last of the nearest, and those [N, K]."""
    count = min(AROUND, len(of))
    far, numbers = KDTree(of[:, :2]).query(places[:, :2], k=count)
    return far.reshape(-1, count)[:, -1], numbers.reshape(-1, count)


def heights(vertices: Array, sparse: Array) -> Array:
    """Metres above the median of the sparse points [S, 3] around them, of those vertices [P, 3]
    that have such."""
    far, numbers = around(sparse, vertices)
    return (vertices[:, 2] - np.median(sparse[numbers, 2], axis=1))[far <= NEAR]


def line(name: str, lengths: Array) -> str:
    """Metres [N] in a line."""
    return (
        f"{name:52}{np.median(lengths):8.2f}{np.sqrt((lengths**2).mean()):8.2f}"
        f"{lengths.max():8.2f}{(lengths <= BAR).mean():8.1%}"
    )


def main() -> None:
    """Prints how far photographs, model and file are off."""
    parser = argparse.ArgumentParser(description=__doc__)
    for name in ("scene", "photographs", "ply"):
        parser.add_argument(name, type=Path)
    given = parser.parse_args()
    places, off = from_gps(given.scene, given.photographs)
    vertices = read_cloud(given.ply).positions
    description = load_json(given.scene / "transforms.json")
    sparse = read_cloud(given.scene / description["ply_file_path"]).positions
    local = off[around(places, vertices)[1]].mean(axis=1)
    above = np.abs(heights(vertices, sparse))
    print(f"{'metres off':52}{'median':>8}{'rms':>8}{'most':>8}{f'<= {BAR:.0f} m':>8}")
    print(line(f"{len(places)} photographs, from GPS", np.linalg.norm(off, axis=1)))
    print(
        line(f"mean offset of {AROUND} photographs around a vertex", np.linalg.norm(local, axis=1))
    )
    print(line(f"{len(above)} of {len(vertices)} vertices, above sparse points", above))


if __name__ == "__main__":
    main()
