"""How pictures look on a light page and on a dark one, and pages that need no network."""

from __future__ import annotations

import base64
import gzip
import hashlib
import html
import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from leco_plugin.scenes.whole_files import write_whole

MARKERS = "osD^vPX*<>h"
"""One more than there are colours, so that the eleventh contender does not look as the first."""
SOURCE = "Source"
"""Entry of a picture that holds the fingerprint of its results."""


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
        *("#bf2a6b", "#3b7d8c", "#5c5f66", "#56771a", "#a0522d"),
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


def style(i: int, theme: Theme) -> dict[str, Any]:
    return {"color": theme.colours[i % len(theme.colours)], "marker": MARKERS[i % len(MARKERS)]}


def plain(axes: Any, theme: Theme) -> None:
    axes.grid(color=theme.faint, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def log_axis(axes: Any, name: str, digits: tuple[float, ...]) -> None:
    """Makes the axis `x` or `y` logarithmic, with plain numbers at `digits` times powers of 10."""
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    axes.set(**{f"{name}scale": "log"})
    axis = getattr(axes, f"{name}axis")
    axis.set_major_locator(LogLocator(subs=digits))
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_formatter(NullFormatter())


def themed(theme: Theme, size: float = 12) -> Any:
    """A context in which matplotlib draws with a theme's ink, in type of `size` points."""
    from matplotlib import rc_context

    parts = ("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color")
    settings: dict[Any, Any] = {"font.size": size, "axes.facecolor": theme.page}
    return rc_context(settings | dict.fromkeys(parts, theme.ink))


def new_figure(size: tuple[float, float], page: str = LIGHT.page, **options: Any) -> Any:
    """A figure of a size in inches that needs no display; `options` are those of `Figure`."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, facecolor=page, **options)
    FigureCanvasAgg(figure)
    return figure


def save_whole(figure: Any, path: Path, **options: Any) -> Path:
    """Writes a figure, whole or not at all, as the kind of picture that its name ends in; `options`
    are those of `savefig`."""
    kind = path.suffix[1:].lower() or None
    write_whole(path, lambda file: figure.savefig(file, format=kind, **options))
    return path


def save_picture(figure: Any, path: Path, results: Any, dpi: int) -> Path:
    """The same for a picture that says of which results it is."""
    return save_whole(figure, path, dpi=dpi, metadata={SOURCE: fingerprint(results)})


def fingerprint(values: Any) -> str:
    """A digest that tells JSON values from others."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


PAGE = """<!DOCTYPE html>
<html><head><meta charset="utf-8"><title>{title}</title>
<style>
body {{ margin: 0; overflow-x: hidden }}
#figure {{ width: 100%; min-height: 100vh }}
</style></head>
<body><div id="figure"></div>
<script type="text/plain" id="library">{library}</script>
<script type="text/plain" id="shown">{shown}</script>
<script>
async function unpack(id) {{
  const text = atob(document.getElementById(id).textContent);
  const bytes = Uint8Array.from(text, character => character.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).text();
}}
async function show() {{
  const library = document.createElement("script");
  library.textContent = await unpack("library");
  document.head.append(library);
  const figure = JSON.parse(await unpack("shown"));
  await Plotly.newPlot("figure", figure.data, figure.layout, {{responsive: true}});
}}
show().catch(error => document.body.prepend("This page needs a newer browser: " + error));
</script></body></html>
"""


def write_page_file(figure: Any, path: Path, title: str) -> Path:
    """Writes a figure of plotly as a page: 2 MB for the library, which take 5 MB as they are."""
    parts = {"library": _library(), "shown": _pack(figure.to_json())}
    page = PAGE.format(title=html.escape(title), **parts).encode()
    write_whole(path, page)
    return path


@cache
def _library() -> str:
    """The library of plotly, packed; once a process, as that takes half a second."""
    from plotly.offline import get_plotlyjs

    return _pack(get_plotlyjs())


def _pack(text: str) -> str:
    """A text as base64 of its gzip, which the page unpacks."""
    return base64.b64encode(gzip.compress(text.encode(), 9, mtime=0)).decode()
