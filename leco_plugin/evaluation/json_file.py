"""Reports on disk: strict JSON, written whole or not at all."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from leco_plugin.scenes.whole_files import write_whole


def write_json(path: Path, value: Any) -> None:
    """Writes `value` to `path`, whose parents are made.

    Raises:
        ValueError: it holds NaN or infinity, which are no JSON.
        OSError: nothing can be written there.
    """
    text = json.dumps(value, indent=2, allow_nan=False) + "\n"
    write_whole(path, lambda file: file.write(text.encode()))


def finite_or_null(values: dict[str, Any]) -> dict[str, Any]:
    """NaN and infinity are no JSON: None in their place."""
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in values.items()
    }
