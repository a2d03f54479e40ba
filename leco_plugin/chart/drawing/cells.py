"""Tables in Markdown, and how figures stand in them."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence


def rows(header: Sequence[str], cells: Sequence[Sequence[str]]) -> str:
    """A table."""
    lines = [header, ["---"] * len(header), *cells]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def cell(text: str) -> str:
    """Text that cannot break a table."""
    return text.replace("|", "\\|")


def number(value: float | None) -> str:
    """Three digits, or a dash where there is no number."""
    if value is None:
        return "-"
    if abs(value) >= 100.0 or value == int(value):
        return f"{value:.0f}"
    return f"{value:.3g}"


def spread(
    values: Sequence[float | None],
    form: str,
    middle_of: Callable[[Sequence[float]], float] = statistics.median,
) -> str:
    """Median or mean, and where there are several, least and most; a dash where a seed has none."""
    known = [value for value in values if value is not None]
    if len(known) < len(values) or not known:
        return "-"
    middle = format(middle_of(known), form)
    if len(known) == 1:
        return middle
    return f"{middle} ({min(known):{form}} to {max(known):{form}})"
