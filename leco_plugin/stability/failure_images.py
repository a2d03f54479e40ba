"""For each failure a picture: what is there, what the reference shows, what the sampler shows."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from leco_plugin.chart.runner import RUNS
from leco_plugin.scenes.city.layouts import TRANSFORMS
from leco_plugin.stability.plan import Entry
from leco_plugin.stability.table_folder import FAILURES

if TYPE_CHECKING:
    from leco_plugin.stability.suite import Suite

_WIDTH = 3.4
"""Of one picture, inches."""


def draw_failures(suite: Suite, results: Mapping[str, Any]) -> list[Path]:
    """Draws all cells that fail or are degraded and have pictures; those of earlier calls go."""
    folder = suite.out / FAILURES
    for old in folder.glob("*.png"):
        old.unlink()
    rows = {row["name"]: row["cells"] for row in results["cases"]}
    drawn = []
    for entry in suite.entries:
        cell = rows[entry.case.name][entry.sampler.name]
        if cell["verdict"] not in ("fail", "degraded") or entry.sampler.reference is None:
            continue
        worst = cell["worst_seed"]
        shown = view_of(suite, entry, worst)
        reference = view_of(suite, suite.reference_of(entry), worst)
        if shown is not None:
            path = folder / f"{entry.case.name}--{entry.sampler.name}.png"
            pictures = {"what is there": true_view(suite.data[entry.case.scene])}
            for name, view in (("dense", reference), (entry.sampler.title, shown)):
                if view is not None:
                    pictures[f"{name}, seed {view[1]}"] = view[0]
            title = f"{entry.case.title}: {cell['reason']}"
            drawn.append(side_by_side(pictures, title, path))
    return drawn


def view_of(suite: Suite, entry: Entry, seed: int | None) -> tuple[Path, int] | None:
    """A held-out picture as a run of a cell renders it, of this seed or of another, and which it
    is."""
    places = {
        run.job.seed: suite.folders[run.scene].path / RUNS / f"{run.job.name}.png"
        for run in entry.runs
    }
    there = {number: place for number, place in places.items() if place.exists()}
    found = seed if seed in there else next(iter(there), None)
    return None if found is None else (there[found], found)


def true_view(data: Path) -> Path:
    """The same picture of a scene as it is."""
    return data / str(json.loads((data / TRANSFORMS).read_text())["test_filenames"][0])


def side_by_side(pictures: Mapping[str, Path], title: str, path: Path) -> Path:
    """Pictures under their names in a row."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(_WIDTH * len(pictures), 0.75 * _WIDTH + 0.75), facecolor="white")
    FigureCanvasAgg(figure)
    figure.text(0.01, 0.985, title, va="top", fontsize=11, fontweight="bold")
    for number, (name, picture) in enumerate(pictures.items()):
        left = number / len(pictures)
        axes = figure.add_axes((left + 0.008, 0.02, 1 / len(pictures) - 0.016, 0.78))
        axes.imshow(on_white(picture), interpolation="nearest")
        axes.set_title(name, fontsize=10, loc="left", pad=4)
        axes.axis("off")
    figure.savefig(path, dpi=110)
    return path


def on_white(picture: Path) -> Any:
    """A picture [h, w, 3] in 0..1, white where it is transparent."""
    with Image.open(picture) as image:
        pixels = np.asarray(image.convert("RGBA"), dtype=float) / 255.0
    alpha = pixels[..., 3:]
    return pixels[..., :3] * alpha + 1.0 - alpha
