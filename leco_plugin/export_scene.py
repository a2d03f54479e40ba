"""`leco export` with photographs at hand: coloured points, a start for splats, a dense volume."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from leco_plugin.evaluation.inspection import query, seen_at, whole_box
from leco_plugin.occupancy import Occupancy
from leco_plugin.scenes.coloured_points import (
    GREY,
    coloured_points,
    colours_near,
    georeference,
)
from leco_plugin.scenes.frames import inverse, moved
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.photograph_files import find_file
from leco_plugin.scenes.scene_file import load_json
from leco_plugin.scenes.whole_files import write_points, write_whole

PATHS = ("file_path", "mask_path", "depth_file_path")
"""Keys of a frame of transforms.json that name files."""
LAYERS_AT_ONCE = 1 << 20


def comments_of(description: Path | None) -> list[str]:
    """Lines for the head of a PLY file: where on earth its coordinates lie, if that is known."""
    if description is None:
        return []
    known = georeference(description)
    return [f"{name} {json.dumps(value)}" for name, value in known.items()]


def photograph_colours(
    description: Path | None, positions: NDArray[np.float64]
) -> NDArray[np.uint8] | None:
    """Colours [N, 3] of the sparse points nearest to positions [N, 3] in the data's coordinates;
    None where the scene has no coloured points, or is not known."""
    known = None if description is None else coloured_points(description)
    return None if known is None else colours_near(known, positions)


def write_splat_init(
    occupancy: Occupancy, surface: Tensor, back: Tensor, description: Path, out: Path
) -> dict[str, Any]:
    """Writes points, and a copy of transforms.json that names them: where splatfacto starts.

    The points are the scene's sparse points that the occupancy keeps, and the kept surface.

    Args:
        surface: [P, 3] of the kept surface, in the data's coordinates.
        back: [3, 4] takes positions of the run to those of the data.
        description: the scene's transforms.json.
        out: the copy, beside the scene's own or elsewhere; the points lie beside it.
    Raises:
        InputError: the copy or its points would replace the scene's own, or the copy's name does
            not end in .json.
    """
    if out.suffix != ".json":
        raise InputError(f"--out {out}: a start for splats is a copy of transforms.json; end it so")
    if out.resolve() == description.resolve():
        raise InputError(f"--out {out} is the scene's own file: give another name beside it")
    points, meta = out.with_suffix(".ply"), load_json(description)
    own = meta.get("ply_file_path")
    if isinstance(own, str) and points.resolve() == (description.parent / own).resolve():
        raise InputError(f"--out {out}: {points} holds the scene's own points; give another name")
    places, known = surface.double().numpy(), coloured_points(description)
    if known is None:
        colours = np.full((len(places), 3), GREY, np.uint8)
        sparse = 0
    else:
        of_run = moved(torch.from_numpy(known.positions), inverse(back)).float()
        kept = (query(occupancy, of_run) >= occupancy.threshold).numpy()
        colours = np.concatenate([known.colours[kept], colours_near(known, places)])
        places, sparse = np.concatenate([known.positions[kept], places]), int(kept.sum())
    rows = np.zeros(len(places), dtype=[("xyz", "<f8", 3), ("rgb", "u1", 3)])
    rows["xyz"], rows["rgb"] = places, colours
    write_points(points, rows, comments_of(description))
    copy = _from_elsewhere(meta, description.parent, out.parent)
    text = json.dumps(copy | {"ply_file_path": points.name}, indent=1).encode()
    write_whole(out, lambda file: file.write(text))
    return {"points": len(places), "sparse_points": sparse, "photograph_colours": known is not None}


def _from_elsewhere(meta: dict[str, Any], scene: Path, folder: Path) -> dict[str, Any]:
    """A scene's description for another folder: its photographs stay where they are."""
    home = folder.resolve()
    if home == scene.resolve():
        return meta

    def from_there(name: str) -> str:
        path = find_file(scene / name).resolve()
        try:
            return Path(os.path.relpath(path, home)).as_posix()
        except ValueError:  # on another drive of Windows
            return str(path)

    frames = [
        {key: from_there(value) if key in PATHS else value for key, value in frame.items()}
        for frame in meta["frames"]
    ]
    splits = {key: [from_there(x) for x in meta[key]] for key in meta if key.endswith("_filenames")}
    return meta | splits | {"frames": frames}


def write_volume(
    occupancy: Occupancy,
    resolution: int,
    back: Tensor | None,
    out: Path,
    on_progress: Callable[[float], None] = lambda share: None,
) -> dict[str, Any]:
    """Writes o(x) at the middles of cells of the box as a NumPy file.

    The file holds `o` float16 [X, Y, Z], `kept` and `seen` bool [X, Y, Z], `low` and `high` [3] of
    the box in the run's coordinates, `threshold`, and `to_data` [3, 4], which takes positions of
    the run to those of the data. Of an unbounded scene the box is its inner cube.

    Args:
        resolution: cells along the longest side.
        back: `to_data`; None leaves it out.
    """
    box = whole_box(occupancy)
    counts = box.cells(resolution)
    x, y, z = (box.axis(number, count) for number, count in enumerate(counts))
    layers = max(1, LAYERS_AT_ONCE // (counts[1] * counts[2]))
    values, seen = [], []
    for part in x.split(layers):
        positions = torch.stack(torch.meshgrid(part, y, z, indexing="ij"), dim=-1)
        values.append(query(occupancy, positions))
        seen.append(seen_at(occupancy, positions))
        on_progress(sum(map(len, values)) / counts[0])
    o = torch.cat(values)
    kept = o >= occupancy.threshold
    arrays: dict[str, Any] = {
        "o": o.half().numpy(),
        "kept": kept.numpy(),
        "seen": torch.cat(seen).numpy(),
        "low": box.low.numpy(),
        "high": box.high.numpy(),
        "threshold": np.float32(occupancy.threshold),
    }
    if back is not None:
        arrays["to_data"] = back.numpy()
    write_whole(out, lambda file: np.savez_compressed(file, **arrays))
    share = float(kept.double().mean())
    return {"shape": list(counts), "cells": math.prod(counts), "kept_share_of_cells": share}
