"""How an occupancy was learned: slices of o(x), and what each expert got, from look to look."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import torch

from leco_plugin.evaluation.charts import COLOURS
from leco_plugin.evaluation.inspection import cameras_of
from leco_plugin.evaluation.occupancy_picture import (
    HORIZONTAL,
    draw_slice,
    heights_seen_from_above,
    interesting_box,
    surface_points,
)
from leco_plugin.models.history import FILE_NAME, GateHistory
from leco_plugin.occupancy import Occupancy
from leco_plugin.progress_bar import bar
from leco_plugin.scenes.input_error import InputError

PIXELS = 300
"""Along the longer side of a slice."""
STILL = 4
"""Looks in a picture that does not move."""
FRAMES_PER_SECOND, HELD = 5, 10
"""Of a picture that moves; it rests on its last frame for so many."""
DPI = 80
OPAQUE = 1e4
"""Density, per half extent, beyond which nothing is told apart: opaque within a ten-thousandth."""


def draw_history(occupancy: Occupancy, folder: Path, path: Path) -> Path:
    """Draws how an occupancy was learned.

    Args:
        occupancy: as it became.
        folder: of the run, with its history.
        path: of the picture. A .gif moves; others show the first look, two between, and the last.
    Raises:
        InputError: the run has no history, or one of another gate.
        OSError, ValueError: the picture cannot be written there, or is of no known kind.
    """
    history = _read(occupancy, folder)
    film = _Film(occupancy, history)
    if path.suffix.lower() != ".gif":
        looks = torch.linspace(0, len(history) - 1, STILL).round().int().unique().tolist()
        film.still(looks).savefig(path, dpi=DPI)
        return path
    from matplotlib.animation import FuncAnimation, PillowWriter

    figure, show = film.moving()
    looks = [*range(len(history)), *[len(history) - 1] * HELD]
    animation = FuncAnimation(figure, show, looks, init_func=list)
    writer = PillowWriter(FRAMES_PER_SECOND)
    with bar("Drawing how it was learned") as progress:
        animation.save(path, writer, dpi=DPI, progress_callback=lambda i, n: progress((i + 1) / n))
    return path


def _read(occupancy: Occupancy, folder: Path) -> GateHistory:
    file = folder / FILE_NAME
    try:
        return GateHistory.load(file, occupancy.gate)
    except FileNotFoundError:
        raise InputError(
            f"there is no {file}: a run leaves one with "
            "--pipeline.model.schedule.steps-per-record 10"
        ) from None
    except ValueError as error:
        raise InputError(str(error)) from None


class _Film:
    """The panels of one look, and the lines up to it."""

    def __init__(self, occupancy: Occupancy, history: GateHistory) -> None:
        self.history = history
        self.occupancy = copy.deepcopy(occupancy)
        self.cameras = cameras_of(occupancy)
        self.box = interesting_box(occupancy, self.cameras)
        low, high = heights_seen_from_above(occupancy, self.box)
        points, _ = surface_points(occupancy, self.box, low)
        middle = points.median(dim=0).values if len(points) else (self.box.low + self.box.high) / 2
        self.places = ((2, low + HORIZONTAL[0] * (high - low)), (1, float(middle[1])))
        """The normal of each slice and its position along that."""
        self.shares = torch.stack(history.shares).numpy()
        self.densities = torch.stack(history.densities).clamp(max=OPAQUE).numpy()

    def still(self, looks: list[int]) -> Any:
        """A figure with a column for each of some looks, over the lines of all."""
        figure = _figure((4 * len(looks), 10))
        grid = figure.add_gridspec(3, 2 * len(looks), height_ratios=(1.0, 0.5, 0.8))
        for column, look in enumerate(looks):
            for row in range(2):
                axes = figure.add_subplot(grid[row, 2 * column : 2 * column + 2])
                self._slice(axes, row, look)
                if row == 0:
                    axes.set_title(f"step {self.history.steps[look]}: " + axes.get_title())
        half = len(looks)
        self._lines(figure.add_subplot(grid[2, :half]), figure.add_subplot(grid[2, half:]))
        return figure

    def moving(self) -> tuple[Any, Any]:
        """A figure, and what draws one look into it."""
        figure = _figure((12, 7))
        grid = figure.add_gridspec(2, 2, width_ratios=(1.2, 1.0))
        left = [figure.add_subplot(grid[row, 0]) for row in range(2)]
        right = [figure.add_subplot(grid[row, 1]) for row in range(2)]

        def show(look: int) -> list[Any]:
            for axes in (*left, *right):
                axes.clear()
            for row, axes in enumerate(left):
                self._slice(axes, row, look)
            self._lines(right[0], right[1], look)
            figure.suptitle(f"learning what is empty: step {self.history.steps[look]}")
            return []

        return figure, show

    def _slice(self, axes: Any, row: int, look: int) -> None:
        self.occupancy.gate.load_state_dict(self.history.weights[look])
        normal, at = self.places[row]
        draw_slice(axes, self.occupancy, self.box, normal, at, pixels=PIXELS)

    def _lines(self, above: Any, below: Any, look: int | None = None) -> None:
        """Shares of points and mean densities against steps, as far as one look, or all."""
        steps, upto = self.history.steps, None if look is None else look + 1
        for expert in range(self.shares.shape[1]):
            colour = COLOURS[expert % len(COLOURS)]
            style = {"color": colour, "linewidth": 2.6 if expert == 0 else 1.5}
            label = "empty space" if expert == 0 else f"scene expert {expert}"
            above.plot(steps[:upto], 100.0 * self.shares[:upto, expert], label=label, **style)
            below.plot(steps[:upto], self.densities[:upto, expert], **style)
        above.set_ylabel("share of points, %")
        above.set_ylim(0, 100)
        below.set_ylabel("mean density, per half extent\n(10⁴: opaque)")
        below.set_yscale("symlog", linthresh=1.0)
        below.set_ylim(0, 1.5 * max(1.0, float(self.densities.max())))
        for axes in (above, below):
            axes.set_xlim(min(steps), max(steps) or 1)
            axes.set_xlabel("step")
            axes.grid(alpha=0.3)
            axes.spines[["top", "right"]].set_visible(False)
        above.legend(fontsize=8, ncols=3, loc="upper center")


def _figure(size: tuple[float, float]) -> Any:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure
