"""What the subcommands of `leco` share: the file that is meant, and `--json`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any


def occupancy_of(path: Path) -> Path:
    """The file that is meant: itself, or the newest occupancy in a folder of runs.

    Raises:
        ValueError: there is neither, or none in the folder.
    """
    give = (
        "give an occupancy.safetensors, or a folder with a run that left one, as "
        "outputs/SCENE/leco-occupancy"
    )
    if not path.exists():
        raise ValueError(f"there is no {path}: {give}")
    if not path.is_dir():
        return path
    from leco_plugin.hosts.guided_start import occupancy_file

    file = occupancy_file(path)
    if file is None or not file.exists():
        raise ValueError(f"there is no occupancy.safetensors in {path}: {give}")
    return file


def check_json(path: Path | None) -> None:
    """Before work that takes minutes, whether its report has a place."""
    check_place("--json", path)


def check_place(option: str, path: Path | None) -> None:
    """Whether a file may be written there, its folders made.

    Raises:
        ValueError: it is a folder, or one of its folders is a file or cannot be written to.
    """
    if path is None:
        return
    if path.is_dir():
        raise ValueError(f"{option} {path} is a folder; give a file")
    nearest = next(folder for folder in path.absolute().parents if folder.exists())
    if not nearest.is_dir():
        raise ValueError(f"{option} {path}: {nearest} is a file, not a folder")
    if not os.access(nearest, os.W_OK):
        raise ValueError(f"{option} {path}: {nearest} cannot be written to")


def check_picture(option: str, path: Path | None, moving: bool = False) -> None:
    """As `check_place`, and whether a picture of this kind can be drawn.

    Args:
        moving: whether a .gif may be asked for, too.
    Raises:
        ValueError: as `check_place`, or its kind is not known.
    """
    check_place(option, path)
    if path is None:
        return
    from matplotlib.backend_bases import FigureCanvasBase

    kinds = {*FigureCanvasBase.get_supported_filetypes(), *(["gif"] if moving else [])}
    if path.suffix[1:].lower() not in kinds:
        raise ValueError(f"{option} {path} ends in none of {', '.join(sorted(kinds))}")


def write_json(path: Path | None, value: Any) -> None:
    """Writes a report where one was asked for."""
    if path is not None:
        from leco_plugin.scenes.whole_files import write_json as write

        write(path, value)
