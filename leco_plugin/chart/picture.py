"""`chart.png`: what came out in a sentence, then panels in which better is up and to the left."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leco_plugin.chart.learned import not_always_frozen
from leco_plugin.chart.panels import Panel, Point, Shown, finding_of, shown_of
from leco_plugin.chart.summary import (
    LEARNING,
    LOST_SURFACE_MASS,
    Line,
    at_equal_loss,
    best_so_far,
    circumstances,
)
from leco_plugin.chart.theme import (
    LIGHT,
    Theme,
    log_axis,
    new_figure,
    plain,
    save_picture,
    style,
    themed,
)

CLOSE = 0.056
"""Least distance of two names at the ends of curves, as a share of the panel's height."""
BAR, MOST_BARS = 0.032, 0.45
"""Height of a bar at the foot of a panel, and the most of all bars, as shares of the panel's."""
WIDE_RANGE = 8.0
"""Ratio of costs from which on their axis is logarithmic."""
HIDDEN, RIM = 4.0, 4.0
"""Points between markers up to which one would hide the other, and by which that is larger."""
TITLE_WIDTH, TEXT_WIDTH = 66, 104
CHARACTER, LONGEST_NAME = 0.0098, 40
"""Width of a letter, as a share of the figure's; letters of the longest name that is as large."""
TOP, LINE_HEIGHT, SMALL_LINE_HEIGHT = 0.985, 0.04, 0.0235
"""Top of the title, and line heights of it and of the text below, shares of the figure's height."""
COSTS_BELOW = "What it costs. Up and left is better; nothing is better in both than the grey line."
PSNR_BELOW = "PSNR on unseen photographs, dB, against what it costs. Up and left is better:"
KEPT_SPACE = f"Space that must be sampled where each loses {LOST_SURFACE_MASS:.1%} of the surface"


def draw(results: Mapping[str, Any], path: Path, theme: Theme = LIGHT) -> Path:
    """Draws the results of a chart that has at least one run, for a page of a theme."""
    shown = shown_of(results)
    with themed(theme):
        figure = new_figure((10, 8.4), theme.page)
        title = balanced(finding_of(results, short=True))
        figure.text(0.015, TOP, title, va="top", fontsize=17, fontweight="bold")
        below = TOP - 0.01 - LINE_HEIGHT * (title.count("\n") + 1)
        said = [f"{finding_of(results)}.", circumstances(results)]
        said = [line for one in said for line in balanced(one, TEXT_WIDTH).splitlines()]
        figure.text(0.015, below, "\n".join(said), va="top", fontsize=11.5, parse_math=False)
        below -= SMALL_LINE_HEIGHT * (len(said) - 1)
        if shown.space:
            _draw_occupancies(figure, below, shown, theme)
        else:
            _draw_race(figure, below - 0.08 - 0.43, shown, theme)
        return save_picture(figure, path, results, dpi=160)


def balanced(text: str, width: int = TITLE_WIDTH) -> str:
    """A text in as few lines of so many letters as hold it, all about as long."""
    lines, widths = len(textwrap.wrap(text, width)), range(1, width + 1)
    return textwrap.fill(text, next(n for n in widths if len(textwrap.wrap(text, n)) <= lines))


def _draw_race(figure: Any, height: float, shown: Shown, theme: Theme) -> None:
    """Curves against training time above, costs below."""
    lines = shown.lines
    figure.text(0.015, 0.335, COSTS_BELOW, va="top", fontsize=11.5)
    widest = max(len(name_of_end(line)) for line in lines)
    right = 0.93 - CHARACTER * min(widest, LONGEST_NAME)
    main = figure.add_axes((0.075, 0.43, right - 0.075, height))
    draw_curves(main, lines, theme)
    main.set_title("PSNR on unseen photographs, dB: more is better", fontsize=11.5, loc="left")
    main.set_xlabel("seconds of training")
    _draw_learning(main, lines, theme)
    name_ends(main, lines, theme)
    panels = [figure.add_axes((0.075 + 0.325 * i, 0.065, 0.255, 0.2)) for i in range(3)]
    for axes, panel in zip(panels, shown.costs):
        draw_panel(axes, panel, theme)
    panels[0].set_ylabel("PSNR, dB")


def _draw_occupancies(figure: Any, top: float, shown: Shown, theme: Theme) -> None:
    """Space kept at equal loss above; curves and costs, small, below."""
    lines, (first, *others) = shown.lines, shown.space
    grids = [row for one in at_equal_loss(lines) for row in one["grids"]]
    held = "as octrees" if any("octree_bytes" in row for row in grids) else "in bits"
    figure.text(0.015, 0.335, PSNR_BELOW, va="top", fontsize=11.5)
    by_psnr = first.more_x
    better = ", against PSNR. Up and right is better:" if by_psnr else ". Up and left is better:"
    figure.text(0.015, top - 0.035, KEPT_SPACE + better, va="top", fontsize=11.5)
    if by_psnr and (never := not_always_frozen(lines)):
        said = textwrap.fill(f"Not always frozen: {', '.join(never)}.", 100)
        figure.text(0.015, top - 0.07, said, va="top", fontsize=11.5)
        top -= 0.035 * (said.count("\n") + 1)
    places = ((0.085, 0.895),) if by_psnr else ((0.075, 0.56), (0.70, 0.28))
    low = 0.455 if by_psnr else 0.43
    above = [figure.add_axes((x, low, wide, top - 0.11 - low)) for x, wide in places]
    above[0].set_ylabel("space kept, %")
    size = f"size, kB: numbers in bfloat16, grids {held}"
    draw_panel(above[0], replace(first, title="" if by_psnr else size), theme)
    points = [(one.x, one.y) for one in first.points]
    names = [one.name.replace("taught grid", "taught") for one in first.points]
    colours = [look_of(one, theme)["color"] for one in first.points]
    seeds = [seed for one in first.points for seed in one.seeds]
    name_points(above[0], points, names, colours, seeds)
    if by_psnr:
        above[0].set_xlabel("PSNR on unseen photographs, dB")
    for axes, by_time in zip(above[1:], others):
        draw_panel(axes, by_time, theme)
        seconds = [one.x for one in by_time.points]
        axes.set_xlim(0.9 * min(seconds), 1.06 * max(seconds))
    below = [figure.add_axes((0.075 + 0.24 * i, 0.065, 0.17, 0.2)) for i in range(4)]
    draw_curves(below[0], lines, theme, small=True)
    below[0].set_title("training, s", fontsize=11.5, loc="left")
    below[0].set_ylabel("PSNR, dB")
    for axes, panel in zip(below[1:], shown.costs):
        draw_panel(axes, panel, theme)


def draw_panel(axes: Any, panel: Panel, theme: Theme) -> None:
    """The points of a panel, their seeds, and the border of what they beat."""
    for one in panel.points:
        look = look_of(one, theme)
        if panel.less:
            for seed in one.seeds:
                axes.plot(*seed, alpha=0.45, markersize=6, **look)
        else:
            axes.plot(*zip(*one.seeds), color=look["color"])
    plain(axes, theme)
    _scale(axes, panel)
    axes.set_title(panel.title, fontsize=11.5, loc="left")
    if panel.less:
        axes.invert_yaxis()
    for one, rim in zip(panel.points, rims(axes, [(one.x, one.y) for one in panel.points])):
        size = {"markersize": rim + (18 if one.ours else 11), "markeredgecolor": theme.page}
        axes.plot(one.x, one.y, zorder=3, **(size | look_of(one, theme)))
    _draw_front(axes, panel, theme)


def rims(axes: Any, places: Sequence[tuple[float, float]]) -> list[float]:
    """Points by which a marker is larger, so that those on it, drawn later, leave a rim of it."""
    axes.get_xlim(), axes.get_ylim()  # else they are not yet scaled
    at = axes.transData.transform(np.reshape(places, (-1, 2))) * 72.0 / axes.figure.dpi
    far = np.linalg.norm(at[:, None] - at[None], axis=-1)
    return [RIM * float(count) for count in np.triu(far < HIDDEN, k=1).sum(axis=1)]


def look_of(one: Point, theme: Theme) -> dict[str, Any]:
    """Colour and marker of a point: a cross for grids, a small gate hollow, ours a star."""
    if one.line is None:
        return {"marker": "x", "color": theme.ink, "markeredgecolor": theme.ink}
    look = style(one.line, theme)
    if not one.small:
        return look
    if one.ours:
        return look | {"marker": "*"}
    hollow = {"markerfacecolor": theme.page, "markeredgewidth": 2.0}
    return look | hollow | {"markeredgecolor": look["color"], "linestyle": "none"}


def _scale(axes: Any, panel: Panel) -> None:
    """Scales the axes of a panel; those of costs are logarithmic over a wide range."""
    axes.margins(x=0.08, y=0.18)
    axes.locator_params(axis="y", nbins=4)
    positive = [one.x for one in panel.points if one.x > 0.0]
    if panel.more_x:
        log_axis(axes, "y", (1.0, 2.0, 5.0))
    elif positive and max(positive) > WIDE_RANGE * min(positive):
        log_axis(axes, "x", (1.0, 3.0))
        axes.set_xlim(0.6 * min(positive), 1.7 * max(positive))
    elif positive:
        axes.set_xlim(0.0, 1.15 * max(positive))
        axes.locator_params(axis="x", nbins=4)


def _draw_front(axes: Any, panel: Panel, theme: Theme) -> None:
    """The border of what is beaten, as far as the panel goes."""
    if not panel.points:
        return
    xs, ys = zip(*panel.front())
    worst, farthest = axes.get_ylim()[0], axes.get_xlim()[0 if panel.more_x else 1]
    look = {"color": theme.ink, "alpha": 0.3, "linewidth": 5, "zorder": 1}
    fixed = {"scalex": False, "scaley": False}
    axes.step([xs[0], *xs, farthest], [worst, *ys, ys[-1]], where="post", **look, **fixed)


def draw_curves(axes: Any, lines: Sequence[Line], theme: Theme, small: bool = False) -> None:
    """Mean PSNR of each line against seconds of training, its seeds as a band, and the best so far
    of all."""
    ends = []
    for i, line in enumerate(lines):
        look = style(i, theme)
        seconds, mean, low, high = line.curve()
        ends.append((seconds[-1], mean[-1]))
        dashes = "-" if line.learned else (0, (5, 2))
        width = 1.6 if small else 2.6
        axes.plot(seconds, mean, linestyle=dashes, linewidth=width, color=look["color"])
        axes.fill_between(seconds, low, high, color=look["color"], alpha=0.16, linewidth=0)
    times, best = best_so_far(lines)
    axes.plot(times, best, color=theme.ink, alpha=0.25, linewidth=5 if small else 9, zorder=1)
    plain(axes, theme)
    axes.set_xlim(0.0, 1.02 * max(run["train_seconds"] for line in lines for run in line.runs))
    axes.margins(y=0.05)
    for i, (end, rim) in enumerate(zip(ends, rims(axes, ends))):
        axes.plot(*end, markersize=rim + (6 if small else 9), **style(i, theme))


def name_ends(axes: Any, lines: Sequence[Line], theme: Theme, apart: float = CLOSE) -> None:
    """Names to the right of the panel, each as near to the end of its curve as there is room."""
    low, high = axes.get_ylim()
    ends = [tuple(float(values[-1]) for values in line.curve()[:2]) for line in lines]
    places = spread([(psnr - low) / (high - low) for _, psnr in ends], apart)
    for i, (line, end, place) in enumerate(zip(lines, ends, places)):
        colour = style(i, theme)["color"]
        arrow = {"arrowstyle": "-", "relpos": (0.0, 0.5), "shrinkA": 2.0, "shrinkB": 6.0}
        beside = {"xytext": (1.03, place), "textcoords": "axes fraction", "va": "center"}
        look = {"color": colour, "fontweight": "bold", "arrowprops": {**arrow, "color": colour}}
        name = axes.annotate(name_of_end(line), end, annotation_clip=False, **beside, **look)
        name.set_fontsize(name.get_fontsize() * min(1.0, LONGEST_NAME / len(name.get_text())))


def name_of_end(line: Line) -> str:
    """Name and PSNR at the end of a curve, and whether its grid is still in its warm-up."""
    return f"{line.name}  {line.psnr:.1f}" + (" (warm-up)" if line.warming_up else "")


def _draw_learning(axes: Any, lines: Sequence[Line], theme: Theme) -> None:
    """Bars at the foot of the panel: seconds spent on learning an occupancy."""
    bars = [(i, seconds) for i, line in enumerate(lines) if (seconds := line.median(LEARNING))]
    if not bars:
        return
    low, high = axes.get_ylim()
    share = min(BAR * (len(bars) + 2.2), MOST_BARS)
    bar = share / (len(bars) + 2.2)
    axes.set_ylim(low - share / (1.0 - share) * (high - low), high)
    foot = axes.get_xaxis_transform()
    heights = [bar * (len(bars) - row - 0.2) for row in range(len(bars))]
    colours = [style(i, theme)["color"] for i, _ in bars]
    axes.hlines(
        heights, 0.0, [time for _, time in bars], colours, transform=foot, linewidth=5 * bar / BAR
    )
    grids = any(not lines[i].learned for i, _ in bars)
    text = " of which learning the occupancy" + (", or updating the grid" if grids else "")
    axes.text(0.0, bar * (len(bars) + 0.6), text, transform=foot, fontsize=10)


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
    """Writes names beside points, each where it and the line to it cover least: not `others`
    either."""
    to_panel = axes.transData + axes.transAxes.inverted()
    of_points = to_panel.transform(np.reshape([*places, *others], (-1, 2)))
    taken, written = boxes_around(of_points, *POINT), np.zeros((0, 4))
    for point, name, colour in zip(of_points, names, colours):
        found = _places_beside(point, *size_of(axes, name))
        inside = [box for box in found if box[:2].min() >= 0.0 and box[2:].max() <= 1.0]
        inside = inside or [_pushed_inside(box) for box in found]
        boxes = [np.vstack([box, _line_to(box, point)]) for box in inside]
        best = min(boxes, key=lambda one: (covered(one[:1], written), covered(one, taken)))
        taken, written = np.vstack([taken, best]), np.vstack([written, best[:1]])
        end = _end_of(best[0], point)
        is_right = bool(end[0] == best[0][0])
        line = {"arrowstyle": "-", "color": colour, "relpos": (0.0 if is_right else 1.0, 0.5)}
        place = {"xycoords": "axes fraction", "xytext": end, "va": "center"}
        look = {"color": colour, "fontweight": "bold", "ha": "left" if is_right else "right"}
        axes.annotate(name, point, **place, **look, arrowprops=line if len(best) > 1 else None)


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
    """Boxes for the name of a point, the best first."""
    (x, y), half = point, MARGIN * height / 2.0
    return [
        np.array([left, middle - half, left + width, middle + half])
        for across, up in product(ACROSS, UP)
        for middle in dict.fromkeys((y + up, y - up))
        for left in (x + across, x - across - width)
    ]


def _pushed_inside(box: Any) -> Any:
    """A box [4] moved sideways into the panel, as far as it is not wider."""
    right = max(0.0, -box[0]) - max(0.0, box[2] - 1.0)
    return box + np.array([right, 0.0, right, 0.0])


def _end_of(box: Any, point: Any) -> Any:
    """[2] the end of a name that is nearer to its point."""
    left, right = np.abs(box[[0, 2]] - point[0])
    return np.array([box[0] if left < right else box[2], (box[1] + box[3]) / 2.0])


def _line_to(box: Any, point: Any) -> Boxes:
    """Boxes along the line to a name; none beside its point."""
    way = _end_of(box, point) - point
    if np.abs(way).max() <= FAR:
        return np.zeros((0, 4))
    return boxes_around(point + ALONG * way, 0.003, 0.006)


def spread(wanted: Sequence[float], apart: float) -> list[float]:
    """Places in [0, 1] as near to the wanted ones as they can be when kept a distance apart, or as
    far as there is room."""
    order = np.argsort(wanted, kind="stable")
    steps = min(apart, 1.0 / max(1, len(wanted) - 1)) * np.arange(len(wanted))
    lowest = np.maximum.accumulate(np.maximum(np.array(wanted)[order] - steps, 0.0))
    inside = np.minimum(lowest, 1.0 - steps[-1])
    places = np.empty(len(wanted))
    places[order] = np.minimum.accumulate(inside[::-1])[::-1] + steps
    return [float(place) for place in places]
