"""A plotly figure as one file that needs no network; the library in it is compressed."""

from __future__ import annotations

import base64
import gzip
import html
from pathlib import Path
from typing import Any

from leco_plugin.scenes.whole_files import write_whole

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
    from plotly.offline import get_plotlyjs

    parts = {"library": get_plotlyjs(), "shown": figure.to_json()}
    packed = {name: _packed(text) for name, text in parts.items()}
    page = PAGE.format(title=html.escape(title), **packed).encode()
    write_whole(path, lambda file: file.write(page))
    return path


def _packed(text: str) -> str:
    return base64.b64encode(gzip.compress(text.encode(), 9, mtime=0)).decode()
