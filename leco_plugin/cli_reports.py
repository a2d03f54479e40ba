"""`--json` of every subcommand of `leco`."""

from __future__ import annotations

from pathlib import Path
from typing import Any


def check_json(path: Path | None) -> None:
    """Before work that takes minutes, whether its report has a place."""
    if path is not None and path.is_dir():
        raise ValueError(f"--json {path} is a folder; give a file")


def write_json(path: Path | None, value: Any) -> None:
    """Writes a report where one was asked for."""
    if path is not None:
        from leco_plugin.evaluation.json_file import write_json as write

        write(path, value)
