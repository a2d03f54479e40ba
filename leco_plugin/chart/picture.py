"""`chart.png`: accuracy against seconds of training above, against what it costs below.

For somebody who has five seconds: the sentence over it says what came out, every curve has its name
at its end, and in every panel better is up and to the left.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from leco_plugin.chart.summary import (
    BYTES,
    COSTS,
    LEARNING,
    LOST_SURFACE_MASS,
    RENDERING,
    Cost,
    Line,
    Representation,
    circumstances,
    front,
    headline,
    lines_of,
    representations_of,
    verdict,
)

MARKERS = "osD^vPX*<>"
CLOSE = 0.056
"""Least distance of two names at the ends of curves, of the panel's height."""
BAR = 0.032
"""Height of a bar at the foot of the panel, of the panel's."""
TITLE_WIDTH = 66
CHARACTER = 0.0098
"""Width of a letter of the names, of the figure's."""
HOW_TO_READ = "What it costs: up and left is better; nothing beats the grey front in both."
EQUAL_LOSS = f" All lose {LOST_SURFACE_MASS:.1%} of the surface."
WIDE_RANGE = 8.0
"""Ratio of costs from which their axis is logarithmic."""


@dataclass(frozen=True)
class Theme:
    """Colours on one kind of page."""

    page: str
    ink: str
    faint: str
    colours: tuple[str, ...]
    """Told apart also by colour-blind readers, together with the markers."""


LIGHT = Theme(
    "#ffffff",
    "#1f2328",
    "#d6dbe1",
    (
        *("#0969a8", "#c2410c", "#1a7f4b", "#8a3ffc", "#946200"),
        *("#bf2a6b", "#3b7d8c", "#5c5f66", "#6b8e23", "#a0522d"),
    ),
)
DARK = Theme(
    "#0d1117",
    "#e6edf3",
    "#30363d",
    (
        *("#58b1ff", "#ff9a5c", "#4cd08a", "#c9a3ff", "#e6bd4a"),
        *("#ff8ab5", "#7fd6e0", "#b6bcc4", "#b5d66b", "#e0a878"),
    ),
)


def draw(results: Mapping[str, Any], path: Path, theme: Theme = LIGHT) -> Path:
    """Draws the results of a chart that has at least one run.

    Args:
        results: as in `results.json`.
        path: of the picture.
        theme: of the page it is meant for.
    """
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    lines = lines_of(results)
    held = representations_of(lines)
    parts = ("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color")
    settings: dict[Any, Any] = {"font.size": 12, "axes.facecolor": theme.page}
    settings |= dict.fromkeys(parts, theme.ink)
    sentence = verdict(held) if len(held) > 1 else headline(results)
    with rc_context(settings):
        figure = Figure(figsize=(10, 8.4), facecolor=theme.page)
        FigureCanvasAgg(figure)
        title = textwrap.fill(sentence, TITLE_WIDTH)
        figure.text(0.015, 0.985, title, va="top", fontsize=17, fontweight="bold")
        figure.text(0.015, 0.895, circumstances(results), va="top", fontsize=11.5)
        widest = max(len(line.name) for line in lines)
        right = 0.93 - CHARACTER * min(widest + 6, 40)
        _draw_curves(figure.add_axes((0.075, 0.43, right - 0.075, 0.42)), lines, theme)
        explained = HOW_TO_READ + (EQUAL_LOSS if len(held) > 1 else "")
        figure.text(0.015, 0.335, explained, va="top", fontsize=11.5)
        below = [figure.add_axes((0.075 + 0.325 * i, 0.065, 0.255, 0.2)) for i in range(3)]
        if len(held) > 1:
            _draw_representations(below, held, lines, theme)
        else:
            for panel, cost in zip(below, COSTS):
                points = [(line, line.median(cost)) for line in lines]
                _draw_costs(panel, cost, points, theme, first=panel is below[0])
        figure.savefig(path, dpi=160)
    return path


def _style(i: int, theme: Theme) -> dict[str, Any]:
    return {"color": theme.colours[i % len(theme.colours)], "marker": MARKERS[i % len(MARKERS)]}


def _plain(axes: Any, theme: Theme) -> None:
    axes.grid(color=theme.faint, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def _draw_curves(axes: Any, lines: Sequence[Line], theme: Theme) -> None:
    longest = max(run["train_seconds"] for line in lines for run in line.runs)
    ends = []
    for i, line in enumerate(lines):
        style = _style(i, theme)
        seconds, mean, low, high = line.curve()
        dashes = "-" if line.learned else (0, (5, 2))
        axes.plot(seconds, mean, linestyle=dashes, linewidth=2.6, color=style["color"])
        axes.fill_between(seconds, low, high, color=style["color"], alpha=0.16, linewidth=0)
        axes.plot(seconds[-1], mean[-1], markersize=9, **style)
        ends.append((float(seconds[-1]), float(mean[-1]), f"{line.name}  {mean[-1]:.1f}"))
    _plain(axes, theme)
    axes.set_xlim(0.0, 1.02 * longest)
    axes.margins(y=0.05)
    _draw_learning(axes, lines, theme)
    axes.set_ylabel("PSNR on test images, dB")
    axes.set_xlabel("seconds of training")
    _name_ends(axes, ends, theme)


def _name_ends(axes: Any, ends: Sequence[tuple[float, float, str]], theme: Theme) -> None:
    """Names to the right of the panel, each as near to the end of its curve as there is room."""
    low, high = axes.get_ylim()
    wanted = [(value - low) / (high - low) for _, value, _ in ends]
    for i, place in enumerate(spread(wanted, CLOSE)):
        seconds, value, name = ends[i]
        axes.annotate(
            name,
            (seconds, value),
            xytext=(1.03, place),
            textcoords="axes fraction",
            va="center",
            color=_style(i, theme)["color"],
            fontweight="bold",
            annotation_clip=False,
            arrowprops={
                "arrowstyle": "-",
                "color": _style(i, theme)["color"],
                "relpos": (0.0, 0.5),
                "shrinkA": 2.0,
                "shrinkB": 6.0,
            },
        )


def spread(wanted: Sequence[float], apart: float) -> list[float]:
    """Places in [0, 1] as near to the wanted ones as they can be when kept a distance apart."""
    order = sorted(range(len(wanted)), key=lambda i: wanted[i])
    places = [0.0] * len(wanted)
    lowest = 0.0
    for i in order:
        places[i] = max(wanted[i], lowest)
        lowest = places[i] + apart
    highest = 1.0
    for i in reversed(order):
        places[i] = min(places[i], highest)
        highest = places[i] - apart
    return places


def _draw_learning(axes: Any, lines: Sequence[Line], theme: Theme) -> None:
    """Bars at the foot of the panel: how much of the time went into learning an occupancy."""
    bars = [(i, seconds) for i, line in enumerate(lines) if (seconds := line.median(LEARNING))]
    if not bars:
        return
    low, high = axes.get_ylim()
    share = BAR * (len(bars) + 2.2)
    axes.set_ylim(low - share / (1.0 - share) * (high - low), high)
    for row, (i, seconds) in enumerate(reversed(bars)):
        at = BAR * (row + 0.8)
        axes.plot(
            [0.0, seconds],
            [at, at],
            transform=axes.get_xaxis_transform(),
            color=theme.colours[i % len(theme.colours)],
            linewidth=5,
            solid_capstyle="butt",
        )
    axes.annotate(
        "of which learning the occupancy",
        (0.0, BAR * (len(bars) + 0.6)),
        xycoords=axes.get_xaxis_transform(),
        xytext=(4, 0),
        textcoords="offset points",
        fontsize=10,
    )


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
        style = _style(i, theme)
        axes.plot([value, value], [min(line.psnrs), max(line.psnrs)], color=style["color"])
        axes.plot(value, line.psnr, markersize=11, markeredgecolor=theme.page, **style)
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

    _plain(axes, theme)
    positive = [value for value in values if value > 0.0]
    if positive and max(positive) > WIDE_RANGE * min(positive):
        axes.set_xscale("log")
        axes.set_xlim(0.6 * min(positive), 1.7 * max(positive))
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
        axes.xaxis.set_minor_formatter(NullFormatter())
    elif values:
        axes.set_xlim(0.0, 1.15 * max(values))
        axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.yaxis.set_major_locator(MaxNLocator(4))
    axes.margins(y=0.18)
    axes.set_title(f"{title}, {unit}" if unit else title, fontsize=11.5, loc="left")


def _draw_representations(
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
            style = _style(names.index(one.name), theme) if known else {"marker": "x"}
            panel.plot(*place, markersize=11, **{"color": theme.ink, **style})
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
