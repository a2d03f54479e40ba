"""How far a PLY file of `leco export` lies from where GPS says that the photographs were taken.

A receiver is off by some metres for each photograph by itself; how far the model is off shows in
the mean over the photographs around a place.

python benchmarks/ply_on_gps.py SCENE PHOTOS export/kept.ply
"""

from __future__ import annotations

import argparse
from pathlib import Path

import checkout  # noqa: F401
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from leco_plugin.scenes.poses.georeference import Array
from leco_plugin.scenes.poses.originals import find_photographs
from leco_plugin.scenes.poses.reconstruction import load_pycolmap
from leco_plugin.scenes.scene_file import load_json

AROUND = 8
"""Photographs around a vertex: fewer have seen most of what a survey shows."""
BAR = 5.0
"""Metres."""


def deviations(scene: Path, photographs: Path) -> tuple[Array, Array]:
    """Where a scene's photographs were taken [C, 3], and how far that is from GPS [C, 3], both
    metres east, north and up."""
    meta = load_json(scene / "transforms.json")
    origin = [meta["geographic_origin"][name] for name in ("latitude", "longitude", "altitude")]
    found = find_photographs(photographs, scene).photographs
    positions = {f"images/{each.name}": each.exif.position for each in found}
    frames = [frame for frame in meta["frames"] if positions[frame["file_path"]] is not None]
    known = np.array([positions[frame["file_path"]] for frame in frames])
    gps = load_pycolmap().GPSTransform().ellipsoid_to_enu(known, *origin)
    places = np.array([frame["transform_matrix"] for frame in frames])[:, :3, 3]
    return places, places - gps


def vertices(ply: Path) -> Array:
    """[P, 3] of a file of `leco export`."""
    from trimesh import load

    return np.asarray(load(ply).vertices, dtype=float)


def line(name: str, lengths: NDArray[np.float64]) -> str:
    """Metres [N] in a line."""
    return (
        f"{name:40}{np.median(lengths):8.2f}{np.sqrt((lengths**2).mean()):8.2f}"
        f"{lengths.max():8.2f}{(lengths <= BAR).mean():8.1%}"
    )


def main() -> None:
    """Prints both distances."""
    parser = argparse.ArgumentParser(description=__doc__)
    for name in ("scene", "photographs", "ply"):
        parser.add_argument(name, type=Path)
    given = parser.parse_args()
    places, off = deviations(given.scene, given.photographs)
    points = vertices(given.ply)
    _, around = KDTree(places[:, :2]).query(points[:, :2], k=min(AROUND, len(places)))
    print(f"{'metres off':40}{'median':>8}{'rms':>8}{'most':>8}{f'<= {BAR:.0f} m':>8}")
    print(line(f"{len(places)} photographs", np.linalg.norm(off, axis=1)))
    local = off[around.reshape(len(points), -1)].mean(axis=1)
    print(line(f"{len(points)} vertices, by the {AROUND} nearest", np.linalg.norm(local, axis=1)))


if __name__ == "__main__":
    main()
