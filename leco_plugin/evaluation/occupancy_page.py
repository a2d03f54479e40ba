"""The interactive page of `leco inspect`: the kept volume, the cameras and what they see."""

from __future__ import annotations

from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from leco_plugin.chart.theme import LIGHT, write_page_file
from leco_plugin.evaluation import inspection
from leco_plugin.evaluation.inspection import SceneColours, ViewBox
from leco_plugin.evaluation.occupancy_picture import (
    KeptCells,
    heights_seen_from_above,
    interesting_box,
    kept_cells,
    title_of,
)
from leco_plugin.occupancy import Occupancy

COARSER = (96, 72, 48, 32)
"""Cells along the longest side of the kept volume, where finer ones have too many faces."""
MOST_FACES = 60_000
SEEN_CELLS = 32
COLOURS = 256
"""Of a palette: a colour by its number takes a byte for each face."""
CORNERS = torch.tensor([[0, 0], [1, 0], [1, 1], [0, 1]])
EYE = {"eye": {"x": 0.9, "y": -1.2, "z": 1.0}, "center": {"x": 0.0, "y": 0.0, "z": -0.1}}
LIGHTING = {"ambient": 0.85, "diffuse": 0.4, "specular": 0.02, "fresnel": 0.0}


def write_page(occupancy: Occupancy, path: Path, colours: SceneColours | None = None) -> Path:
    """Writes the page: one file that needs no network, in the coordinates of the run. OSError if it
    cannot be written there.

    It shows the faces of kept cells, in the scene's colours or by height, the cameras, the box of
    the occupancy, and space that no photograph shows. A click on a name hides or shows a part.
    """
    import plotly.graph_objects as plotly

    cameras = inspection.cameras_of(occupancy)
    box = interesting_box(occupancy, cameras)
    cells = kept_cells(occupancy, box)
    lowest, highest = heights_seen_from_above(cells)
    faces = _kept_faces(occupancy, cells, lowest)
    figure = plotly.Figure()
    if len(faces):
        middles = faces.mean(dim=1)
        shares = (middles[:, 2] - lowest) / max(highest - lowest, 1e-9)
        shown = _heights(shares) if colours is None else colours.at(middles)
        by = "height" if colours is None else "colours of the photographs"
        figure.add_mesh3d(**_mesh(faces), **_painted(shown), name=f"kept, {by}")
    if len(cameras):
        look = {"size": 3, "color": LIGHT.colours[1]}
        _add_lines(figure, cameras, "cameras", mode="markers", marker=look)
    whole = inspection.whole_box(occupancy)
    _add_lines(figure, _edges(whole), "bounds", line={"color": "#8a8f98", "width": 2})
    seen = inspection.seen_at(occupancy, whole.middles(SEEN_CELLS))
    unseen = faces_of(~seen, whole, beyond=False)
    if len(unseen):
        look = {"color": "#8a8f98", "opacity": 0.25, "visible": "legendonly"}
        figure.add_mesh3d(**_mesh(unseen), **look, name="no photograph shows it")
    axes = {f"{name}axis": {"title": f"{name}, scene units"} for name in "xyz"}
    figure.update_layout(
        title={"text": " · ".join(title_of(occupancy)), "font": {"size": 15}},
        scene={"aspectmode": "data", "camera": EYE, **axes},
        legend={"x": 0.01, "y": 0.98, "bgcolor": "rgba(255,255,255,0.7)"},
        margin={"l": 0, "r": 0, "b": 0, "t": 50},
        template="plotly_white",
    )
    return write_page_file(figure, path, "occupancy")


def faces_of(inside: Tensor, box: ViewBox, beyond: bool) -> Tensor:
    """Faces between cells that are inside a set and those that are not: corners [F, 4, 3].

    Args:
        inside: bool [X, Y, Z], of the cells of a box.
        beyond: whether cells beyond the box count as inside.
    """
    counts = torch.tensor(inside.shape)
    framed = torch.nn.functional.pad(inside, (1, 1) * 3, value=beyond)
    found = []
    for axis in range(3):
        others = [a for a in range(3) if a != axis]
        for side in (0, 1):
            neighbour = framed.roll(1 - 2 * side, axis)[1:-1, 1:-1, 1:-1]
            corners = (inside & ~neighbour).nonzero()[:, None].repeat(1, 4, 1)
            corners[..., axis] += side
            corners[..., others] += CORNERS
            found.append(corners)
    return torch.lerp(box.low, box.high, torch.cat(found) / counts)


def _kept_faces(occupancy: Occupancy, cells: KeptCells, lowest: float) -> Tensor:
    """Faces [F, 4, 3] of kept cells, without what is below the ground at `lowest`, scene units; of
    `COARSER` ones where there are more than `MOST_FACES`."""
    coarser = (kept_cells(occupancy, cells.box, longest) for longest in COARSER)
    for tried in chain([cells], coarser):
        faces = faces_of(tried.kept, tried.box, beyond=True)
        faces = faces[faces[..., 2].amax(dim=1) > lowest - 2.0 * tried.size]
        if len(faces) <= MOST_FACES:
            break
    return faces


def _mesh(faces: Tensor) -> dict[str, Any]:
    """Faces [F, 4, 3] as plotly has them: each corner once, and two triangles a face."""
    places, numbers = faces.reshape(-1, 3).unique(dim=0, return_inverse=True)
    x, y, z = places.T.float().numpy()
    triangles = numbers.view(-1, 4)[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    i, j, k = triangles.T.int().numpy()
    shared = {"flatshading": True, "lighting": LIGHTING, "showlegend": True, "hoverinfo": "skip"}
    return {"x": x, "y": y, "z": z, "i": i, "j": j, "k": k, **shared}


def _painted(colours: NDArray[np.uint8]) -> dict[str, Any]:
    """A colour for each face [F, 3], in a palette."""
    picture = Image.fromarray(colours[None]).quantize(COLOURS)
    palette = np.zeros((COLOURS, 3), np.uint8)
    found = np.asarray(picture.getpalette(), np.uint8).reshape(-1, 3)
    palette[: len(found)] = found
    numbers = np.asarray(picture, np.uint8)[0]
    shades = [[n / (COLOURS - 1), f"rgb({r},{g},{b})"] for n, (r, g, b) in enumerate(palette)]
    return {
        "intensity": numbers.repeat(2),
        "intensitymode": "cell",
        "colorscale": shades,
        "cmin": 0,
        "cmax": COLOURS - 1,
        "showscale": False,
    }


def _heights(shares: Tensor) -> NDArray[np.uint8]:
    """Colours [N, 3] of heights in [0, 1]."""
    from matplotlib import colormaps

    found = colormaps["viridis"](shares.clamp(0.0, 1.0).numpy(), bytes=True)
    return np.ascontiguousarray(found[:, :3])


def _add_lines(figure: Any, places: Tensor, name: str, mode: str = "lines", **style: Any) -> None:
    x, y, z = places.T.float().numpy()
    figure.add_scatter3d(x=x, y=y, z=z, mode=mode, name=name, hoverinfo="skip", **style)


def _edges(box: ViewBox) -> Tensor:
    """A line [16, 3] along all edges of a box: its floor, its top, and three walls' corners."""
    floor = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.0, 0.0]]
    walk = [[*corner, level] for level in (0.0, 1.0) for corner in floor]
    corners, levels = [1, 1, 2, 2, 3, 3], [1.0, 0.0, 0.0, 1.0, 1.0, 0.0]
    walk += [[*floor[corner], level] for corner, level in zip(corners, levels)]
    return torch.lerp(box.low, box.high, torch.tensor(walk))
