"""Names beside points of a panel, where they cover neither one another nor a point."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

Boxes = NDArray[np.float64]
"""[N, 4] left, low, right, high in a panel that goes from 0 to 1."""

FAR = 0.1
"""Share of the panel's size from which on a line leads from a point to its name."""
ACROSS = (0.022, 0.07, 0.12, 0.17, 0.22)
UP = (0.06, 0.0, 0.13, 0.2, 0.27, 0.34, 0.41)
"""Distances that are tried, from near to far, as shares of the panel's width and height."""
MARGIN = 1.15
"""Height that is left free for a name, as a multiple of its own."""
POINT = (0.012, 0.03)
"""Half the width and height that a point takes up."""
ALONG = np.arange(2, 7)[:, None] / 7
"""[5, 1] shares of the line to a name at which it is to cross nothing."""


def name_points(
    axes: Any,
    places: Sequence[tuple[float, float]],
    names: Sequence[str],
    colours: Sequence[str],
    others: Sequence[tuple[float, float]] = (),
) -> None:
    """Writes names beside points, each where it and the line to it cover least.

    Args:
        others: further points that are not to be covered.
    """
    to_panel = axes.transData + axes.transAxes.inverted()
    taken = boxes_around(to_panel.transform([*places, *others]), *POINT)
    written = np.zeros((0, 4))
    for point, name, colour in zip(to_panel.transform(places), names, colours):
        found = _places_beside(point, *size_of(axes, name))
        inside = [box for box in found if box[:2].min() >= 0.0 and box[2:].max() <= 1.0]
        boxes = [np.vstack([box, _line_to(box, point)]) for box in inside or found]
        best = min(boxes, key=lambda one: (covered(one[:1], written), covered(one, taken)))
        taken, written = np.vstack([taken, best]), np.vstack([written, best[:1]])
        end = _end_of(best[0], point)
        is_right = bool(best[0][0] > point[0])
        line = {"arrowstyle": "-", "color": colour, "relpos": (0.0 if is_right else 1.0, 0.5)}
        axes.annotate(
            name,
            point,
            xycoords="axes fraction",
            xytext=end,
            ha="left" if is_right else "right",
            va="center",
            color=colour,
            fontweight="bold",
            arrowprops=line if len(best) > 1 else None,
        )


def size_of(axes: Any, name: str) -> tuple[float, float]:
    """Width and height of a name, as shares of the panel's."""
    text = axes.text(0.0, 0.0, name, fontweight="bold")
    extent = text.get_window_extent().transformed(axes.transAxes.inverted())
    text.remove()
    return extent.width, extent.height


def boxes_around(points: Any, across: float, up: float) -> Boxes:
    """Boxes [N, 4] around points [N, 2]."""
    size = np.array([across, up])
    return np.hstack([points - size, points + size])


def covered(some: Boxes, others: Boxes) -> float:
    """The area that boxes [N, 4] share with others [M, 4]."""
    low = np.maximum(some[:, None, :2], others[None, :, :2])
    high = np.minimum(some[:, None, 2:], others[None, :, 2:])
    return float((high - low).clip(min=0.0).prod(axis=-1).sum())


def _places_beside(point: Any, width: float, height: float) -> list[Any]:
    """Boxes in which the name of a point may stand, the best first."""
    (x, y), half = point, MARGIN * height / 2.0
    return [
        np.array([left, middle - half, left + width, middle + half])
        for across, up in product(ACROSS, UP)
        for middle in dict.fromkeys((y + up, y - up))
        for left in (x + across, x - across - width)
    ]


def _end_of(box: Any, point: Any) -> Any:
    """[2] the end of a name that is nearer to its point."""
    return np.array([box[0] if box[0] > point[0] else box[2], (box[1] + box[3]) / 2.0])


def _line_to(box: Any, point: Any) -> Boxes:
    """Boxes along the line to a name; none beside its point."""
    way = _end_of(box, point) - point
    if np.abs(way).max() <= FAR:
        return np.zeros((0, 4))
    return boxes_around(point + ALONG * way, 0.003, 0.006)


def spread(wanted: Sequence[float], apart: float) -> list[float]:
    """Places in [0, 1] as near to the wanted ones as they can be when kept a distance apart."""
    order = np.argsort(wanted, kind="stable")
    steps = apart * np.arange(len(wanted))
    lowest = np.maximum.accumulate(np.maximum(np.array(wanted)[order] - steps, 0.0))
    inside = np.minimum(lowest, 1.0 - steps[-1])
    places = np.empty(len(wanted))
    places[order] = np.minimum.accumulate(inside[::-1])[::-1] + steps
    return [float(place) for place in places]
