"""A picture of an occupancy: slices of o(x) with the cameras, and the kept points in space."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from leco_plugin.evaluation.inspection import ViewBox, cameras_of, exposed, query, whole_box
from leco_plugin.occupancy import CALIBRATED_AT, Occupancy

SEARCH_CELLS = 64
"""Along the longest side, to find where anything is kept at all."""
CELLS = 128
"""Along the longest side, for the points in space."""
PIXELS = 640
"""Along the longer side of a slice."""
MOST_POINTS = 50_000
HORIZONTAL = (0.12, 0.4)
"""Heights of the horizontal slices, as shares of the way from the ground to the highest roofs."""

COLOURS = "magma"
CONTOUR = "#4fd8eb"
TRUTH = "#ffffff"
CAMERA = "#66e08a"
AXES = "xyz"


def draw(occupancy: Occupancy, path: str | Path, cameras: Tensor | None = None) -> Path:
    """Draws two horizontal and two vertical slices of o(x), and the kept points.

    Args:
        occupancy: on any device.
        path: of the picture; the ending chooses its kind.
        cameras: [C, 3] camera centres, scene units; those of the report by default.
    Raises:
        OSError, ValueError: the picture cannot be written there, or is of no known kind.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    cameras = cameras_of(occupancy) if cameras is None else cameras.detach().cpu().float()
    box = interesting_box(occupancy, cameras)
    low, high = heights_seen_from_above(occupancy, box)
    points, normals = surface_points(occupancy, box, low)
    figure = Figure(figsize=(15, 9.4), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    wide, tall = (box.high - box.low)[[0, 2]].tolist()
    grid = figure.add_gridspec(
        2, 6, height_ratios=(1.0, min(1.0, max(0.4, 1.6 * tall / wide))), hspace=0.04
    )
    shown = None
    for i, share in enumerate(HORIZONTAL):
        axes = figure.add_subplot(grid[0, 2 * i : 2 * i + 2])
        at = low + share * (high - low)
        shown = draw_slice(axes, occupancy, box, 2, at, cameras=cameras)
    middle = points.median(dim=0).values if len(points) else (box.low + box.high) / 2
    for i, normal in enumerate((1, 0)):
        axes = figure.add_subplot(grid[1, 3 * i : 3 * i + 3])
        draw_slice(axes, occupancy, box, normal, float(middle[normal]), cameras=cameras)
    _draw_points(figure.add_subplot(grid[0, 4:6], projection="3d"), points, normals, (low, high))
    assert shown is not None
    bar = figure.colorbar(shown, ax=figure.axes[2:4], shrink=0.9, pad=0.01, fraction=0.03)
    bar.ax.axhline(occupancy.threshold, color=CONTOUR, linewidth=2)
    bar.set_label("o(x)")
    figure.suptitle(_title(occupancy, cameras), fontsize=13)
    figure.savefig(path, dpi=110)
    return Path(path)


def draw_slice(
    axes: Any,
    occupancy: Occupancy,
    box: ViewBox,
    normal: int,
    at: float,
    cameras: Tensor | None = None,
    solid: Callable[[Tensor], Tensor] | None = None,
    pixels: int = PIXELS,
) -> Any:
    """One slice of o(x) with the contour of the threshold; returns what a colour bar needs.

    Args:
        axes: of matplotlib.
        normal: 0, 1 or 2, the axis that the slice is perpendicular to.
        at: its position along that axis, scene units.
        cameras: [C, 3] centres to mark.
        solid: the truth, if known: positions [N, 3] to bool [N], as white lines edged in black.
        pixels: along the longer side.
    """
    across, up = (a for a in range(3) if a != normal)
    sides = (box.high - box.low)[[across, up]]
    counts = (sides / sides.max() * pixels).round().clamp(min=2).int().tolist()
    u, v = box.axis(across, counts[0]), box.axis(up, counts[1])
    positions = torch.empty(len(v), len(u), 3)
    positions[..., normal], positions[..., across] = at, u
    positions[..., up] = v[:, None]
    values = query(occupancy, positions)
    low, high = box.low.tolist(), box.high.tolist()
    extent = (low[across], high[across], low[up], high[up])
    shown = axes.imshow(
        values.numpy(), origin="lower", extent=extent, cmap=COLOURS, vmin=0, vmax=1, aspect="equal"
    )
    if values.min() < occupancy.threshold <= values.max():
        lines = [occupancy.threshold]
        axes.contour(u, v, values, levels=lines, colors=CONTOUR, linewidths=0.7)
    if solid is not None:
        inside = solid(positions.reshape(-1, 3)).cpu().reshape(values.shape).float()
        if inside.min() < inside.max():
            for colour, width in (("black", 1.8), (TRUTH, 0.8)):  # seen on light and on dark
                axes.contour(u, v, inside, levels=[0.5], colors=colour, linewidths=width)
    if cameras is not None and len(cameras):
        x, y = cameras[:, across], cameras[:, up]
        axes.scatter(x, y, s=9, c=CAMERA, edgecolors="black", linewidths=0.3, label="cameras")
        axes.set_xlim(extent[:2])
        axes.set_ylim(extent[2:])
    axes.set_title(f"o(x) at {AXES[normal]} = {at:.3g}", fontsize=10)
    axes.set_xlabel(AXES[across])
    axes.set_ylabel(AXES[up])
    axes.tick_params(labelsize=8)
    return shown


def interesting_box(occupancy: Occupancy, cameras: Tensor) -> ViewBox:
    """The box around what is kept and the cameras, inside the occupancy's whole box."""
    whole = whole_box(occupancy)
    _, positions, kept = _kept_cells(occupancy, whole, SEARCH_CELLS)
    inside = ((cameras >= whole.low) & (cameras <= whole.high)).all(dim=-1)
    found = torch.cat([positions[kept], cameras[inside]])
    if len(found) == 0:
        return whole
    low, high = found.amin(dim=0), found.amax(dim=0)
    margin = 0.04 * float((high - low).max()) + (whole.high - whole.low) / SEARCH_CELLS
    return ViewBox(torch.maximum(low - margin, whole.low), torch.minimum(high + margin, whole.high))


def heights_seen_from_above(occupancy: Occupancy, box: ViewBox) -> tuple[float, float]:
    """Heights between which nearly all of what a look straight down meets lies, scene units.

    What is kept below the ground, where no camera sees, would otherwise be taken for the scene.
    """
    _, positions, kept = _kept_cells(occupancy, box, CELLS)
    heights = torch.where(kept, positions[..., 2], -torch.inf).amax(dim=-1)
    heights = heights[heights.isfinite()].sort().values
    if len(heights) == 0 or heights[len(heights) // 20] == positions[..., 2].max():
        return float(box.low[2]), float(box.high[2])  # nothing, or the lid of what is all kept
    low, high = float(heights[len(heights) // 20]), float(heights[-1 - len(heights) // 200])
    around = 2.0 * float(box.high[2] - box.low[2]) / kept.shape[2] if low == high else 0.0
    return low - around, high + around


def surface_points(occupancy: Occupancy, box: ViewBox, lowest: float) -> tuple[Tensor, Tensor]:
    """Kept positions next to skipped ones, and the directions [P, 3] in which o(x) falls there."""
    values, positions, kept = _kept_cells(occupancy, box, CELLS)
    margin = 2.0 * float((box.high - box.low).max()) / CELLS
    chosen = (exposed(kept, beyond=True) & (positions[..., 2] > lowest - margin)).nonzero()
    order = torch.randperm(len(chosen), generator=torch.Generator().manual_seed(0))
    chosen = chosen[order[:MOST_POINTS]]
    falls = -torch.stack(torch.gradient(values), dim=-1)
    at = tuple(chosen.T)
    return positions[at], torch.nn.functional.normalize(falls[at], dim=-1)


def _kept_cells(occupancy: Occupancy, box: ViewBox, longest: int) -> tuple[Tensor, Tensor, Tensor]:
    """o(x) at the middles of cells [X, Y, Z], those positions [X, Y, Z, 3], and which are kept."""
    axes = [box.axis(number, count) for number, count in enumerate(box.cells(longest))]
    positions = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)
    values = query(occupancy, positions)
    return values, positions, values >= occupancy.threshold


def _draw_points(axes: Any, points: Tensor, normals: Tensor, heights: tuple[float, float]) -> None:
    """The kept points, coloured by height and lit from above, so that shapes can be read."""
    from matplotlib import colormaps

    axes.set_axis_off()
    if len(points) == 0:
        axes.set_title("no surface: all of this is kept, or nothing", fontsize=10)
        return
    axes.set_title(f"{len(points)} kept points, coloured by height", fontsize=10)
    low, high = heights
    shares = ((points[:, 2] - low) / max(high - low, 1e-9)).clamp(0, 1)
    light = torch.nn.functional.normalize(torch.tensor([0.35, -0.55, 0.75]), dim=0)
    shade = 0.55 + 0.45 * (normals @ light).clamp(min=0)
    colours = torch.from_numpy(colormaps["viridis"](shares.numpy())[:, :3]) * shade[:, None]
    x, y, z = points.T.numpy()
    axes.scatter(x, y, z, c=colours.numpy(), s=3.0, linewidths=0, depthshade=False)
    axes.set_box_aspect(
        (points.amax(dim=0) - points.amin(dim=0)).clamp(min=1e-6).tolist(), zoom=1.4
    )
    axes.view_init(elev=38, azim=-58)


def _title(occupancy: Occupancy, cameras: Tensor) -> str:
    """What one should know beside the picture."""
    parts = [f"occupancy with {occupancy.num_params} parameters"]
    parts.append(f"kept where o(x) ≥ {occupancy.threshold:.3g}")
    skipped = occupancy.report.get("empty_fraction")
    if isinstance(skipped, float):
        before = occupancy.report.get(CALIBRATED_AT)
        then = f" at {before:.3g}, before a host lowered it" if isinstance(before, float) else ""
        parts.append(f"{skipped:.1%} of all candidates skipped{then}")
    parts.append("threshold blue" + (", cameras green" if len(cameras) else ""))
    return " · ".join(parts)
