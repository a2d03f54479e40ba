"""What the subcommands of `leco` share: the file that is meant, and `--json`."""

from __future__ import annotations

from pathlib import Path
from typing import Any


def occupancy_of(path: Path) -> Path:
    """The file that is meant: itself, or the newest occupancy in a folder of runs.

    Raises:
        ValueError: there is neither, or none in the folder.
    """
    if not path.exists():
        raise ValueError(
            f"there is no {path}: give an occupancy.safetensors, or a folder with a run that left "
            "one, as outputs/SCENE/leco-occupancy"
        )
    if not path.is_dir():
        return path
    from leco_plugin.models.guided_start import occupancy_file

    file = occupancy_file(path)
    if file is None or not file.exists():
        raise ValueError(f"there is no occupancy.safetensors in {path}: no run has frozen its gate")
    return file


def check_json(path: Path | None) -> None:
    """Before work that takes minutes, whether its report has a place."""
    if path is not None and path.is_dir():
        raise ValueError(f"--json {path} is a folder; give a file")


def write_json(path: Path | None, value: Any) -> None:
    """Writes a report where one was asked for."""
    if path is not None:
        from leco_plugin.evaluation.json_file import write_json as write

        write(path, value)
