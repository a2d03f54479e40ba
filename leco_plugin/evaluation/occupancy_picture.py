"""Pictures of an occupancy: slices of o(x) and the kept points."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from leco_plugin.chart.theme import LIGHT, Theme, new_figure, save_whole, themed
from leco_plugin.evaluation import inspection
from leco_plugin.evaluation.inspection import SceneColours, ViewBox
from leco_plugin.occupancy import CALIBRATED_AT, Occupancy
from leco_plugin.scenes.bounds import FAR_CAMERA, distances_from_middle

Array = NDArray[Any]

SEARCH_CELLS = 64
"""Along the longest side, to find where anything is kept at all."""
CELLS = 128
"""Along the longest side, for the points in space."""
PIXELS = 640
"""Along the longer side of a slice."""
DPI = 160
"""Pixels an inch of a picture, so that its letters can be read at the width of a page."""
MOST_POINTS = 50_000
HORIZONTAL = (0.12, 0.4)
"""Heights of the horizontal slices, as shares of the way from the ground to the highest roofs:
those of a history, and of a picture where no two heights differ."""
LAYERS, LAYER_CELLS = 24, 96
"""Heights that are compared for the slices of a picture, and cells along the longest side."""
FLAT = 0.25
"""Shorter side of a slice, in longer ones, up to which it is drawn longer."""
TYPE = 10.0
"""Points."""
UNSEEN = "#8a8f98"
COLOURS, CONTOUR, TRUTH, CAMERA = "magma", "#4fd8eb", "#ffffff", "#66e08a"
AXES = "xyz"
SOLID = 0.75
"""o(x) from which a slice hides the photographs' colours under it."""


def draw(
    occupancy: Occupancy,
    path: str | Path,
    colours: SceneColours | None = None,
    theme: Theme = LIGHT,
) -> Path:
    """Draws two horizontal and two vertical slices of o(x), the horizontal ones over the scene's
    colours if they are known, and the kept points.

    Raises:
        OSError, ValueError: the picture cannot be written there, or is of no known kind.
    """
    with themed(theme, TYPE):
        return save_whole(_figure(occupancy, colours, theme), Path(path), dpi=DPI)


def _figure(occupancy: Occupancy, colours: SceneColours | None, theme: Theme) -> Any:
    cameras = inspection.cameras_of(occupancy)
    box = interesting_box(occupancy, cameras)
    cells = kept_cells(occupancy, box)
    low, high = heights_seen_from_above(cells)
    points, normals = surface_points(cells, low)
    ground = None if colours is None else seen_from_above(cells, colours)
    figure = new_figure((10.5, 6.4), theme.page, layout="constrained")
    wide, tall = (box.high - box.low)[[0, 2]].tolist()
    ratios = (1.0, min(1.0, max(0.5, 1.6 * tall / wide)))
    grid = figure.add_gridspec(2, 6, height_ratios=ratios, hspace=0.04)
    middle = middle_of(points, box)
    lower, upper = differing_heights(occupancy, box, low, high)
    for place, normal, at, under in (
        (grid[0, :2], 2, lower, ground),
        (grid[0, 2:4], 2, upper, ground),
        (grid[1, :3], 1, float(middle[1]), None),
        (grid[1, 3:], 0, float(middle[0]), None),
    ):
        axes = figure.add_subplot(place)
        shown = draw_slice(axes, occupancy, box, normal, at, cameras=cameras, under=under)
    _draw_points(figure.add_subplot(grid[0, 4:6], projection="3d"), points, normals, (low, high))
    colour_bar = figure.colorbar(shown, ax=figure.axes[2:4], shrink=0.9, pad=0.01, fraction=0.03)
    colour_bar.ax.axhline(occupancy.threshold, color=CONTOUR, linewidth=2)
    colour_bar.set_label("o(x)")
    figure.suptitle(headline(occupancy), fontsize=15, fontweight="bold", x=0.01, ha="left")
    lines = title_of(occupancy), _legend(occupancy, cameras, ground is not None)
    below = "\n".join(" · ".join(parts) for parts in lines)
    figure.supxlabel(below, fontsize=TYPE, x=0.01, ha="left")
    return figure


def draw_slice(
    axes: Any,
    occupancy: Occupancy,
    box: ViewBox,
    normal: int,
    at: float,
    cameras: Tensor | None = None,
    solid: Callable[[Tensor], Tensor] | None = None,
    pixels: int = PIXELS,
    under: Array | None = None,
) -> Any:
    """One slice of o(x) with the contour of the threshold; returns what a colour bar needs.

    Args:
        normal: 0, 1 or 2, the axis that the slice is perpendicular to.
        at: its position along that axis, scene units.
        cameras: [C, 3] centres to mark.
        solid: the truth, if known: positions [N, 3] to bool [N], as white lines edged in black.
        pixels: along the longer side.
        under: [H, W, 4] picture of the same place, shown where o(x) is small.
    """
    across, up = (a for a in range(3) if a != normal)
    sides = (box.high - box.low)[[across, up]]
    counts = (sides / sides.max() * pixels).round().clamp(min=64).int().tolist()
    u, v = box.axis(across, counts[0]), box.axis(up, counts[1])
    positions = torch.empty(len(v), len(u), 3)
    positions[..., normal], positions[..., across] = at, u
    positions[..., up] = v[:, None]
    values = inspection.query(occupancy, positions)
    low, high = box.low.tolist(), box.high.tolist()
    extent = (low[across], high[across], low[up], high[up])
    flat = float(sides[0] / sides[1])
    longer = max(1.0, FLAT * flat, FLAT / flat)
    aspect = longer if flat > 1.0 else 1.0 / longer
    style = {"cmap": COLOURS, "vmin": 0, "vmax": 1, "aspect": aspect}
    place = {"origin": "lower", "extent": extent}
    if under is not None:
        axes.imshow(under, **place, aspect=aspect)
        style["alpha"] = (values / SOLID).clamp(max=1.0).numpy()
    shown = axes.imshow(values.numpy(), **place, **style)
    unseen = ~inspection.seen_at(occupancy, positions).numpy()
    if unseen.any():
        marked = {"colors": "none", "hatches": ["//"], "levels": [0.5, 1.5]}
        axes.contourf(u, v, unseen.astype(float), **marked).set_edgecolor(UNSEEN)
    if values.min() < occupancy.threshold <= values.max():
        lines = [occupancy.threshold]
        axes.contour(u, v, values, levels=lines, colors=CONTOUR, linewidths=0.7)
    if solid is not None:
        inside = solid(positions.reshape(-1, 3)).cpu().reshape(values.shape)
        for colour, width in (("black", 1.8), (TRUTH, 0.8)):  # seen on light and on dark
            if bool(inside.any()) and not bool(inside.all()):
                axes.contour(u, v, inside.float(), levels=[0.5], colors=colour, linewidths=width)
    if cameras is not None and len(cameras):
        x, y = cameras[:, across], cameras[:, up]
        axes.scatter(x, y, s=9, c=CAMERA, edgecolors="black", linewidths=0.3, label="cameras")
        axes.set(xlim=extent[:2], ylim=extent[2:])
    _name_slice(axes, normal, at, longer, FLAT / flat >= 1.0)
    return shown


def _name_slice(axes: Any, normal: int, at: float, longer: float, is_narrow: bool) -> None:
    """Names a slice and its axes; `longer` is how many times as long one of them is drawn."""
    across, up = (AXES[a] for a in range(3) if a != normal)
    title = f"o(x) at {AXES[normal]} = {at:.4g}"
    if longer > 1.0:
        between = "\n" if normal == 2 or is_narrow else ", "  # the upper slices are narrower
        title += f"{between}{across if is_narrow else up} drawn {longer:.1f} times as long"
    axes.set_title(title, fontsize=11, loc="right" if is_narrow else "center")
    if is_narrow:
        axes.locator_params(axis="x", nbins=1, min_n_ticks=1)
    axes.set(xlabel=across, ylabel=up)
    axes.tick_params(labelsize=9)


def middle_of(points: Tensor, box: ViewBox) -> Tensor:
    """The median [3] of points [P, 3]; the middle of the box where there are none."""
    return points.median(dim=0).values if len(points) else (box.low + box.high) / 2


def interesting_box(occupancy: Occupancy, cameras: Tensor) -> ViewBox:
    """The box around what is kept and the cameras, but for those far from all others, inside the
    occupancy's whole box."""
    whole = inspection.whole_box(occupancy)
    cells = kept_cells(occupancy, whole, SEARCH_CELLS)
    inside = ((cameras >= whole.low) & (cameras <= whole.high)).all(dim=-1)
    if len(cameras):
        inside &= distances_from_middle(cameras) <= FAR_CAMERA
    found = torch.cat([cells.positions[cells.kept], cameras[inside]])
    if len(found) == 0:
        return whole
    low, high = found.amin(dim=0), found.amax(dim=0)
    margin = 0.04 * float((high - low).max()) + (whole.high - whole.low) / SEARCH_CELLS
    return ViewBox(torch.maximum(low - margin, whole.low), torch.minimum(high + margin, whole.high))


class KeptCells(NamedTuple):
    """Nearly cubic cells of a box, of one `size`, in scene units: their middles [X, Y, Z, 3], o(x)
    there [X, Y, Z], and whether they are kept, bool [X, Y, Z]."""

    box: ViewBox
    size: float
    positions: Tensor
    values: Tensor
    kept: Tensor


def kept_cells(occupancy: Occupancy, box: ViewBox, longest: int = CELLS) -> KeptCells:
    """The cells of a box, `longest` along its longest side."""
    positions = box.middles(longest)
    values = inspection.query(occupancy, positions)
    size = float((box.high - box.low).max()) / longest
    return KeptCells(box, size, positions, values, values >= occupancy.threshold)


def heights_seen_from_above(cells: KeptCells) -> tuple[float, float]:
    """Heights, scene units, between which lies nearly all that a view straight down shows, without
    what is kept below the ground."""
    bottom, top = float(cells.box.low[2]), float(cells.box.high[2])
    levels = cells.positions[..., 2]
    heights = torch.where(cells.kept, levels, -torch.inf).amax(dim=-1)
    heights = heights[heights.isfinite()].sort().values
    if len(heights) == 0 or heights[len(heights) // 20] == levels.max():
        return bottom, top  # nothing, or the lid of what is all kept
    low, high = float(heights[len(heights) // 20]), float(heights[-1 - len(heights) // 200])
    around = 2.0 * (top - bottom) / levels.shape[2] if low == high else 0.0
    return low - around, high + around


def differing_heights(
    occupancy: Occupancy, box: ViewBox, low: float, high: float
) -> tuple[float, float]:
    """Two heights between `low` and `high`, scene units, in whose layers most decisions differ;
    those of `HORIZONTAL` where no two layers differ that both keep and skip."""
    heights = torch.linspace(low, high, LAYERS)
    x, y = (box.axis(a, count) for a, count in enumerate(box.cells(LAYER_CELLS)[:2]))
    positions = torch.stack(torch.meshgrid(heights, x, y, indexing="ij"), dim=-1)[..., [1, 2, 0]]
    kept = (inspection.query(occupancy, positions) >= occupancy.threshold).flatten(1).float()
    shares = kept.mean(dim=1)
    mixed = ((shares > 0.005) & (shares < 0.995)).nonzero()[:, 0]
    layers = kept[mixed]
    both = layers @ layers.T
    differing = both.diagonal()[:, None] + both.diagonal() - 2.0 * both
    if not bool(differing.any()):
        lower, upper = (low + share * (high - low) for share in HORIZONTAL)
        return lower, upper
    pair = divmod(int(differing.argmax()), len(mixed))
    lower, upper = sorted(float(heights[mixed[number]]) for number in pair)
    return lower, upper


def seen_from_above(cells: KeptCells, colours: SceneColours) -> Array:
    """Colours of the highest kept place above each place: [Y, X, 4] uint8, clear where none is."""
    kept = cells.kept
    layers = torch.arange(kept.shape[2]).expand_as(kept).where(kept, -1).amax(dim=2)
    x, y = (layers >= 0).nonzero(as_tuple=True)
    seen = np.zeros((*kept.shape[:2], 4), np.uint8)
    if len(x):
        found = colours.at(cells.positions[x, y, layers[x, y]])
        seen[x.numpy(), y.numpy()] = np.pad(found, ((0, 0), (0, 1)), constant_values=255)
    return seen.transpose(1, 0, 2)


def surface_points(cells: KeptCells, lowest: float) -> tuple[Tensor, Tensor]:
    """Kept positions next to skipped ones, and the directions [P, 3] in which o(x) falls there."""
    is_above = cells.positions[..., 2] > lowest - 2.0 * cells.size
    chosen = (inspection.exposed(cells.kept, beyond=True) & is_above).nonzero()
    order = torch.randperm(len(chosen), generator=torch.Generator().manual_seed(0))
    at = tuple(chosen[order[:MOST_POINTS]].T)
    falls = -torch.stack(torch.gradient(cells.values), dim=-1)
    return cells.positions[at], torch.nn.functional.normalize(falls[at], dim=-1)


def _draw_points(axes: Any, points: Tensor, normals: Tensor, heights: tuple[float, float]) -> None:
    """The kept points, coloured by height and lit from above, so that shapes can be read."""
    from matplotlib import colormaps

    axes.set_axis_off()
    if len(points) == 0:
        axes.set_title("no surface: all of this is kept, or nothing", fontsize=11)
        return
    axes.set_title("surface of what is kept, coloured by height", fontsize=11)
    low, high = heights
    shares = ((points[:, 2] - low) / max(high - low, 1e-9)).clamp(0, 1)
    light = torch.nn.functional.normalize(torch.tensor([0.35, -0.55, 0.75]), dim=0)
    shade = 0.55 + 0.45 * (normals @ light).clamp(min=0)
    colours = torch.from_numpy(colormaps["viridis"](shares.numpy())[:, :3]) * shade[:, None]
    axes.scatter(*points.T.numpy(), c=colours.numpy(), s=3.0, linewidths=0, depthshade=False)
    sides = points.amax(dim=0) - points.amin(dim=0)
    axes.set_box_aspect(sides.clamp(min=1e-6).tolist(), zoom=1.4)
    axes.view_init(elev=38, azim=-58)


def headline(occupancy: Occupancy) -> str:
    """The title of a picture, in ten words at most."""
    skipped = occupancy.report.get("empty_fraction")
    if isinstance(skipped, float):
        return f"This occupancy skips {skipped:.1%} of all candidates"
    return f"An occupancy of {occupancy.num_params:,} parameters"


def title_of(occupancy: Occupancy) -> list[str]:
    """What one should know beside a picture."""
    parts = [f"occupancy with {occupancy.num_params} parameters"]
    parts.append(f"kept where o(x) ≥ {occupancy.threshold:.3g}")
    skipped = occupancy.report.get("empty_fraction")
    if isinstance(skipped, float):
        before = occupancy.report.get(CALIBRATED_AT)
        then = f" at {before:.3g}, before a host lowered it" if isinstance(before, float) else ""
        parts.append(f"{skipped:.1%} of all candidates skipped{then}")
    return parts


def _legend(occupancy: Occupancy, cameras: Tensor, ground: bool) -> list[str]:
    parts = ["threshold blue" + (", cameras green" if len(cameras) else "")]
    parts += ["under o(x): the photographs' colours seen from above"] if ground else []
    parts += [] if occupancy.seen.everywhere else ["hatched: no photograph shows it"]
    return parts
