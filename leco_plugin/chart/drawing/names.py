"""Names beside points of a panel, where they cover neither one another nor a point."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

NAME_WIDTH = 0.019
"""Of a letter beside a point of the large panel, of the panel's."""
HALF_HEIGHT = 0.035
"""Of a name, of the panel's height."""
FAR = 0.1
"""Of the panel's size: from there on a line leads from a point to its name."""
ACROSS = (0.022, 0.12, 0.22)
UP = (0.06, 0.0, 0.13, 0.2, 0.27, 0.34, 0.41)
"""Distances of a name from its point, from near to far, of the panel's width and height."""


class Box(NamedTuple):
    """A rectangle in the panel, which goes from 0 to 1."""

    left: float
    low: float
    right: float
    high: float

    @property
    def inside(self) -> bool:
        """Whether all of it lies in the panel."""
        return min(self.left, self.low) >= 0.0 and max(self.right, self.high) <= 1.0

    def covers(self, other: Box) -> float:
        """The area that both share."""
        width = min(self.right, other.right) - max(self.left, other.left)
        height = min(self.high, other.high) - max(self.low, other.low)
        return max(width, 0.0) * max(height, 0.0)


def name_points(
    axes: Any,
    places: Sequence[tuple[float, float]],
    names: Sequence[str],
    colours: Sequence[str],
    others: Sequence[tuple[float, float]] = (),
) -> None:
    """Names beside points, each where it covers neither another name nor a point, nor `others`;
    where there is no such place, where it covers least."""
    in_axes = axes.transAxes.inverted()
    spots = in_axes.transform(axes.transData.transform(places)).tolist()
    filled = in_axes.transform(axes.transData.transform([*places, *others])).tolist()
    taken = [Box(x - 0.012, y - 0.03, x + 0.012, y + 0.03) for x, y in filled]
    for (x, y), name, colour in zip(spots, names, colours):
        boxes = list(_places_beside(x, y, NAME_WIDTH * len(name)))
        inside = [box for box in boxes if box.inside] or boxes
        box = min(inside, key=lambda one: sum(one.covers(other) for other in taken))
        taken.append(box)
        _write(axes, (x, y), box, name, colour)


def _places_beside(x: float, y: float, width: float) -> Iterator[Box]:
    """Where the name of a point may stand, the best first."""
    for across in ACROSS:
        for up in UP:
            for middle in dict.fromkeys((y + up, y - up)):
                for left in (x + across, x - across - width):
                    yield Box(left, middle - HALF_HEIGHT, left + width, middle + HALF_HEIGHT)


def _write(axes: Any, point: tuple[float, float], box: Box, name: str, colour: str) -> None:
    """A name in its place, with a line to its point where that is far."""
    x, y = point
    side = 0.0 if box.left > x else 1.0
    end, middle = (box.right if side else box.left), (box.low + box.high) / 2.0
    is_far = max(abs(middle - y), abs(end - x)) > FAR
    axes.annotate(
        name,
        (x, y),
        xycoords="axes fraction",
        xytext=(end, middle),
        ha="right" if side else "left",
        va="center",
        color=colour,
        fontweight="bold",
        arrowprops={"arrowstyle": "-", "color": colour, "relpos": (side, 0.5)} if is_far else None,
    )
