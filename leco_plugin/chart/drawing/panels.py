"""Panels of `chart.png`: accuracy, or kept volume, against one cost each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from leco_plugin.chart.drawing.names import name_points
from leco_plugin.chart.drawing.theme import Theme, plain, style
from leco_plugin.chart.findings.learned import Learned
from leco_plugin.chart.findings.representations import Representation
from leco_plugin.chart.findings.summary import COSTS, Cost, Line, front

WIDE_RANGE = 8.0
"""Ratio of costs from which their axis is logarithmic."""


def draw_all_costs(panels: Sequence[Any], lines: Sequence[Line], theme: Theme) -> None:
    """PSNR against each of `COSTS`."""
    for panel, cost in zip(panels, COSTS):
        draw_cost(panel, cost, lines, theme)
    panels[0].set_ylabel("PSNR, dB")


def draw_cost(axes: Any, cost: Cost, lines: Sequence[Line], theme: Theme) -> None:
    """PSNR against one cost, and the front that no contender beats in both."""
    values = [line.median(cost) for line in lines]
    known = [
        (i, line, value) for i, (line, value) in enumerate(zip(lines, values)) if value is not None
    ]
    places = [(value, line.psnr) for _, line, value in known]
    for i, line, value in known:
        look = style(i, theme)
        axes.plot([value, value], [min(line.psnrs), max(line.psnrs)], color=look["color"])
        axes.plot(value, line.psnr, markersize=11, markeredgecolor=theme.page, **look)
    _cost_axis(axes, cost.title, cost.unit, [value for value, _ in places], theme)
    _draw_front(axes, places, theme)


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


def _cost_axis(
    axes: Any,
    title: str,
    unit: str,
    values: Sequence[float],
    theme: Theme,
    from_zero: bool = False,
) -> None:
    """The axis of a cost, logarithmic over a wide range unless it is to begin at zero."""
    from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, StrMethodFormatter

    plain(axes, theme)
    positive = [value for value in values if value > 0.0]
    if positive and max(positive) > WIDE_RANGE * min(positive) and not from_zero:
        axes.set_xscale("log")
        axes.set_xlim(0.6 * min(positive), 1.7 * max(positive))
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
        axes.xaxis.set_minor_formatter(NullFormatter())
    elif positive:
        axes.set_xlim(-0.02 * max(positive) * from_zero, 1.15 * max(positive))
        axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.yaxis.set_major_locator(MaxNLocator(4))
    axes.margins(y=0.18)
    axes.set_title(f"{title}, {unit}" if unit else title, fontsize=11.5, loc="left")


def draw_kept(
    axes: Any,
    cost: Cost,
    values: Sequence[float],
    held: Sequence[Representation],
    lines: Sequence[Line],
    theme: Theme,
) -> list[tuple[float, float]]:
    """What each occupancy keeps of the scene against one cost of it, less of both up and left.

    Args:
        values: of the cost, in the unit shown, for each of `held`.
    Returns:
        The places of the points.
    """
    places = [(value, one.kept) for value, one in zip(values, held)]
    _cost_axis(axes, cost.title, cost.unit, values, theme)
    for place, one in zip(places, held):
        size = 15 if one.ours else 11
        axes.plot(*place, markersize=size, zorder=3, **look_of(one, held, lines, theme))
    axes.invert_yaxis()
    _draw_front(axes, places, theme, sign=-1.0)
    return places


def look_of(
    one: Representation, held: Sequence[Representation], lines: Sequence[Line], theme: Theme
) -> dict[str, Any]:
    """Colour and marker: those of its line, a star of our colour for what our field has taught, and
    a cross for grids."""
    names = [line.name for line in lines]
    if one.name in names:
        return style(names.index(one.name), theme)
    ours = [names.index(other.name) for other in held if other.ours and other.name in names]
    if one.ours and ours:
        return {**style(ours[0], theme), "marker": "*"}
    return {"marker": "x", "color": theme.ink, "linestyle": "none"}


def draw_learned(
    axes: Any, learned: Sequence[Learned], lines: Sequence[Line], theme: Theme
) -> None:
    """What frozen gates skip against what they lose; contenders without any are named below."""
    looks = {line.name: style(i, theme) for i, line in enumerate(lines)}
    shown = [one for one in learned if one.facts]
    lost, skipped = "lost_surface_mass", "empty_fraction"
    points = {
        one.name: [(100.0 * facts[lost], 100.0 * facts[skipped]) for facts in one.facts]
        for one in shown
    }
    places = [
        (100.0 * (one.median(lost) or 0.0), 100.0 * (one.median(skipped) or 0.0)) for one in shown
    ]
    losses = [x for of in points.values() for x, _ in of]
    _cost_axis(axes, "lost surface mass", "%", losses, theme, from_zero=True)
    for one, place in zip(shown, places):
        look = looks[one.name]
        for point in points[one.name]:
            axes.plot(*point, alpha=0.45, markersize=6, **look)
        axes.plot(*place, markersize=13, markeredgecolor=theme.page, zorder=3, **look)
    axes.set_ylabel("candidates skipped, %")
    _draw_front(axes, places, theme)
    names = [
        one.name if one.always_frozen else f"{one.name}: {len(one.facts)} of {one.seeds} frozen"
        for one in shown
    ]
    others = [point for of in points.values() for point in of]
    name_points(axes, places, names, [looks[one.name]["color"] for one in shown], others)
    never = [one.name for one in learned if not one.facts]
    for row, name in enumerate(reversed(never)):
        axes.annotate(
            f"{name}: no gate was frozen",
            (0.01, 0.03 + 0.065 * row),
            xycoords="axes fraction",
            color=looks[name]["color"],
            fontweight="bold",
        )
