"""`leco export`: from the words on the command line to a file."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from leco_plugin.cli_reports import check_place
from leco_plugin.log import bar
from leco_plugin.occupancy import Occupancy
from leco_plugin.scenes.frames import moved

Format = Literal["ply", "nerfacc-grid"]
Frame = Literal["data", "run"]


def export(
    file: Path,
    format: Format,
    out: Path,
    resolution: int = 128,
    levels: int | None = None,
    frame: Frame | None = None,
) -> dict[str, Any]:
    """Writes an occupancy in another format.

    Args:
        file: an occupancy.
        format: `ply` or `nerfacc-grid`.
        out: of what is written.
        resolution: cells along the longest side, or along each axis of a grid.
        levels: of a grid.
        frame: of points, `data` for the coordinates of the data's own files, `run` for those of the
            run. None is `data` where the file says how. A grid is in those of the run.
    Returns:
        What was written, as JSON values.
    Raises:
        ValueError, OSError: the file is no occupancy, a size is out of range, there is nothing to
            export, or it cannot be written there.
    """
    if format == "ply" and levels is not None:
        raise ValueError("points have no levels: --levels goes with --format nerfacc-grid")
    if format != "ply" and frame == "data":
        raise ValueError(
            "a grid lies along the axes of the run: --frame data goes with --format ply"
        )
    check_place("--out", out)
    occupancy = Occupancy.load(file)
    if format == "ply":
        from leco_plugin.export.points import kept_surface, to_the_data, write_ply

        back = None if frame == "run" else to_the_data(occupancy)
        if back is None and frame == "data":
            raise ValueError(
                f"{file} does not say how its run moved and scaled the data: give --frame run"
            )
        with bar(f"Asking the gate about cells of 1/{resolution}") as show:
            surface = kept_surface(occupancy, resolution, show)
        if back is not None:
            surface = surface._replace(positions=moved(surface.positions.double(), back))
        write_ply(surface, out)
        facts: dict[str, Any] = {
            "points": len(surface.positions),
            "frame": "run" if back is None else "data",
        }
    else:
        from leco_plugin.export.nerfacc_grid import grid_buffers, write_grid

        with bar(f"Asking the gate about {resolution}^3 cells a level") as show:
            buffers = grid_buffers(occupancy, resolution, levels, show)
        write_grid(buffers, out)
        facts = {
            "frame": "run",
            "levels": len(buffers["aabbs"]),
            "aabbs": buffers["aabbs"].tolist(),
            "kept_share_of_cells": float(buffers["binaries"].double().mean()),
        }
    return {
        "format": 1,
        "written": format,
        "resolution": resolution,
        **facts,
        "bytes": out.stat().st_size,
    }
