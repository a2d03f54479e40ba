"""`chart.html`: the same chart to look into. One file that needs no network."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from leco_plugin.chart.learned import falls
from leco_plugin.chart.panels import Panel, finding_of, shown_of
from leco_plugin.chart.summary import Line, best_so_far, circumstances
from leco_plugin.chart.theme import LIGHT, style, write_page_file

SYMBOLS = ("circle", "square", "diamond", "triangle-up", "triangle-down", "cross", "x", "star")
FRONT = {"color": "rgba(120,120,120,0.45)", "width": 5}


def write_page(results: Mapping[str, Any], path: Path) -> Path:
    """Writes the page of results with at least one run. A click on a name hides it everywhere, two
    clicks show it alone; a pointer shows figures."""
    from plotly.subplots import make_subplots

    shown = shown_of(results)
    panels = shown.costs + shown.space
    rows = 1 + (len(panels) + 2) // 3
    figure = make_subplots(
        rows=rows,
        cols=3,
        specs=[[{"colspan": 3}, None, None], *([[{}, {}, {}]] * (rows - 1))],
        subplot_titles=["", *(panel.title for panel in panels)],
        vertical_spacing=0.13,
    )
    _add_curves(figure, shown.lines)
    for number, panel in enumerate(panels):
        _add_panel(figure, panel, 2 + number // 3, 1 + number % 3)
    figure.update_xaxes(title_text="seconds of training", row=1, col=1)
    figure.update_yaxes(title_text="PSNR on test images, dB", row=1, col=1)
    figure.update_yaxes(title_text="PSNR, dB", row=2, col=1)
    if shown.space:
        is_by_size = not shown.space[0].more_x
        figure.update_xaxes(type="log" if is_by_size else "linear", row=3, col=1)
        figure.update_yaxes(title_text="volume kept at equal loss, %", row=3, col=1)
    title = finding_of(results, short=True)
    lines = filter(None, [finding_of(results), circumstances(results), falls(shown.lines)])
    below = "<br>".join(html.escape(line) for line in lines)  # one line would be cut off
    figure.update_layout(
        title={"text": f"<b>{html.escape(title)}</b><br><sub>{below}</sub>"},
        template="plotly_white",
        height=1100 if shown.space else 820,
        legend={"orientation": "h", "y": -0.08},
        margin={"t": 130},
    )
    return write_page_file(figure, path, title)


def _add_curves(figure: Any, lines: Sequence[Line]) -> None:
    for i, line in enumerate(lines):
        for run in line.runs:
            seconds, psnrs = zip(*run["curve"])
            dash = "solid" if line.learned else "dash"
            figure.add_scatter(
                x=seconds,
                y=psnrs,
                name=line.name,
                legendgroup=line.name,
                showlegend=run is line.runs[0],
                mode="lines+markers",
                line={"color": style(i, LIGHT)["color"], "dash": dash},
                hovertemplate=f"%{{x:.1f}} s, %{{y:.2f}} dB, seed {run['seed']}",
                row=1,
                col=1,
            )
    times, best = best_so_far(lines)
    _add_front(figure, list(zip(times.tolist(), best.tolist())), "linear", 1, 1)


def _add_panel(figure: Any, panel: Panel, row: int, column: int) -> None:
    """The points of a panel and its front; less of y is up where less is better."""
    named = panel.less and not panel.more_x
    for one in panel.points:
        look = {"color": LIGHT.ink, "symbol": "x"}
        if one.line is not None:
            symbol = SYMBOLS[one.line % len(SYMBOLS)] + ("-open" if one.small else "")
            look = {"color": style(one.line, LIGHT)["color"], "symbol": symbol}
        psnrs = [psnr for _, psnr in one.seeds] or [one.y]
        spread = {"array": [max(psnrs) - one.y], "arrayminus": [one.y - min(psnrs)]}
        figure.add_scatter(
            x=[one.x],
            y=[one.y],
            text=[one.name],
            error_y=None if panel.less else {**spread, "symmetric": False},
            name=one.name,
            legendgroup=one.name,
            showlegend=False,
            mode="markers+text" if named else "markers",
            textposition="top center",
            marker={"size": 16 if one.ours else 12, **look},
            hovertemplate="%{text}: %{x:.3g}, %{y:.2f}<extra></extra>",
            row=row,
            col=column,
        )
    _add_front(figure, panel.front(), "hv", row, column)
    if panel.less:
        scale = "log" if panel.more_x else "linear"
        figure.update_yaxes(type=scale, autorange="reversed", row=row, col=column)


def _add_front(
    figure: Any, points: Sequence[tuple[float, float]], shape: str, row: int, column: int
) -> None:
    xs, ys = zip(*points) if points else ((), ())
    options = {"mode": "lines", "showlegend": False, "hoverinfo": "skip", "row": row, "col": column}
    figure.add_scatter(x=xs, y=ys, line=FRONT | {"shape": shape}, **options)
