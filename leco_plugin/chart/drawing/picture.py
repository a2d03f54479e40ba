"""`chart.png`: accuracy against seconds of training above, against what it costs below.

For somebody who has five seconds: the sentence over it says what came out, every curve has its name
at its end, and in every panel better is up and to the left.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from leco_plugin.chart.drawing.names import name_points
from leco_plugin.chart.drawing.panels import (
    draw_all_costs,
    draw_cost,
    draw_kept,
    draw_learned,
    look_of,
)
from leco_plugin.chart.drawing.theme import LIGHT, Theme, plain, style, themed
from leco_plugin.chart.drawing.title import asks_what_was_learned, title_of
from leco_plugin.chart.findings.learned import learned_of
from leco_plugin.chart.findings.representations import Representation, representations_of
from leco_plugin.chart.findings.summary import (
    COSTS,
    LEARNING,
    LOST_SURFACE_MASS,
    Line,
    best_so_far,
    circumstances,
    lines_of,
)
from leco_plugin.evaluation.charts import SOURCE, fingerprint

CLOSE = 0.056
"""Least distance of two names at the ends of curves, of the panel's height."""
BAR = 0.032
"""Height of a bar at the foot of the panel, of the panel's."""
TITLE_WIDTH = 66
CHARACTER = 0.0098
"""Width of a letter of the names, of the figure's."""
TOP, LINE = 0.985, 0.04
"""Of the figure: where the title begins, and the height of a line of it."""
HOW_TO_READ = "What it costs. Up and left is better; nothing is better in both than the grey line."
KEPT_SPACE = (
    f"Space that must be sampled where each loses {LOST_SURFACE_MASS:.1%} of the surface. "
    "Up and left is better:"
)
SIZE = "size, kB: numbers in bfloat16, cells of grids in bits"
LEARNED_SPACE = (
    f"Space that must be sampled where each loses {LOST_SURFACE_MASS:.1%} of the surface, against "
    "PSNR. Up and right is better:"
)
WHAT_ELSE = "PSNR on unseen photographs, dB, against what it costs. Up and left is better:"


def draw(results: Mapping[str, Any], path: Path, theme: Theme = LIGHT) -> Path:
    """Draws the results of a chart that has at least one run.

    Args:
        results: as in `results.json`.
        path: of the picture.
        theme: of the page it is meant for.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    lines = lines_of(results)
    held = representations_of(lines)
    of_gates = asks_what_was_learned(results)
    with themed(theme):
        figure = Figure(figsize=(10, 8.4), facecolor=theme.page)
        FigureCanvasAgg(figure)
        title = balanced(title_of(results))
        figure.text(0.015, TOP, title, va="top", fontsize=17, fontweight="bold")
        below_title = TOP - 0.01 - LINE * (title.count("\n") + 1)
        figure.text(0.015, below_title, circumstances(results), va="top", fontsize=11.5)
        height = below_title - 0.08 - 0.43
        if held or of_gates:
            below = [figure.add_axes((0.075 + 0.24 * i, 0.065, 0.17, 0.2)) for i in range(4)]
            shown = KEPT_SPACE if held else LEARNED_SPACE
            figure.text(0.015, 0.335, WHAT_ELSE, va="top", fontsize=11.5)
            figure.text(0.015, below_title - 0.035, shown, va="top", fontsize=11.5)
            places = ((0.075, 0.56), (0.70, 0.28)) if held else ((0.085, 0.895),)
            low = 0.43 if held else 0.455
            above = [figure.add_axes((x, low, wide, 0.4 + height - low)) for x, wide in places]
            if held:
                _draw_compared(above, held, lines, theme)
            else:
                draw_learned(above[0], learned_of(lines), lines, theme)
            _draw_runs(below, lines, theme)
        else:
            figure.text(0.015, 0.335, HOW_TO_READ, va="top", fontsize=11.5)
            widest = max(len(name_of_end(line)) for line in lines)
            right = 0.93 - CHARACTER * min(widest, 40)
            main = figure.add_axes((0.075, 0.43, right - 0.075, height))
            below = [figure.add_axes((0.075 + 0.325 * i, 0.065, 0.255, 0.2)) for i in range(3)]
            _draw_curves(main, lines, theme)
            _draw_learning(main, lines, theme)
            _name_ends(main, lines, theme)
            draw_all_costs(below, lines, theme)
        figure.savefig(path, dpi=160, metadata={SOURCE: fingerprint(results)})
    return path


def balanced(text: str, width: int = TITLE_WIDTH) -> str:
    """A text in as few lines as `width` letters allow, all about as long."""
    lines = len(textwrap.wrap(text, width))
    narrowest = next(n for n in range(1, width + 1) if len(textwrap.wrap(text, n)) <= lines)
    return textwrap.fill(text, narrowest)


def _draw_compared(
    beside: Sequence[Any], held: Sequence[Representation], lines: Sequence[Line], theme: Theme
) -> None:
    """What each occupancy keeps against its size and its learning time."""
    by_size, by_time = beside
    timed = [one for one in held if not one.is_grid]
    seconds = [one.median("learn_seconds") for one in timed]
    places = draw_kept(by_size, SIZE, "size", held, lines, theme)
    by_size.set_ylabel("space kept, %")
    colours = [look_of(one, held, lines, theme)["color"] for one in held]
    name_points(by_size, places, [one.name for one in held], colours)
    draw_kept(by_time, LEARNING.titled, "learn_seconds", timed, lines, theme)
    by_time.set_xlim(0.9 * min(seconds), 1.06 * max(seconds))


def _draw_runs(below: Sequence[Any], lines: Sequence[Line], theme: Theme) -> None:
    """PSNR against training time and each of `COSTS`, small."""
    below[0].set_ylabel("PSNR, dB")
    _draw_curves(below[0], lines, theme, small=True)
    for panel, cost in zip(below[1:], COSTS):
        draw_cost(panel, cost, lines, theme)


def _draw_curves(axes: Any, lines: Sequence[Line], theme: Theme, small: bool = False) -> None:
    longest = max(run["train_seconds"] for line in lines for run in line.runs)
    for i, line in enumerate(lines):
        look = style(i, theme)
        seconds, mean, low, high = line.curve()
        dashes = "-" if line.learned else (0, (5, 2))
        width, size = (1.6, 6) if small else (2.6, 9)
        axes.plot(seconds, mean, linestyle=dashes, linewidth=width, color=look["color"])
        axes.fill_between(seconds, low, high, color=look["color"], alpha=0.16, linewidth=0)
        axes.plot(seconds[-1], mean[-1], markersize=size, **look)
    times, best = best_so_far(lines)
    axes.plot(times, best, color=theme.ink, alpha=0.25, linewidth=5 if small else 9, zorder=1)
    plain(axes, theme)
    axes.set_xlim(0.0, 1.02 * longest)
    axes.margins(y=0.05)
    if small:
        axes.set_title("training, s", fontsize=11.5, loc="left")
    else:
        axes.set_title("PSNR on unseen photographs, dB: more is better", fontsize=11.5, loc="left")
        axes.set_xlabel("seconds of training")


def _name_ends(axes: Any, lines: Sequence[Line], theme: Theme) -> None:
    """Names to the right of the panel, each as near to the end of its curve as there is room."""
    ends = []
    for line in lines:
        times, mean, _, _ = line.curve()
        ends.append((float(times[-1]), float(mean[-1]), name_of_end(line)))
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
            color=style(i, theme)["color"],
            fontweight="bold",
            annotation_clip=False,
            arrowprops={
                "arrowstyle": "-",
                "color": style(i, theme)["color"],
                "relpos": (0.0, 0.5),
                "shrinkA": 2.0,
                "shrinkB": 6.0,
            },
        )


def name_of_end(line: Line) -> str:
    """What stands at the end of a curve: whose, its PSNR, and whether that is of a grid in its
    warm-up."""
    return f"{line.name}  {line.psnr:.1f}" + (" (warm-up)" if line.warming_up else "")


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
