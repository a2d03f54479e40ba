"""What `leco export` writes: the surface, a start for splats, a dense volume.

The surface is where the rays of the photographs first meet what is kept.
The kept set itself is wider than what it is about, because a threshold that loses nothing keeps
air around every surface.
"""

from __future__ import annotations

import functools
import io
import json
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from leco_plugin.evaluation.inspection import (
    ViewBox,
    cameras_of,
    exposed,
    mapped_box,
    query,
    seen_at,
    whole_box,
)
from leco_plugin.log import for_each
from leco_plugin.occupancy import Occupancy
from leco_plugin.scenes.coloured_points import (
    GREY,
    coloured_points,
    colours_near,
    georeference,
    views_of,
)
from leco_plugin.scenes.frames import applied_in, inverse, moved
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.photograph_files import find_file
from leco_plugin.scenes.scene_file import load_json
from leco_plugin.scenes.whole_files import check_apart, write_json, write_points, write_whole

CELLS = 128
"""Along each side of a cube."""
MOST_CELLS = 1 << 28
"""Of an export: each holds some bytes until the file is written, which makes gigabytes."""
CELLS_AT_ONCE = 1 << 20
"""Cells whose places are known together; of the others only o(x) is."""
NEAR_PEAK = 0.9
"""Of the largest o(x) along a ray: from there on is matter."""
MATTER = 0.5
"""Of the largest o(x) of all, the least that is matter: haze before a wall of the box has less."""
SHOWN_BY = 2
"""Photographs that show an exported point: one alone does not say how far away it is."""
REACH = 1 / 16
"""Of the longest side, before and behind a cell, along which o(x) is compared."""
COLOURS = "magma"
"""Of matplotlib, for o(x) in [0, 1]: as in the picture of `leco inspect`."""


class KeptSurface(NamedTuple):
    """Middles of kept cells on the surface."""

    positions: Tensor
    """[P, 3] scene units, or float64 in coordinates of the data."""
    values: Tensor
    """[P] o(x)."""


def kept_surface(occupancy: Occupancy, resolution: int) -> KeptSurface:
    """Kept cells at which rays from the nearest camera first meet matter.

    Where the file names no cameras, all kept cells that touch a skipped one.

    Args:
        resolution: cells along the longest side of the space in which the gate was taught. Those of
            an unbounded scene grow with distance, as its mapping has it.
    Raises:
        ValueError: the resolution is below 2 or makes too many cells, nothing is kept, or no camera
            sees its surface.
    """
    box = mapped_box(occupancy)
    counts = few_cells(box, resolution, "a surface")
    axes = [box.axis(number, count) for number, count in enumerate(counts)]
    cells = math.prod(counts)

    def ask(first: int) -> Tensor:
        numbers = torch.arange(first, min(first + CELLS_AT_ONCE, cells))
        indices = torch.unravel_index(numbers, counts)
        places = torch.stack([axis[index] for axis, index in zip(axes, indices)], dim=-1)
        return query(occupancy, _unmap(occupancy, places))

    what = f"Asking the gate about cells of 1/{resolution}"
    values = torch.cat(for_each(what, range(0, cells, CELLS_AT_ONCE), ask)).view(*counts)
    kept, cameras = values >= occupancy.threshold, cameras_of(occupancy)
    if not bool(kept.any()):
        raise ValueError(
            f"the occupancy keeps nothing in cells of 1/{resolution} of its space: there is no "
            "surface to export"
        )
    if not len(cameras):
        shell = exposed(kept)
        return KeptSurface(_unmap(occupancy, _at(axes, shell)), values[shell])
    matter = kept & (values >= MATTER * values.max())
    cell = float((box.high - box.low).max()) / resolution
    places = _at(axes, matter)
    meets = functools.partial(_first_met, occupancy, cameras, cell, round(REACH * resolution))
    met = torch.cat(for_each("Looking along rays", places.split(CELLS_AT_ONCE >> 4), meets))
    if not bool(met.any()):
        raise ValueError(
            "no camera sees a surface of what is kept: all of them lie inside it; look at it with "
            "leco inspect"
        )
    return KeptSurface(_unmap(occupancy, places[met]), values[matter][met])


def _at(axes: Sequence[Tensor], chosen: Tensor) -> Tensor:
    """Middles [K, 3] of chosen cells, bool [X, Y, Z], between whose middles along each axis."""
    numbers = zip(axes, chosen.nonzero(as_tuple=True))
    return torch.stack([axis[index] for axis, index in numbers], dim=-1)


def _first_met(
    occupancy: Occupancy, cameras: Tensor, cell: float, steps: int, places: Tensor
) -> Tensor:
    """Whether rays from the nearest camera [C, 3] (scene units) meet matter at mapped places
    [K, 3], and not before: bool [K]. So many `steps` of a cell's mapped size before and behind a
    place are asked."""
    from scipy.spatial import KDTree

    eyes = occupancy.space.map(cameras.to(occupancy.threshold_value.device)).cpu()
    _, nearest = KDTree(eyes.numpy()).query(places.numpy())
    towards = torch.nn.functional.normalize(eyes[torch.from_numpy(nearest)] - places, dim=-1)
    shifts = range(-max(steps, 1), max(steps, 1) + 1)
    asked = torch.stack([places + shift * cell * towards for shift in shifts])
    inside = asked.abs().amax(dim=-1) < 1.0
    values = query(occupancy, _unmap(occupancy, torch.where(inside[..., None], asked, places)))
    values = torch.where(inside, values, 0.0)
    enough = values >= NEAR_PEAK * values.amax(dim=0)
    middle = len(shifts) // 2
    return enough[middle] & ~enough[middle + 1 :].any(dim=0)


def _unmap(occupancy: Occupancy, mapped: Tensor) -> Tensor:
    """Scene positions [..., 3] on the CPU, of mapped ones."""
    return occupancy.space.unmap(mapped.to(occupancy.threshold_value.device)).cpu()


def shown_part(surface: KeptSurface, back: Tensor | None, description: Path | None) -> KeptSurface:
    """Of a surface in the coordinates of a run, what `SHOWN_BY` photographs may show; all of it
    where it is not known what they show. ValueError if that is none of it."""
    if back is None or description is None:
        return surface
    views = views_of(description, moved(surface.positions.double(), back).numpy())
    if views is None:
        return surface
    shown = torch.from_numpy(views >= SHOWN_BY)
    if not bool(shown.any()):
        raise ValueError(
            f"no {SHOWN_BY} photographs of {description} show the surface of what is kept: is it "
            "the scene that the occupancy was learned on? (--data names another)"
        )
    return KeptSurface(surface.positions[shown], surface.values[shown])


def finest(box: ViewBox) -> int:
    """Cells along the longest side with which a box has as many as a cube of `CELLS`."""
    return round(CELLS * (CELLS**3 / math.prod(box.cells(CELLS))) ** (1 / 3))


def require_few(cells: int, said: str) -> None:
    """Refuses more than `MOST_CELLS` cells, with a ValueError that says how they lie."""
    if cells > MOST_CELLS:
        raise ValueError(
            f"{said} are too many cells: an export has at most {MOST_CELLS} in all, as "
            f"{int(MOST_CELLS ** (1 / 3))}^3 are; give a smaller --resolution"
        )


def few_cells(box: ViewBox, resolution: int, what: str) -> tuple[int, int, int]:
    """Cells along each axis of a box, so many along its longest side. ValueError if `what` cannot
    have as few or as many."""
    if resolution < 2:
        raise ValueError(f"{what} takes at least 2 cells along a side, not {resolution}")
    counts = box.cells(min(resolution, MOST_CELLS))  # which are too many along one side alone
    require_few(math.prod(counts), f"{resolution} along the longest side")
    return counts


def write_ply(
    surface: KeptSurface,
    path: Path,
    colours: np.ndarray | None = None,
    comments: Sequence[str] = (),
) -> None:
    """Writes binary PLY of float64 with colours [P, 3] uint8, by o(x) where they are None, and with
    comments in its head. OSError if it cannot be written there."""
    from matplotlib import colormaps

    if colours is None:
        paint = colormaps[COLOURS](surface.values.clamp(0.0, 1.0).numpy(), bytes=True)
    else:
        paint = np.pad(colours, ((0, 0), (0, 1)), constant_values=255)
    write_points(path, surface.positions.double().numpy(), paint, comments)


PATHS = ("file_path", "mask_path", "depth_file_path")
"""Keys of a frame of transforms.json that name files."""


def in_comments(earth: dict[str, Any]) -> list[str]:
    """Lines for the head of a PLY file, of a `georeference`."""
    return [f"{name} {json.dumps(value)}" for name, value in earth.items()]


def write_splat_init(
    occupancy: Occupancy, surface: Tensor, back: Tensor, description: Path, out: Path
) -> dict[str, Any]:
    """Writes points, and `out`, a copy of the scene's transforms.json (`description`) that names
    them: where splatfacto starts. The points lie beside the copy: the scene's sparse points that
    the occupancy keeps, and the kept surface [P, 3] in the data's coordinates. `back` [3, 4] takes
    positions of the run to those."""
    points, meta = out.with_suffix(".ply"), load_json(description)
    places, known = surface.double().numpy(), coloured_points(description)
    if known is None:
        colours = np.full((len(places), 3), GREY, np.uint8)
        sparse = 0
    else:
        of_run = moved(torch.from_numpy(known.positions), inverse(back)).float()
        kept = (query(occupancy, of_run) >= occupancy.threshold).numpy()
        colours = np.concatenate([known.colours[kept], colours_near(known, places)])
        places, sparse = np.concatenate([known.positions[kept], places]), int(kept.sum())
    write_points(points, places, colours, in_comments(georeference(description)))
    copy = _from_elsewhere(meta, description.parent, out.parent)
    write_json(out, copy | {"ply_file_path": points.name}, indent=1, allow_nan=True)
    return {"points": len(places), "sparse_points": sparse, "photograph_colours": known is not None}


def require_start(out: Path, description: Path | None) -> None:
    """InputError if `write_splat_init` has no scene to copy, or the copy or its points would
    replace the scene's own, or the copy's name does not end in .json."""
    if description is None:
        raise InputError("a start for splats copies transforms.json: give --data SCENE")
    if out.suffix != ".json":
        raise InputError(f"--out {out}: a start for splats is a copy of transforms.json; end it so")
    check_apart({"--out": out, "the points of --out": out.with_suffix(".ply")}, description)


def _from_elsewhere(meta: dict[str, Any], scene: Path, folder: Path) -> dict[str, Any]:
    """A scene's description for another folder: its photographs stay where they are."""
    home, (applied, _) = folder.resolve(), applied_in(meta, scene)
    if home == scene.resolve():
        return meta

    def from_there(name: str) -> str:
        return os.path.relpath(find_file(scene / name).resolve(), home)

    frames = [
        {key: from_there(value) if key in PATHS else value for key, value in frame.items()}
        for frame in meta["frames"]
    ]
    splits = {key: [from_there(x) for x in meta[key]] for key in meta if key.endswith("_filenames")}
    known = {} if applied is None else {"applied_transform": applied}
    return meta | known | splits | {"frames": frames}


def write_volume(
    occupancy: Occupancy, resolution: int, back: Tensor | None, out: Path
) -> dict[str, Any]:
    """Writes o(x) at the middles of cells of the box as a NumPy file.

    The file holds `o` float16 [X, Y, Z], `kept` and `seen` bool [X, Y, Z], `low` and `high` [3] of
    the box in the run's coordinates, `threshold`, and `to_data` [3, 4], which takes positions of
    the run to those of the data, unless `back` is None. Of an unbounded scene the box is its inner
    cube; `resolution` is the number of cells along the longest side.
    """
    box = whole_box(occupancy)
    counts = few_cells(box, resolution, "a volume")
    x, y, z = (box.axis(number, count) for number, count in enumerate(counts))
    layers = max(1, CELLS_AT_ONCE // (counts[1] * counts[2]))

    def ask(part: Tensor) -> tuple[Tensor, Tensor]:
        positions = torch.stack(torch.meshgrid(part, y, z, indexing="ij"), dim=-1)
        return query(occupancy, positions), seen_at(occupancy, positions)

    what = f"Asking the gate about cells of 1/{resolution}"
    o, seen = map(torch.cat, zip(*for_each(what, x.split(layers), ask)))
    kept = o >= occupancy.threshold
    arrays: dict[str, Any] = {
        "o": o.half().numpy(),
        "kept": kept.numpy(),
        "seen": seen.numpy(),
        "low": box.low.numpy(),
        "high": box.high.numpy(),
        "threshold": np.float32(occupancy.threshold),
    }
    if back is not None:
        arrays["to_data"] = back.numpy()
    packed = io.BytesIO()  # a zip file that fails half-way complains when it is forgotten
    np.savez_compressed(packed, **arrays)
    write_whole(out, lambda file: file.write(packed.getbuffer()))
    return {
        "shape": list(counts),
        "cells": math.prod(counts),
        "kept_share_of_cells": float(kept.double().mean()),
        "frame": "run",
    }
