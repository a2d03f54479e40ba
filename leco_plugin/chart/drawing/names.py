"""Names beside points of a panel, where they cover neither one another nor a point."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

FAR = 0.1
"""Of the panel's size: from there on a line leads from a point to its name."""
ACROSS = (0.022, 0.07, 0.12, 0.17, 0.22)
UP = (0.06, 0.0, 0.13, 0.2, 0.27, 0.34, 0.41)
"""Distances of a name from its point, from near to far, of the panel's width and height."""
MARGIN = 1.15
"""Of the height of a name, of what is left free for it."""
DOTS = 6
"""Places along a line to a name at which it is to cross nothing."""


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


class Place(NamedTuple):
    """Where a name may stand beside a point of the panel."""

    x: float
    y: float
    box: Box

    @property
    def end(self) -> tuple[float, float]:
        """The end of the name that is nearer to the point."""
        side = self.box.left if self.is_right else self.box.right
        return side, (self.box.low + self.box.high) / 2.0

    @property
    def is_right(self) -> bool:
        """Whether the name begins to the right of the point."""
        return self.box.left > self.x

    @property
    def is_far(self) -> bool:
        """Whether a line leads to it."""
        across, middle = self.end
        return max(abs(across - self.x), abs(middle - self.y)) > FAR

    def filled(self) -> list[Box]:
        """What it takes up: the name, and the line to it."""
        if not self.is_far:
            return [self.box]
        across, middle = self.end
        shares = [(i + 1) / (DOTS + 1) for i in range(DOTS)]
        dots = [
            (self.x + t * (across - self.x), self.y + t * (middle - self.y)) for t in shares[1:]
        ]
        return [self.box, *(_around(x, y, 0.003, 0.006) for x, y in dots)]


def name_points(
    axes: Any,
    places: Sequence[tuple[float, float]],
    names: Sequence[str],
    colours: Sequence[str],
    others: Sequence[tuple[float, float]] = (),
) -> None:
    """Names beside points, each where neither it nor the line to it covers another name or a point,
    or one of `others`; where there is no such place, where it covers least."""
    in_axes = axes.transAxes.inverted()
    spots = in_axes.transform(axes.transData.transform(places)).tolist()
    filled = in_axes.transform(axes.transData.transform([*places, *others])).tolist()
    taken = [_around(x, y, 0.012, 0.03) for x, y in filled]
    written: list[Box] = []
    for (x, y), name, colour in zip(spots, names, colours):
        found = list(_places_beside(x, y, *size_of(axes, name)))
        inside = [place for place in found if place.box.inside] or found
        best = min(
            inside, key=lambda one: (_covered([one.box], written), _covered(one.filled(), taken))
        )
        taken += best.filled()
        written.append(best.box)
        _write(axes, best, name, colour)


def _covered(some: Sequence[Box], others: Sequence[Box]) -> float:
    return sum(one.covers(other) for one in some for other in others)


def size_of(axes: Any, name: str) -> tuple[float, float]:
    """Width and height of a name, of the panel's."""
    text = axes.text(0.0, 0.0, name, fontweight="bold")
    extent = text.get_window_extent().transformed(axes.transAxes.inverted())
    text.remove()
    return extent.width, extent.height


def _around(x: float, y: float, across: float, up: float) -> Box:
    return Box(x - across, y - up, x + across, y + up)


def _places_beside(x: float, y: float, width: float, height: float) -> Iterator[Place]:
    """Where the name of a point may stand, the best first."""
    half = MARGIN * height / 2.0
    for across in ACROSS:
        for up in UP:
            for middle in dict.fromkeys((y + up, y - up)):
                for left in (x + across, x - across - width):
                    yield Place(x, y, Box(left, middle - half, left + width, middle + half))


def _write(axes: Any, place: Place, name: str, colour: str) -> None:
    """A name in its place, with a line to its point where that is far."""
    side = 0.0 if place.is_right else 1.0
    axes.annotate(
        name,
        (place.x, place.y),
        xycoords="axes fraction",
        xytext=place.end,
        ha="right" if side else "left",
        va="center",
        color=colour,
        fontweight="bold",
        arrowprops={"arrowstyle": "-", "color": colour, "relpos": (side, 0.5)}
        if place.is_far
        else None,
    )
