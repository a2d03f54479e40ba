"""Reports on disk: strict JSON, written whole or not at all."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.whole_files import write_whole


def write_json(path: Path, value: Any) -> None:
    """Writes `value` to `path`, whose parents are made.

    Raises:
        ValueError: it holds NaN or infinity, which are no JSON.
        OSError: nothing can be written there.
    """
    text = json.dumps(value, indent=2, allow_nan=False) + "\n"
    write_whole(path, lambda file: file.write(text.encode()))


def read_object(file: Path, else_say: str) -> dict[str, Any]:
    """The JSON object in a file.

    Args:
        else_say: what is said of the file where it is damaged, and what to do.
    Raises:
        InputError: it is.
    """
    try:
        found = json.loads(file.read_text())
    except ValueError:  # no JSON, or no text
        found = None
    if not isinstance(found, dict):
        raise InputError(f"{file} {else_say}")
    return found


def finite_or_null(values: dict[str, Any]) -> dict[str, Any]:
    """NaN and infinity are no JSON: None in their place."""
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in values.items()
    }
