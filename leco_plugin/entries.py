"""What other packages registered in one of our entry-point groups."""

from __future__ import annotations

import warnings
from importlib.metadata import EntryPoint, entry_points
from typing import Any


def foreign_entries(group: str, ours: frozenset[str] = frozenset()) -> dict[str, Any]:
    """Loads the entries of a group but for `ours`; a broken one is left out with a warning."""
    entries = [entry for entry in entry_points(group=group) if entry.name not in ours]
    loaded = {entry.name: _load(entry) for entry in entries}
    return {name: value for name, value in loaded.items() if value is not None}


def _load(entry: EntryPoint) -> Any:
    try:
        return entry.load()
    except Exception as error:  # noqa: BLE001 (whatever a foreign module raises)
        warnings.warn(f"{entry.group} {entry.name!r} ({entry.value}): {error!r}", stacklevel=4)
        return None
