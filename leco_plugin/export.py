"""`leco export`: an occupancy in the formats of other programs, one file or a folder with all.

`export_surface` writes `ply`, `splat-init` and `npz`. `nerfacc-grid` is the buffers of nerfacc's
`OccGridEstimator`: a cell is marked where any probed point of it is kept, so that a grid keeps more
than the gate and loses next to nothing of what the gate keeps.
"""

from __future__ import annotations

import functools
import math
import shlex
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import max_pool3d

from leco_plugin.evaluation.inspection import (
    cameras_of,
    describe,
    doubts,
    mapped_box,
    numbers,
    query,
    scene_colours,
    scene_of,
    to_the_data,
    whole_box,
)
from leco_plugin.evaluation.occupancy_page import write_page
from leco_plugin.evaluation.occupancy_picture import draw
from leco_plugin.export_surface import (
    CELLS,
    KeptSurface,
    few_cells,
    finest,
    in_comments,
    kept_surface,
    require_few,
    require_start,
    shown_part,
    write_ply,
    write_splat_init,
    write_volume,
)
from leco_plugin.log import bar
from leco_plugin.occupancy import Occupancy
from leco_plugin.samplers.grid import OccupancyGridEstimator
from leco_plugin.scenes.coloured_points import coloured_points, colours_near, georeference
from leco_plugin.scenes.frames import moved
from leco_plugin.scenes.input_error import one_line
from leco_plugin.scenes.whole_files import check_apart, check_place, write_whole

Format = Literal["ply", "splat-init", "npz", "nerfacc-grid"]
Frame = Literal["data", "run"]
STEPS = 2
"""Steps from one corner of a grid's cell to the next: 27 probed points, those on faces shared."""
POINTS_AT_ONCE = 1 << 20
MOST_LEVELS, MOST_BOXES = 8, 64
"""Levels of a grid where nobody names a number, and of any: each box is twice as wide."""


def export(
    file: Path,
    format: Format,
    out: Path,
    resolution: int | None = None,
    levels: int | None = None,
    frame: Frame | None = None,
    data: Path | None = None,
    surface: KeptSurface | None = None,
) -> dict[str, Any]:
    """Writes an occupancy in another format.

    Args:
        file: an occupancy.
        format: `ply`, `splat-init`, `npz` or `nerfacc-grid`.
        out: of what is written.
        resolution: cells along the longest side, or along each axis of a grid. None is `CELLS` of a
            cube, and of a flat box as many as make as many in all.
        levels: of a grid.
        frame: of points, `data` for the coordinates of the data's own files, `run` for those of the
            run. None is `data` where the file says how. Grid and volume are in those of the run, a
            start for splats in those of the data.
        data: the scene that it was learned on; None is that of the run in whose folder `file` lies.
        surface: what `kept_surface` finds at this resolution, where it is known already.
    Returns:
        What was written, as JSON values.
    Raises:
        ValueError, OSError: the file is no occupancy, a size is out of range, there is nothing to
            export, or it cannot be written there.
    """
    _check_options(format, levels, frame, data)
    check_place("--out", out)
    check_apart({"--out": out}, file)
    occupancy = Occupancy.load(file)
    back = None if frame == "run" else to_the_data(occupancy)
    if back is None and (frame == "data" or format == "splat-init"):
        raise ValueError(
            f"{file} does not say how its run moved and scaled the data: "
            + ("learn it anew" if format == "splat-init" else "give --frame run")
        )
    if resolution is None:
        resolution = default_resolution(occupancy, format)
    if format == "nerfacc-grid":
        facts = _export_grid(occupancy, out, resolution, levels)
    elif format == "npz":
        facts = write_volume(occupancy, resolution, back, out)
    else:
        description = scene_of(occupancy, file, data)
        if format == "splat-init":
            require_start(out, description)
        check_apart({"--out": out}, description)
        surface = surface or kept_surface(occupancy, resolution)
        facts = _export_points(occupancy, surface, format, out, back, description)
    known = {"format": 1, "written": format, "resolution": resolution}
    return {**known, **facts, "bytes": out.stat().st_size}


def _check_options(
    format: Format, levels: int | None, frame: Frame | None, data: Path | None
) -> None:
    """ValueError for options that do not go with a format."""
    if format != "nerfacc-grid" and levels is not None:
        raise ValueError("points have no levels: --levels goes with --format nerfacc-grid")
    if format in ("nerfacc-grid", "npz") and frame == "data":
        raise ValueError(
            "a grid lies along the axes of the run: --frame data goes with --format ply"
        )
    if format in ("nerfacc-grid", "npz") and data is not None:
        raise ValueError("a grid has nothing of the scene: --data goes with ply and splat-init")
    if format == "splat-init" and frame == "run":
        raise ValueError("a start for splats lies in the data: --frame run goes with --format ply")


def _export_points(
    occupancy: Occupancy,
    surface: KeptSurface,
    format: Format,
    out: Path,
    back: Tensor | None,
    description: Path | None,
) -> dict[str, Any]:
    """Writes the kept surface as `ply` or `splat-init`, as far as the photographs show it."""
    surface = shown_part(surface, to_the_data(occupancy), description)
    if back is not None:
        surface = surface._replace(positions=moved(surface.positions.double(), back))
    if format == "splat-init":
        assert back is not None and description is not None
        facts = write_splat_init(occupancy, surface.positions, back, description, out)
        return facts | {"frame": "data"}
    colours = None
    earth: dict[str, Any] = {}
    if back is not None and description is not None:
        if (known := coloured_points(description)) is not None:
            colours = colours_near(known, surface.positions.numpy())
        earth = georeference(description)
    write_ply(surface, out, colours, in_comments(earth))
    return {
        "points": len(surface.positions),
        "frame": "run" if back is None else "data",
        "photograph_colours": colours is not None,
        **earth,
    }


def default_resolution(occupancy: Occupancy, format: Format) -> int:
    """Cells along the longest side where nobody names a number."""
    if format == "nerfacc-grid":
        return CELLS
    return finest(whole_box(occupancy) if format == "npz" else mapped_box(occupancy))


def _export_grid(
    occupancy: Occupancy, out: Path, resolution: int, levels: int | None
) -> dict[str, Any]:
    """Writes an occupancy grid of nerfacc, which `torch.load(..., weights_only=True)` reads."""
    buffers = grid_buffers(occupancy, resolution, levels)
    write_whole(out, lambda file: torch.save(buffers, file))
    return {
        "frame": "run",
        "levels": len(buffers["aabbs"]),
        "aabbs": buffers["aabbs"].tolist(),
        "kept_share_of_cells": float(buffers["binaries"].double().mean()),
    }


def grid_buffers(
    occupancy: Occupancy, resolution: int = 128, levels: int | None = None
) -> dict[str, Tensor]:
    """What `OccGridEstimator(aabb, resolution, levels).load_state_dict` takes.

    Args:
        resolution: cells along each axis of each level.
        levels: nested boxes, each twice as wide as the one inside it. None is one for a bounded
            scene, and as many as its rays reach, at most `MOST_LEVELS`, for an unbounded one.
    Returns:
        `resolution` int32 [3], `aabbs` [levels, 6] scene units, `occs` [levels * cells] with the
        largest o(x) probed in each cell, `binaries` bool [levels, n, n, n].
        They take 5 bytes a cell. The estimator that loads them makes index tables of its own, of 32
        bytes for each cell of a level.
    Raises:
        ValueError: a size is out of range, or an unbounded scene is to fit one box.
    """
    unbounded = occupancy.space.kind != "box"
    if levels is None:
        levels = reaching_levels(occupancy) if unbounded else 1
    if resolution < 1 or not 1 <= levels <= MOST_BOXES:
        raise ValueError(
            f"{levels} levels of {resolution}^3 cells: a grid has one cell or more, and 1 to "
            f"{MOST_BOXES} levels"
        )
    require_few(levels * resolution**3, f"{levels} x {resolution}^3")
    if unbounded and levels == 1:
        raise ValueError(
            "the scene is unbounded, and a grid of one level ends at its innermost box: give two "
            "levels or more, or none to have them counted"
        )
    inner, center, half = whole_box(occupancy), occupancy.space.center, occupancy.space.half_extent
    # `reaching_levels` counts from the whole cube, of which walls cut nothing off
    ends = [center - half, center + half] if unbounded else [inner.low, inner.high]
    corners = torch.cat(ends).cpu()
    nested = OccupancyGridEstimator(corners, 1, levels)  # for its boxes alone
    largest, done = torch.empty(levels * resolution, resolution, resolution), 0
    with bar(f"Asking the gate about {resolution}^3 cells a level") as show:
        for box in nested.aabbs:
            for values in _largest_in_cells(occupancy, box, resolution):
                largest[done : done + len(values)] = values
                done += len(values)
                show(done / len(largest))
    return {
        "resolution": torch.full_like(nested.resolution, resolution),
        "aabbs": nested.aabbs,
        "occs": largest.view(-1),
        "binaries": (largest >= occupancy.threshold).view(levels, *[resolution] * 3),
    }


def reaching_levels(occupancy: Occupancy) -> int:
    """Levels with which the outermost box holds the rays of all cameras, 2 to `MOST_LEVELS`."""
    far = numbers([occupancy.report.get("far")])
    cameras = cameras_of(occupancy)
    reach = float((cameras - occupancy.space.center.cpu()).abs().max()) if len(cameras) else 0.0
    if not far:
        return MOST_LEVELS
    widest = (reach + max(far[0], 0.0)) / float(occupancy.space.half_extent)
    return min(max(1 + math.ceil(math.log2(max(widest, 1.0))), 2), MOST_LEVELS)


def _largest_in_cells(occupancy: Occupancy, box: Tensor, resolution: int) -> Iterator[Tensor]:
    """The largest o(x) probed in each cell of a box, some layers [k, n, n] at a time."""
    low, high = box[:3], box[3:]
    shares = torch.linspace(0.0, 1.0, STEPS * resolution + 1)
    x, y, z = (torch.lerp(low[axis], high[axis], shares) for axis in range(3))
    layers = max(1, POINTS_AT_ONCE // (STEPS * (STEPS * resolution + 1) ** 2))
    for first in range(0, resolution, layers):
        last = min(first + layers, resolution)
        of_slab = x[STEPS * first : STEPS * last + 1]
        positions = torch.stack(torch.meshgrid(of_slab, y, z, indexing="ij"), dim=-1)
        values = query(occupancy, positions)
        yield max_pool3d(values[None, None], STEPS + 1, STEPS)[0, 0]


Facts = dict[str, Any]


class Part(NamedTuple):
    """A file of the folder."""

    name: str
    facts: Facts | None
    """What was written; None where it was not."""
    said: str
    """What it is for; or why it was not written, and what to do."""


def export_folder(
    file: Path, folder: Path, resolution: int | None = None, data: Path | None = None
) -> tuple[list[Part], list[str]]:
    """Writes pictures, points, a start for splats and a volume; arguments as of `export`.

    The folder is made where it is missing. Files of these names are replaced, and those of parts
    that cannot be made are said to be old. Returns the parts, and two lines if the occupancy is of
    no use. ValueError or OSError if the file is no occupancy, or no part can be written.
    """
    if folder.is_file():
        raise ValueError(f"--out {folder} is a file; without --format give a folder")
    check_place("--out", folder / "kept.ply")
    occupancy = Occupancy.load(file)
    if resolution is not None:
        few_cells(mapped_box(occupancy), resolution, "a surface")
    description = scene_of(occupancy, file, data)
    folder.mkdir(parents=True, exist_ok=True)

    cells = default_resolution(occupancy, "ply") if resolution is None else resolution
    surface = functools.cache(lambda: kept_surface(occupancy, cells))

    def exported(name: str, format: Format, use: Callable[[Facts], str]) -> Part:
        def write() -> Facts:
            if format == "npz":
                return export(file, format, folder / name, resolution)
            return export(file, format, folder / name, resolution, data=data, surface=surface())

        return _part(folder, name, write, use)

    drawn = functools.partial(_draw_pictures, occupancy, folder, description)
    splats = folder / "splats.json"
    picture = "slices of o(x), and the surface of what is kept"
    parts = [
        _part(folder, "occupancy.png", drawn, lambda facts: picture),
        exported("kept.ply", "ply", _points_in_words),
        exported(
            splats.name,
            "splat-init",
            lambda facts: (
                f"{counts_in_words(facts)}, in splats.ply, to start splats from: "
                f"ns-train splatfacto --data {shlex.quote(str(splats))} leco-photographs (on a GPU)"
            ),
        ),
        exported(
            "volume.npz",
            "npz",
            lambda facts: f"o(x) in {' x '.join(map(str, facts['shape']))} cells, for NumPy",
        ),
    ]
    if parts[0].facts is not None:
        page = "the kept volume to look around in, with any browser"
        parts.insert(1, Part("occupancy.html", parts[0].facts, page))
    if all(part.facts is None for part in parts):
        raise ValueError(f"nothing can be exported: {parts[0].said}")
    return parts, doubts(describe(occupancy))


def _draw_pictures(occupancy: Occupancy, folder: Path, description: Path | None) -> Facts:
    """Writes the picture and the page of the folder."""
    with bar("Drawing pictures") as show:
        colours = scene_colours(occupancy, description)
        draw(occupancy, folder / "occupancy.png", colours=colours)
        show(0.75)  # of 3.4 s
        write_page(occupancy, folder / "occupancy.html", colours)
        show(1.0)
    return {"photograph_colours": colours is not None}


def _part(folder: Path, name: str, write: Callable[[], Facts], use: Callable[[Facts], str]) -> Part:
    """A part as it was written, or the line that says why it cannot be."""
    try:
        facts = write()
    except (ValueError, OSError) as error:
        older = "; the older one is left" if (folder / name).exists() else ""
        return Part(name, None, f"{one_line(error)}{older}")
    return Part(name, facts, use(facts))


def counts_in_words(facts: Facts) -> str:
    """Of which points there are how many in what was written as `ply` or `splat-init`."""
    sparse = facts.get("sparse_points", 0)
    surface = f"{facts['points'] - sparse:,} points on the surface of what is kept"
    return f"{surface} and {sparse:,} sparse points that are kept" if sparse else surface


def _points_in_words(facts: Facts) -> str:
    colours = "of the sparse points" if facts["photograph_colours"] else "o(x)"
    where = "in the coordinates of the data"
    if facts["frame"] == "run":
        where = "in the coordinates of the run, which does not say how it moved the data"
    earth = ", origin on earth in its head" if "geographic_origin" in facts else ""
    return f"{counts_in_words(facts)}, {where}{earth}; colours: {colours}"


def in_words(folder: Path, parts: list[Part], doubted: list[str]) -> list[str]:
    """The folder as a table, a line for each part, then what is wrong with the occupancy."""
    rows = [part for part in parts if part.facts is not None]
    lines = [f"wrote into {folder}:"]
    lines += [f"  {part.name:<14}  {part.said}" for part in rows]
    lines += [f"not written: {p.name}: {p.said}" for p in parts if p.facts is None]
    return lines + doubted
