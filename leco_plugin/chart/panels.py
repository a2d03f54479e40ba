"""The lower panels of `chart.png`: accuracy, or kept volume, against one cost each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from leco_plugin.chart.summary import (
    BYTES,
    COSTS,
    LEARNING,
    RENDERING,
    Cost,
    Line,
    Representation,
    front,
)
from leco_plugin.chart.theme import Theme, plain, style

WIDE_RANGE = 8.0
"""Ratio of costs from which their axis is logarithmic."""


def draw_all_costs(panels: Sequence[Any], lines: Sequence[Line], theme: Theme) -> None:
    """PSNR against each of `COSTS`."""
    for panel, cost in zip(panels, COSTS):
        points = [(line, line.median(cost)) for line in lines]
        _draw_costs(panel, cost, points, theme, first=panel is panels[0])


def _draw_costs(
    axes: Any,
    cost: Cost,
    points: Sequence[tuple[Line, float | None]],
    theme: Theme,
    first: bool,
) -> None:
    """PSNR against one cost, and the front that no contender beats in both."""
    known = [(i, line, value) for i, (line, value) in enumerate(points) if value is not None]
    places = [(value, line.psnr) for _, line, value in known]
    for i, line, value in known:
        look = style(i, theme)
        axes.plot([value, value], [min(line.psnrs), max(line.psnrs)], color=look["color"])
        axes.plot(value, line.psnr, markersize=11, markeredgecolor=theme.page, **look)
    _cost_axis(axes, cost.title, cost.unit, [value for value, _ in places], theme)
    _draw_front(axes, places, theme)
    if first:
        axes.set_ylabel("PSNR, dB")


def _draw_front(
    axes: Any, places: Sequence[tuple[float, float]], theme: Theme, sign: float = 1.0
) -> None:
    """The border of what is beaten, as far as the panel goes; `sign` is -1 where less is better."""
    best = [places[i] for i in front([(cost, sign * gain) for cost, gain in places])]
    if not best:
        return
    costs, gains = ([point[i] for point in best] for i in (0, 1))
    worst, farthest = axes.get_ylim()[0], axes.get_xlim()[1]
    axes.step(
        [costs[0], *costs, farthest],
        [worst, *gains, gains[-1]],
        where="post",
        color=theme.ink,
        alpha=0.3,
        linewidth=5,
        zorder=1,
        scalex=False,
        scaley=False,
    )


def _cost_axis(axes: Any, title: str, unit: str, values: Sequence[float], theme: Theme) -> None:
    from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, StrMethodFormatter

    plain(axes, theme)
    positive = [value for value in values if value > 0.0]
    if positive and max(positive) > WIDE_RANGE * min(positive):
        axes.set_xscale("log")
        axes.set_xlim(0.6 * min(positive), 1.7 * max(positive))
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
        axes.xaxis.set_minor_formatter(NullFormatter())
    elif positive:
        axes.set_xlim(0.0, 1.15 * max(positive))
        axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.yaxis.set_major_locator(MaxNLocator(4))
    axes.margins(y=0.18)
    axes.set_title(f"{title}, {unit}" if unit else title, fontsize=11.5, loc="left")


def draw_representations(
    panels: Sequence[Any],
    held: Sequence[Representation],
    lines: Sequence[Line],
    theme: Theme,
) -> None:
    """What an occupancy keeps of the scene against its size and its learning time."""
    for panel, cost, values in (
        (panels[0], BYTES, [one.size for one in held]),
        (panels[1], LEARNING, [one.learn_seconds for one in held]),
    ):
        places = [(value, one.kept) for value, one in zip(values, held)]
        _cost_axis(panel, cost.title, cost.unit, values, theme)
        names = [line.name for line in lines]
        for place, one in zip(places, held):
            known = one.name in names
            look = style(names.index(one.name), theme) if known else {"marker": "x"}
            panel.plot(*place, markersize=11, **{"color": theme.ink, **look})
            if not known:
                _name_point(panel, one.name, place)
        panel.invert_yaxis()
        _draw_front(panel, places, theme, sign=-1.0)
    panels[0].set_ylabel("volume kept, %")
    points = [(line, line.median(RENDERING)) for line in lines]
    _draw_costs(panels[2], RENDERING, points, theme, first=False)
    panels[2].set_title("rendering an image, s: PSNR", fontsize=11.5, loc="left")


def _name_point(axes: Any, name: str, place: tuple[float, float]) -> None:
    """A name beside a point, on the side where the panel has room."""
    x, _ = axes.transAxes.inverted().transform(axes.transData.transform(place))
    side, align = (8, "left") if x < 0.6 else (-8, "right")
    axes.annotate(
        name,
        place,
        xytext=(side, 0),
        textcoords="offset points",
        va="center",
        ha=align,
        fontsize=10,
    )
