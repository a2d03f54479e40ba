"""The pictures that show stored results, drawn where their results have changed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import checkout  # noqa: F401
from chart_sections import stored, titles
from growth_picture import cities
from growth_picture import draw as draw_growth
from learning import draw as draw_learning
from page_parts import RESULTS, ROOT
from PIL import Image, PngImagePlugin
from sizes_sections import CAPACITY, scene_results
from stability_page import PICTURE as STABILITY

from leco_plugin.capacity.choice import draw as draw_capacity
from leco_plugin.chart.picture import draw
from leco_plugin.chart.theme import DARK, LIGHT, SOURCE, fingerprint
from leco_plugin.stability.table import draw as draw_stability

CHARTS = ROOT / "docs" / "images" / "charts"
GROWTH, LEARNING = CHARTS / "growth.png", CHARTS / "learning.png"
COLOURS = 128
"""Of a picture in the repository."""


def pictures() -> dict[Path, Any]:
    """Every picture that is drawn from stored results, and those results."""
    found: dict[Path, Any] = {}
    for name in titles():
        results = stored(name)
        found |= {CHARTS / f"{name}.png": results, CHARTS / f"{name}-dark.png": results}
    for path in (LEARNING, STABILITY):
        if (file := RESULTS / f"{path.stem}.json").exists():
            report = json.loads(file.read_text())
            found |= {path: report, path.with_stem(f"{path.stem}-dark"): report}
    measured = scene_results("capacity")
    if len(grown := {one.name: measured[one.name] for one in cities(measured)}) > 1:
        found |= {GROWTH: grown, GROWTH.with_stem("growth-dark"): grown}
    for name, results in measured.items():
        path = CHARTS / f"{CAPACITY}{name}.png"
        found |= {path: results, path.with_stem(f"{path.stem}-dark"): results}
    return found


def draw_pictures(redraw: bool) -> None:
    """All of `pictures`, or those that are of other results."""
    CHARTS.mkdir(parents=True, exist_ok=True)
    for path, results in pictures().items():
        if not (redraw or is_stale(path, results)):
            continue
        theme = DARK if path.stem.endswith("-dark") else LIGHT
        name = path.stem.removesuffix("-dark")
        if name == GROWTH.stem:
            draw_growth(path, results, theme)
        elif name == LEARNING.stem:
            draw_learning(path, results, theme)
        elif name == STABILITY.stem:
            draw_stability(results, path, theme)
        elif name.startswith(CAPACITY):
            draw_capacity(results, path, theme)
        else:
            draw(results, path, theme)
        shrink(path)


def shrink(path: Path) -> None:
    """Leaves a picture the colours that a chart has: a third of the bytes, seen by nobody."""
    with Image.open(path) as image:
        kept = PngImagePlugin.PngInfo()
        kept.add_text(SOURCE, image.info[SOURCE])
        few = image.convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE)
    few.save(path, pnginfo=kept, optimize=True)


def is_stale(path: Path, results: Any) -> bool:
    """Whether a picture is missing, or of other results."""
    if not path.exists():
        return True
    with Image.open(path) as image:
        return image.info.get(SOURCE) != fingerprint(results)
