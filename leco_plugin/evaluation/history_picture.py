"""Pictures of how an occupancy was learned, from the history in the folder of its run."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from leco_plugin.chart.theme import LIGHT, new_figure, plain, save_whole
from leco_plugin.evaluation.inspection import cameras_of
from leco_plugin.evaluation.metrics import spread_evenly
from leco_plugin.evaluation.occupancy_picture import (
    HORIZONTAL,
    draw_slice,
    heights_seen_from_above,
    interesting_box,
    kept_cells,
    middle_of,
    surface_points,
)
from leco_plugin.learning.history import FILE_NAME, GateHistory, as_learned
from leco_plugin.log import bar
from leco_plugin.occupancy import Occupancy
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.whole_files import write_whole

STILL, MOST_FRAMES = 4, 12
"""Looks in a still picture of a history, and in one that moves."""
FRAME_PIXELS = 300
"""Along the longer side of a slice."""
FRAME_COLOURS = 255
"""Of a picture that moves, the same in all its frames; GIF keeps one more for what stays."""
FRAME, LAST_FRAME = 250, 3000
"""Milliseconds for which a frame is shown."""
DPI = 80
OPAQUE = 1e4
"""Density, per half extent, that is drawn for more: opaque within a ten-thousandth."""


def draw_history(occupancy: Occupancy, history: GateHistory, path: Path) -> Path:
    """Draws how an occupancy was learned. A .gif moves; other pictures show the first look, two
    between, and the last. OSError or ValueError if it cannot be written there, or is of no known
    kind.
    """
    film = _Film(occupancy, history)
    count, frames = len(film.history), []
    if path.suffix.lower() != ".gif":
        return save_whole(film.still(spread_evenly(count, STILL)), path, dpi=DPI)
    shown = spread_evenly(count, MOST_FRAMES)
    with bar("Drawing how it was learned") as progress:
        for figure in film.moving(shown):
            figure.canvas.draw()
            frames.append(Image.fromarray(np.asarray(figure.canvas.buffer_rgba())[..., :3]))
            progress(len(frames) / len(shown))
    write_film(frames, path, [FRAME] * (len(frames) - 1) + [LAST_FRAME], FRAME_COLOURS)
    return path


def write_film(
    frames: Sequence[Image.Image], path: Path, durations: int | list[int], colours: int
) -> None:
    """Writes a GIF that repeats. All frames share one palette, so that a colour never changes.

    Args:
        frames: RGB pictures of one size.
        durations: in milliseconds, of all frames or of each.
        colours: in the palette. There is no dither, which GIF cannot compress.
    """
    width, height = frames[0].size
    strip = Image.new("RGB", (width, height * len(frames)))
    for number, frame in enumerate(frames):
        strip.paste(frame, (0, height * number))
    tree = Image.Quantize.FASTOCTREE  # the others mix the colours of thin lines with their paper
    palette = strip.quantize(colours, method=tree, dither=Image.Dither.NONE)
    few = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    options: dict[str, Any] = {"save_all": True, "append_images": few[1:], "loop": 0}
    write_whole(path, lambda file: few[0].save(file, "GIF", duration=durations, **options))


def read_history(occupancy: Occupancy, folder: Path) -> GateHistory:
    """The history in the folder of a run. ValueError for none, or one of another gate."""
    file = folder / FILE_NAME
    try:
        return GateHistory.load(file, as_learned(occupancy).gate)
    except FileNotFoundError:
        raise InputError(
            f"there is no {file}: a run of leco-occupancy leaves one with "
            "--pipeline.model.schedule.steps-per-record 10"
        ) from None


class _Film:
    """Draws looks at a history: two slices each, and lines of what each expert got."""

    def __init__(self, occupancy: Occupancy, history: GateHistory) -> None:
        self.history = history
        self.occupancy = copy.deepcopy(as_learned(occupancy))
        self.box = interesting_box(occupancy, cameras_of(occupancy))
        cells = kept_cells(occupancy, self.box)
        low, high = heights_seen_from_above(cells)
        middle = middle_of(surface_points(cells, low)[0], self.box)
        self.places = ((2, low + HORIZONTAL[0] * (high - low)), (1, float(middle[1])))
        """The axis that each slice is normal to, and its position along that, scene units."""
        self.shares = history.all("shares").numpy()
        self.densities = history.all("densities").clamp(max=OPAQUE).numpy()

    def still(self, looks: list[int]) -> Any:
        """A figure with a column for each of some looks, over the lines of all."""
        half = len(looks)
        figure = new_figure((4 * max(half, 2), 10), dpi=DPI, layout="constrained")
        grid = figure.add_gridspec(3, 2 * half, height_ratios=(1.0, 0.5, 0.8))
        for column, look in enumerate(looks):
            place = slice(2 * column, 2 * column + 2)
            above, below = (figure.add_subplot(grid[row, place]) for row in range(2))
            self._draw_slices(above, below, look)
            above.set_title(f"step {self.history.steps[look]}: " + above.get_title())
        self._draw_lines(figure.add_subplot(grid[2, :half]), figure.add_subplot(grid[2, half:]))
        return figure

    def moving(self, looks: list[int]) -> Iterator[Any]:
        """One figure, drawn anew for each of some looks."""
        figure = new_figure((9.6, 5.4), dpi=DPI, layout="constrained")
        columns = figure.add_gridspec(1, 2)
        slices = columns[0].subgridspec(2, 1, height_ratios=(3, 1))
        curves = columns[1].subgridspec(2, 1)
        left, right = ([figure.add_subplot(grid[i]) for i in range(2)] for grid in (slices, curves))
        for look in looks:
            for axes in (*left, *right):
                axes.clear()
            self._draw_slices(left[0], left[1], look)
            self._draw_lines(right[0], right[1], look)
            figure.suptitle(f"Learning what is empty: step {self.history.steps[look]}")
            yield figure

    def _draw_slices(self, above: Any, below: Any, look: int) -> None:
        self.occupancy.gate.load_state_dict(self.history.weights(look))
        for axes, (normal, at) in zip((above, below), self.places):
            draw_slice(axes, self.occupancy, self.box, normal, at, pixels=FRAME_PIXELS)

    def _draw_lines(self, above: Any, below: Any, look: int | None = None) -> None:
        """Shares of points and mean densities against steps, as far as one look, or all."""
        steps, upto = self.history.steps, None if look is None else look + 1
        for expert in range(self.shares.shape[1]):
            colour = LIGHT.colours[expert % len(LIGHT.colours)]
            style: dict[str, Any] = {"color": colour, "linewidth": 2.6 if expert == 0 else 1.5}
            style["marker"] = "o" if len(steps[:upto]) == 1 else None  # which is no line yet
            label = "empty space" if expert == 0 else f"scene expert {expert}"
            above.plot(steps[:upto], 100.0 * self.shares[:upto, expert], label=label, **style)
            below.plot(steps[:upto], self.densities[:upto, expert], **style)
        above.set(ylabel="share of points, %", ylim=(0, 140), yticks=range(0, 101, 20))
        below.set_yscale("symlog", linthresh=1.0)
        highest = 1.5 * max(1.0, float(self.densities.max()))
        below.set(ylabel="mean density, per half extent\n(10⁴: opaque)", ylim=(0, highest))
        for axes in (above, below):
            axes.set(xlim=(steps[0], max(steps[-1], steps[0] + 1)), xlabel="step")
            plain(axes, LIGHT)
        above.legend(fontsize=8, ncols=3, loc="upper center")
