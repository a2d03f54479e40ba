"""How many cells an export may ask the gate about."""

from __future__ import annotations

MOST_CELLS = 1 << 28
"""What is known of each of them is held until the file is written: some gigabytes of memory."""


def require_few(cells: int, said: str) -> None:
    """Refuses more cells than memory may be expected to hold.

    Args:
        cells: of the whole export.
        said: how they lie, for the message.
    Raises:
        ValueError: there are more than `MOST_CELLS`.
    """
    if cells > MOST_CELLS:
        raise ValueError(
            f"{said} are too many cells: an export has at most {MOST_CELLS} in all, as "
            f"{int(MOST_CELLS ** (1 / 3))}^3 are; give a smaller --resolution"
        )
