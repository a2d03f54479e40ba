"""What other packages registered in one of our entry-point groups."""

from __future__ import annotations

import warnings
from importlib.metadata import EntryPoint, entry_points
from typing import TypeVar

Kind = TypeVar("Kind")


def foreign_entries(
    group: str, kind: type[Kind], ours: frozenset[str] = frozenset()
) -> dict[str, Kind]:
    """Loads the entries of a group but for `ours`; a broken one is left out with a warning.

    Args:
        kind: what an entry of this group has to name.
    """
    entries = [entry for entry in entry_points(group=group) if entry.name not in ours]
    loaded = {}
    for entry in entries:
        found = _load(entry, kind)
        if isinstance(found, kind):
            loaded[entry.name] = found
        else:
            warnings.warn(f"{group} {entry.name!r} is left out: {found}", stacklevel=3)
    return loaded


def why_left_out(group: str, kind: type[Kind], name: str) -> str | None:
    """What is wrong with a registered entry; None where nothing is, or none has this name."""
    for entry in entry_points(group=group):
        found = _load(entry, kind) if entry.name == name else None
        if isinstance(found, str):
            return found
    return None


def _load(entry: EntryPoint, kind: type[Kind]) -> Kind | str:
    """What an entry names, or in one line why that is of no use."""
    try:
        found = entry.load()
    except (Exception, SystemExit) as error:  # noqa: BLE001 (whatever a foreign module raises)
        said = ": ".join([type(error).__name__, *str(error).splitlines()[:1]])
        return f"{entry.value} cannot be loaded: {said}"
    if isinstance(found, kind):
        return found
    return f"{entry.value} is of type {type(found).__name__}, where a {kind.__name__} is expected"
