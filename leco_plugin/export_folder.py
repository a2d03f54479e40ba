"""`leco export` without a format: a folder with everything that other programs take."""

from __future__ import annotations

import functools
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from leco_plugin.cli_reports import check_place
from leco_plugin.evaluation.inspection import describe, doubts, scene_of
from leco_plugin.evaluation.occupancy_page import write_page
from leco_plugin.evaluation.occupancy_picture import draw
from leco_plugin.evaluation.scene_colours import scene_colours
from leco_plugin.export import Format, default_resolution, export, surface_of
from leco_plugin.occupancy import Occupancy

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
    """Writes pictures, points, a start for splats and a volume.

    Args:
        file: an occupancy.
        folder: made where it is missing; files of these names are replaced, and those of parts that
            cannot be made are said to be old.
        resolution: cells along the longest side; None as `export` has it.
        data: the scene that it was learned on; None is that of the run in whose folder `file` lies.
    Returns:
        The parts, and two lines if the occupancy is of no use.
    Raises:
        ValueError, OSError: the file is no occupancy, or none of the parts can be written.
    """
    if folder.is_file():
        raise ValueError(f"--out {folder} is a file; without --format give a folder")
    check_place("--out", folder / "kept.ply")
    occupancy = Occupancy.load(file)
    description = scene_of(occupancy, file, data)
    folder.mkdir(parents=True, exist_ok=True)

    cells = default_resolution(occupancy, "ply") if resolution is None else resolution
    surface = functools.cache(lambda: surface_of(occupancy, cells))

    def exported(format: Format, name: str) -> Facts:
        known = None if format == "npz" else surface()
        return export(file, format, folder / name, resolution, data=data, surface=known)

    def drawn() -> Facts:
        colours = scene_colours(occupancy, description)
        draw(occupancy, folder / "occupancy.png", colours=colours)
        write_page(occupancy, folder / "occupancy.html", colours)
        return {"photograph_colours": colours is not None}

    splats, part = folder / "splats.json", functools.partial(_part, folder)
    parts = [
        part("occupancy.png", drawn, lambda facts: "slices of o(x), and the kept points"),
        part("kept.ply", lambda: exported("ply", "kept.ply"), _points_in_words),
        part(
            splats.name,
            lambda: exported("splat-init", splats.name),
            lambda facts: (
                f"{facts['points']:,} points in splats.ply, to start splats from: "
                f"ns-train splatfacto --data {shlex.quote(str(splats))} leco-photographs"
            ),
        ),
        part(
            "volume.npz",
            lambda: exported("npz", "volume.npz"),
            lambda facts: f"o(x) in {' x '.join(map(str, facts['shape']))} cells, for NumPy",
        ),
    ]
    if parts[0].facts is not None:
        page = "the kept volume to look around in, with any browser"
        parts.insert(1, Part("occupancy.html", parts[0].facts, page))
    if all(part.facts is None for part in parts):
        raise ValueError(f"nothing can be exported: {parts[0].said}")
    return parts, doubts(describe(occupancy))


def _part(folder: Path, name: str, write: Callable[[], Facts], use: Callable[[Facts], str]) -> Part:
    """A part as it was written, or the line that says why it cannot be."""
    try:
        facts = write()
    except (ValueError, OSError) as error:
        older = "; the older one is left" if (folder / name).exists() else ""
        return Part(name, None, f"{error}{older}")
    return Part(name, facts, use(facts))


def _points_in_words(facts: Facts) -> str:
    colours = "of the photographs" if facts["photograph_colours"] else "o(x)"
    where = "in the coordinates of the data"
    if facts["frame"] == "run":
        where = "in the coordinates of the run, which does not say how it moved the data"
    earth = ", origin on earth in its head" if "geographic_origin" in facts else ""
    return f"{facts['points']:,} points of the surface {where}{earth}; colours: {colours}"


def in_words(folder: Path, parts: list[Part], doubted: list[str]) -> list[str]:
    """The folder as a table, a line for each part, then what is wrong with the occupancy."""
    rows = [part for part in parts if part.facts is not None]
    lines = [f"wrote into {folder}:"]
    lines += [f"  {part.name:<14}  {part.said}" for part in rows]
    lines += [f"not written: {p.name}: {p.said}" for p in parts if p.facts is None]
    return lines + doubted
