"""`chart.html`: the same chart to look into. One file that asks no other machine for anything."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from leco_plugin.chart.drawing.panels import look_of
from leco_plugin.chart.drawing.theme import LIGHT
from leco_plugin.chart.drawing.title import asks_what_was_learned, title_of
from leco_plugin.chart.findings.fronts import COSTS as COSTS_OF_HELD
from leco_plugin.chart.findings.learned import Learned, learned_of
from leco_plugin.chart.findings.representations import Representation, representations_of
from leco_plugin.chart.findings.settling import falls
from leco_plugin.chart.findings.summary import (
    COSTS,
    LEARNING,
    Line,
    best_so_far,
    circumstances,
    front,
    lines_of,
)

SYMBOLS = ("circle", "square", "diamond", "triangle-up", "triangle-down", "cross", "x", "star")
SIZES = ("size of the occupancy, kB", "learning the occupancy, s", "")
KEPT_AGAINST_PSNR = ("space kept at equal loss, against PSNR, dB", "", "")
FRONT = {"color": "rgba(120,120,120,0.45)", "width": 5}


def write_page(results: Mapping[str, Any], path: Path) -> Path:
    """Writes the page of results that hold at least one run.

    A click on a name hides it everywhere, two clicks show it alone; a pointer shows figures.
    """
    lines = lines_of(results)
    held = representations_of(lines)
    title = html.escape(title_of(results))
    learned = learned_of(lines) if asks_what_was_learned(results) and not held else []
    figure = _figure(lines, SIZES if held else KEPT_AGAINST_PSNR if learned else ())
    if held:
        _add_representations(figure, held, lines)
    elif learned:
        _add_learned(figure, learned, lines)
    below = ". ".join(filter(None, [circumstances(results), falls(lines)]))
    figure.update_layout(
        title={"text": f"<b>{title}</b><br><sub>{html.escape(below)}</sub>"},
        template="plotly_white",
        height=1100 if held or learned else 820,
        legend={"orientation": "h", "y": -0.08},
        margin={"t": 110},
    )
    figure.write_html(path, include_plotlyjs=True, full_html=True)
    return path


def _figure(lines: Sequence[Line], last: Sequence[str] = ()) -> Any:
    """Curves on top, costs below; a third row is left for panels with the `last` titles."""
    import plotly.graph_objects as go
    from plotly.subplots import make_subplots

    rows = 3 if last else 2
    wide = [{"colspan": 3}, None, None]
    titles = ["", *(cost.titled for cost in COSTS), *last]
    figure = make_subplots(
        rows=rows,
        cols=3,
        specs=[wide, *([[{}, {}, {}]] * (rows - 1))],
        subplot_titles=titles,
        vertical_spacing=0.13,
    )
    for i, line in enumerate(lines):
        colour = LIGHT.colours[i % len(LIGHT.colours)]
        for run in line.runs:
            seconds, psnrs = zip(*run["curve"])
            figure.add_trace(
                go.Scatter(
                    x=seconds,
                    y=psnrs,
                    name=line.name,
                    legendgroup=line.name,
                    showlegend=run is line.runs[0],
                    mode="lines+markers",
                    line={"color": colour, "dash": "solid" if line.learned else "dash"},
                    hovertemplate=f"%{{x:.1f}} s, %{{y:.2f}} dB, seed {run['seed']}",
                ),
                row=1,
                col=1,
            )
        for column, cost in enumerate(COSTS, start=1):
            value = line.median(cost)
            if value is not None:
                figure.add_trace(_point(line, i, value), row=2, col=column)
    times, best = best_so_far(lines)
    figure.add_trace(_front(list(zip(times.tolist(), best.tolist())), "linear"), row=1, col=1)
    for column, cost in enumerate(COSTS, start=1):
        known = [(value, line.psnr) for line in lines if (value := line.median(cost)) is not None]
        figure.add_trace(_front([known[j] for j in front(known)]), row=2, col=column)
    figure.update_xaxes(title_text="seconds of training", row=1, col=1)
    figure.update_yaxes(title_text="PSNR on test images, dB", row=1, col=1)
    figure.update_yaxes(title_text="PSNR, dB", row=2, col=1)
    return figure


def _point(line: Line, i: int, value: float) -> Any:
    import plotly.graph_objects as go

    learning = line.median(LEARNING)
    spread = [max(line.psnrs) - line.psnr], [line.psnr - min(line.psnrs)]
    return go.Scatter(
        x=[value],
        y=[line.psnr],
        error_y={"array": spread[0], "arrayminus": spread[1], "symmetric": False},
        name=line.name,
        legendgroup=line.name,
        showlegend=False,
        mode="markers",
        marker=_marker(i, 13),
        hovertemplate="%{x:.3g}, %{y:.2f} dB"
        + (f", learned in {learning:.0f} s" if learning is not None else ""),
    )


def _marker(i: int, size: int) -> dict[str, Any]:
    """How the points of a line look."""
    colour = LIGHT.colours[i % len(LIGHT.colours)]
    return {"size": size, "symbol": SYMBOLS[i % len(SYMBOLS)], "color": colour}


def _front(points: Sequence[tuple[float, float]], shape: str = "hv") -> Any:
    import plotly.graph_objects as go

    costs, gains = zip(*points) if points else ((), ())
    return go.Scatter(
        x=costs,
        y=gains,
        mode="lines",
        line=FRONT | {"shape": shape},
        showlegend=False,
        hoverinfo="skip",
    )


def _add_representations(
    figure: Any, held: Sequence[Representation], lines: Sequence[Line]
) -> None:
    """What each occupancy keeps against its size and its learning time."""
    import plotly.graph_objects as go

    for column, cost in enumerate(COSTS_OF_HELD.values(), start=1):
        shown = [one for one in held if one.has(cost)]
        places = [(one.median(cost), one.kept) for one in shown]
        figure.add_trace(
            go.Scatter(
                x=[value for value, _ in places],
                y=[kept for _, kept in places],
                text=[one.name for one in shown],
                mode="markers+text",
                textposition="top center",
                marker={
                    "size": [16 if one.ours else 11 for one in shown],
                    "color": [look_of(one, held, lines, LIGHT)["color"] for one in shown],
                },
                showlegend=False,
                hovertemplate="%{text}: %{x:.3g}, %{y:.1f}%<extra></extra>",
            ),
            row=3,
            col=column,
        )
        best = [places[i] for i in front([(value, -kept) for value, kept in places])]
        figure.add_trace(_front(best), row=3, col=column)
        figure.update_yaxes(autorange="reversed", row=3, col=column)
    figure.update_xaxes(type="log", row=3, col=1)
    figure.update_yaxes(title_text="volume kept at equal loss, %", row=3, col=1)


def _add_learned(figure: Any, learned: Sequence[Learned], lines: Sequence[Line]) -> None:
    """Space that gates keep at equal loss against PSNR after equal steps."""
    import plotly.graph_objects as go

    numbers = {line.name: i for i, line in enumerate(lines)}
    for one in (one for one in learned if one.is_measured):
        i = numbers[one.name]
        figure.add_trace(
            go.Scatter(
                x=[one.psnr],
                y=[one.kept],
                name=one.name,
                legendgroup=one.name,
                showlegend=False,
                mode="markers",
                marker=_marker(i, 14),
                hovertemplate="%{x:.2f} dB, %{y:.1f}% of the space",
            ),
            row=3,
            col=1,
        )
    figure.update_yaxes(type="log", autorange="reversed", title_text="%", row=3, col=1)
