"""What an occupancy says about itself and along rays, and the part of space worth looking at."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from leco_plugin.learning import quality
from leco_plugin.models.region import cut_rays, marching_rule, within_crop
from leco_plugin.occupancy import SEEN_CELLS, Occupancy
from leco_plugin.samplers import marching
from leco_plugin.samplers.base import midpoints
from leco_plugin.scenes.coloured_points import (
    PointCloud,
    camera_places,
    coloured_points,
    colours_near,
    description_in,
    description_of_run,
)
from leco_plugin.scenes.frames import found_again, inverse, moved
from leco_plugin.scenes.input_error import InputError

POINTS_AT_ONCE = 1 << 16


@dataclass(frozen=True)
class ViewBox:
    """The box of scene positions that is drawn or measured."""

    low: Tensor
    """[3] scene units."""
    high: Tensor
    """[3] scene units."""

    def draw(self, count: int, seed: int = 0) -> Tensor:
        """Positions spread evenly over the box, the same for a seed: [count, 3] on the CPU."""
        unit = torch.rand(count, 3, generator=torch.Generator().manual_seed(seed))
        return torch.lerp(self.low, self.high, unit)

    def cells(self, longest: int) -> tuple[int, int, int]:
        """Numbers of nearly cubic cells, `longest` along the longest side."""
        sides = self.high - self.low
        x, y, z = (sides / sides.max() * longest).round().clamp(min=2).int().tolist()
        return x, y, z

    def axis(self, number: int, count: int) -> Tensor:
        """Middles of `count` cells along an axis: [count]."""
        shares = (torch.arange(count) + 0.5) / count
        return torch.lerp(self.low[number], self.high[number], shares)

    def middles(self, longest: int) -> Tensor:
        """Middles of nearly cubic cells, `longest` along the longest side: [X, Y, Z, 3]."""
        axes = [self.axis(number, count) for number, count in enumerate(self.cells(longest))]
        return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)


def describe(occupancy: Occupancy) -> dict[str, Any]:
    """Sizes, space, threshold, kept share of its box, report of calibration: JSON values."""
    box = whole_box(occupancy)
    positions = box.draw(1 << 16)
    values = query(occupancy, positions)
    return {
        "format": 1,
        "params": occupancy.num_params,
        "bytes_of_weights": sum(
            value.numel() * value.element_size()
            for name, value in occupancy.state_dict().items()
            if name != SEEN_CELLS
        ),
        "threshold": occupancy.threshold,
        "precision": occupancy.precision,
        "space": {
            "kind": occupancy.space.kind,
            "center": occupancy.space.center.tolist(),
            "half_extent": float(occupancy.space.half_extent),
        },
        "box": [*box.low.tolist(), *box.high.tolist()],
        "seen_share_of_box": float(seen_at(occupancy, positions).double().mean()),
        "kept_share_of_box": float((values >= occupancy.threshold).double().mean()),
        "gate": occupancy.gate.config.to_dict(),
        "report": occupancy.report,
    }


def doubts(facts: dict[str, Any]) -> list[str]:
    """What a run says at its end, or at freezing, of a field or an occupancy that is of no use;
    `facts` are of `describe`."""
    found: list[str] = []
    report = facts["report"]
    at_end = report.get(quality.AT_END)
    figures = at_end if isinstance(at_end, dict) else report
    field, one_colour = (figures.get(name) for name in (quality.FIELD, quality.ONE_COLOUR))
    if isinstance(field, float) and isinstance(one_colour, float):
        found = quality.doubts_of_field(field, one_colour)
    kept = facts["kept_share_of_box"] / max(facts["seen_share_of_box"], 1e-12)
    return found or quality.doubts_of_occupancy(kept)


def whole_box(occupancy: Occupancy) -> ViewBox:
    """The space's inner cube, cut by the walls in which the gate was taught, if there are any."""
    center = occupancy.space.center.cpu()
    half = float(occupancy.space.half_extent)
    low, high = occupancy.walls.cpu().view(2, 3)
    cut_low, cut_high = torch.maximum(center - half, low), torch.minimum(center + half, high)
    if bool((cut_low < cut_high).all()):
        return ViewBox(cut_low, cut_high)
    return ViewBox(center - half, center + half)


def mapped_box(occupancy: Occupancy) -> ViewBox:
    """The part of the gate's cube in which it was taught, on the CPU; all of it where the scene is
    unbounded."""
    if occupancy.space.kind != "box":
        return ViewBox(-torch.ones(3), torch.ones(3))
    box = whole_box(occupancy)
    device = occupancy.threshold_value.device
    low, high = occupancy.space.map(torch.stack([box.low, box.high]).to(device)).cpu()
    return ViewBox(low, high)


def cameras_of(occupancy: Occupancy) -> Tensor:
    """Camera centres [C, 3] that the report names, scene units; [0, 3] if it names none."""
    listed = occupancy.report.get("cameras")
    rows = [numbers(row) for row in listed] if isinstance(listed, list) else []
    return torch.tensor([row for row in rows if len(row) == 3]).reshape(-1, 3)


def scene_of(occupancy: Occupancy, file: Path, data: Path | None) -> Path | None:
    """The transforms.json of the scene that an occupancy was learned on; None where it is unknown.

    Args:
        file: of the occupancy, perhaps in the folder of its run.
        data: the scene; None is that of the run, unless it has other cameras by now.
    Raises:
        InputError: `data` is no scene, or fewer than half of the occupancy's cameras are in it.
    """
    description = description_of_run(file) if data is None else description_in(data)
    known, back = cameras_of(occupancy), to_the_data(occupancy)
    says_where = len(known) > 0 and "data_frame" in occupancy.report
    if description is None or back is None or not says_where:
        return description
    here = moved(torch.from_numpy(camera_places(description)), inverse(back))
    reach = float(occupancy.space.half_extent)
    found = int(found_again(known, here, reach).sum()) if len(here) else 0
    if 2 * found >= len(known):
        return description
    if data is None:
        return None
    raise InputError(
        f"--data {data}: {found} of the {len(known)} cameras that the occupancy names are in it; "
        "give the scene that it was learned on"
    )


def to_the_data(occupancy: Occupancy) -> Tensor | None:
    """Takes positions of the run to those of the data's own files: [3, 4] float64; None where the
    occupancy does not say how its run turned, moved and scaled the data."""
    frame = occupancy.report.get("data_frame") or occupancy.report.get("frame")
    rows = [numbers(row) for row in frame] if isinstance(frame, list) else []
    if [len(row) for row in rows] != [4, 4, 4]:
        return None
    known = torch.tensor(rows, dtype=torch.float64)
    return inverse(known) if float(known[:, :3].det()) != 0.0 else None


def numbers(value: Any) -> list[float]:
    """A list of finite numbers from a file as it is; empty for anything else."""
    if not isinstance(value, list):
        return []
    sound = all(isinstance(x, (int, float)) and math.isfinite(x) and abs(x) < 1e30 for x in value)
    return [float(x) for x in value] if sound else []


@torch.no_grad()
def ask(occupancy: Occupancy, question: Callable[[Tensor], Tensor], positions: Tensor) -> Tensor:
    """A function of positions [..., 3], asked about some at a time on an occupancy's device: [...]
    on the CPU."""
    device = occupancy.threshold_value.device
    answers = in_parts(lambda part: question(part.to(device)).cpu(), positions.reshape(-1, 3))
    return answers.reshape(positions.shape[:-1])


def query(occupancy: Occupancy, positions: Tensor) -> Tensor:
    """o(x) of positions [..., 3] in pieces: [...] float32 on the CPU."""
    return ask(occupancy, occupancy.query, positions)


def seen_at(occupancy: Occupancy, positions: Tensor) -> Tensor:
    """Whether any training ray comes near positions [..., 3]: bool [...] on the CPU."""

    def seen(part: Tensor) -> Tensor:
        mapped = occupancy.space.map(part)
        return occupancy.seen(mapped.clamp(-1.0, 1.0)) & (mapped.abs().amax(dim=-1) <= 1.0)

    return ask(occupancy, seen, positions)


def in_parts(function: Callable[[Tensor], Tensor], positions: Tensor) -> Tensor:
    """A function of positions [N, 3], some at a time: [N]."""
    return torch.cat([function(part) for part in positions.split(POINTS_AT_ONCE)])


def exposed(kept: Tensor, beyond: bool = False) -> Tensor:
    """Kept cells with at least one skipped neighbour of six: bool [X, Y, Z], as `kept`. `beyond`
    says whether what lies beyond the cells counts as kept."""
    skipped = torch.nn.functional.pad(~kept, (1, 1) * 3, value=not beyond)
    shifts = [skipped.roll(step, axis) for axis in range(3) for step in (-1, 1)]
    return kept & torch.stack(shifts).any(dim=0)[1:-1, 1:-1, 1:-1]


class SceneColours(NamedTuple):
    """The scene's sparse points, and how the run lies in their coordinates."""

    points: PointCloud
    back: Tensor
    """[3, 4] float64, from the run to the data."""

    def at(self, positions: Tensor) -> NDArray[np.uint8]:
        """Colours [N, 3] of the sparse points nearest to positions [N, 3] of the run."""
        return colours_near(self.points, moved(positions.double(), self.back).numpy())


def scene_colours(occupancy: Occupancy, description: Path | None) -> SceneColours | None:
    """Colours by a scene's transforms.json; None where points, colours or coordinates are unknown.
    A file of points that cannot be read is an `InputError`."""
    points = None if description is None else coloured_points(description)
    back = to_the_data(occupancy)
    return None if points is None or back is None else SceneColours(points, back)


SKIPPED, KEPT, UNSEEN = 0, 1, 2
CANDIDATES = 192
"""Of a ray that crosses the scene."""
NEAREST, FARTHEST = 0.02, 100.0
"""Where rays begin and end, half extents of the space."""


@torch.no_grad()
def ray_states(
    occupancy: Occupancy,
    origins: Tensor,
    directions: Tensor,
    crop: tuple[Tensor | None, Tensor | None] = (None, None),
) -> Tensor:
    """The state [R] of each ray: `KEPT` where any candidate is kept; else `UNSEEN` where any lies
    in space that no training ray crosses; else `SKIPPED`.

    Args:
        origins, directions: [R, 3] in the occupancy's coordinates, unit vectors.
        crop: nears and fars of the rays, [R] or [R, 1], scene units; None is no crop.
    """
    samples = candidates(occupancy, origins, directions, crop)
    of_ray, positions = samples[0], midpoints(samples, origins, directions)
    states = torch.full((len(origins),), SKIPPED, device=origins.device)
    states[of_ray[occupancy.unseen(positions)]] = UNSEEN
    states[of_ray[occupancy.query(positions) >= occupancy.threshold_value]] = KEPT
    return states


def candidates(
    occupancy: Occupancy,
    origins: Tensor,
    directions: Tensor,
    crop: tuple[Tensor | None, Tensor | None] = (None, None),
    most: int = CANDIDATES,
) -> tuple[Tensor, Tensor, Tensor]:
    """Intervals in whose middles an occupancy is asked along rays, the nearest of each ray first.

    Args:
        origins, directions, crop: as of `ray_states`.
        most: on a ray that crosses the scene.
    Returns:
        The ray [M] int64 of each; starts and ends [M], scene units.
    """
    space, half = occupancy.space, float(occupancy.space.half_extent)
    near, far = NEAREST * half, FARTHEST * half
    box = occupancy.walls
    if space.kind == "box":
        inner = whole_box(occupancy)
        box = torch.cat([inner.low, inner.high]).to(box)
    rays = within_crop(
        cut_rays(origins, directions, box, box.new_tensor(near), box.new_tensor(far)), *crop
    )
    rule = marching.March(*marching_rule(space.kind, near, far, most, 2.0 * half))
    return marching.march(marching.Rays(*rays[:4]), rule)
