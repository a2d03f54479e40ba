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
ROW = 0.065
"""Height of a name at the foot of a panel, of the panel's."""


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
    _cost_axis(axes, cost.titled, [value for value, _ in places], theme)
    _draw_front(axes, places, theme)


def _draw_front(
    axes: Any,
    places: Sequence[tuple[float, float]],
    theme: Theme,
    sign: float = 1.0,
    rightwards: bool = False,
) -> None:
    """The border of what is beaten, as far as the panel goes.

    Args:
        sign: -1 where less of the vertical axis is better.
        rightwards: whether more of the horizontal one is.
    """
    across = -1.0 if rightwards else 1.0
    best = [places[i] for i in front([(across * cost, sign * gain) for cost, gain in places])]
    if not best:
        return
    costs, gains = ([point[i] for point in best] for i in (0, 1))
    worst, farthest = axes.get_ylim()[0], axes.get_xlim()[0 if rightwards else 1]
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


def _cost_axis(axes: Any, title: str, values: Sequence[float], theme: Theme) -> None:
    """The axis of a cost, logarithmic over a wide range."""
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
    axes.set_title(title, fontsize=11.5, loc="left")


def draw_kept(
    axes: Any,
    title: str,
    figure: str,
    held: Sequence[Representation],
    lines: Sequence[Line],
    theme: Theme,
) -> list[tuple[float, float]]:
    """What each occupancy keeps of the scene against one cost of it, less of both up and left.

    Args:
        title: of the cost, with its unit.
        figure: its name in `Held`, which all of `held` have.
    Returns:
        The places of the points.
    """
    values = [one.median(figure) for one in held]
    places = [(value, one.kept) for value, one in zip(values, held)]
    _cost_axis(axes, title, values, theme)
    for place, one in zip(places, held):
        axes.plot(*place, zorder=3, **look_of(one, held, lines, theme))
    axes.invert_yaxis()
    _draw_front(axes, places, theme, sign=-1.0)
    return places


def look_of(
    one: Representation, held: Sequence[Representation], lines: Sequence[Line], theme: Theme
) -> dict[str, Any]:
    """Colour and marker: those of its line, ours larger; for small gates those of the large one of
    their kind, hollow but a star for ours; a cross for grids."""
    names = [line.name for line in lines]
    size = {"markersize": 15 if one.ours else 11}
    if one.name in names:
        return style(names.index(one.name), theme) | size
    large = [other.name for other in held if other.name in names and one.is_small_of(other)]
    if not large:
        return {"marker": "x", "color": theme.ink, "linestyle": "none"} | size
    look = style(names.index(large[0]), theme) | size
    if one.ours:
        return look | {"marker": "*"}
    return look | {"markerfacecolor": theme.page, "markeredgewidth": 2.0, "linestyle": "none"}


def draw_learned(
    axes: Any, learned: Sequence[Learned], lines: Sequence[Line], theme: Theme
) -> None:
    """Space that gates keep at equal loss against PSNR after equal steps, each seed and all of
    them; who did not always freeze one is named below."""
    from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, StrMethodFormatter

    looks = {line.name: style(i, theme) for i, line in enumerate(lines)}
    shown = [one for one in learned if one.is_measured]
    places = [(one.psnr, one.kept) for one in shown]
    seeds = []
    for one, place in zip(shown, places):
        look = looks[one.name]
        for seed, kept in one.kept_by_seed.items():
            seeds.append((one.psnrs[seed], kept))
            axes.plot(*seeds[-1], alpha=0.45, markersize=6, **look)
        axes.plot(*place, markersize=13, markeredgecolor=theme.page, zorder=3, **look)
    plain(axes, theme)
    axes.set_yscale("log")
    axes.margins(x=0.08, y=0.18)
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.xaxis.set_major_locator(MaxNLocator(6))
    axes.invert_yaxis()
    axes.set_ylabel("space kept, %")
    axes.set_xlabel("PSNR on unseen photographs, dB")
    never = [one.name for one in learned if not one.is_measured]
    _name_at_foot(
        axes,
        [f"{name}: not always frozen" for name in never],
        [looks[one]["color"] for one in never],
    )
    _draw_front(axes, places, theme, sign=-1.0, rightwards=True)
    names = [f"{one.name}{_never_guided(one)}" for one in shown]
    name_points(axes, places, names, [looks[one.name]["color"] for one in shown], seeds)


def _name_at_foot(axes: Any, names: Sequence[str], colours: Sequence[str]) -> None:
    """Names one over another at the foot of a panel whose vertical axis is logarithmic and less of
    which is up; the axis goes on there as far as they need."""
    if not names:
        return
    share = ROW * (len(names) + 0.5)
    worst, best = axes.get_ylim()
    axes.set_ylim(worst * (worst / best) ** (share / (1.0 - share)), best)
    for row, (name, colour) in enumerate(zip(reversed(names), reversed(colours))):
        axes.annotate(
            name,
            (0.01, 0.03 + ROW * row),
            xycoords="axes fraction",
            color=colour,
            fontweight="bold",
        )


def _never_guided(one: Learned) -> str:
    """What is added to the name of a contender whose gates were frozen as the training ended."""
    return " (frozen at the end)" if one.guided_nothing == one.seeds else ""
