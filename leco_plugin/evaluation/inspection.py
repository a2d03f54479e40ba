"""What an occupancy file says about itself, and the part of space that is worth looking at."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from leco_plugin.learning.quality import (
    FIELD,
    ONE_COLOUR,
    doubts_of_field,
    doubts_of_occupancy,
)
from leco_plugin.occupancy import SEEN_CELLS, Occupancy
from leco_plugin.scenes.coloured_points import camera_places, description_in, description_of_run
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
    points = torch.rand(1 << 16, 3, generator=torch.Generator().manual_seed(0))
    positions = torch.lerp(box.low, box.high, points)
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
    """What was said when the occupancy was frozen, if it or its field are of no use.

    Args:
        facts: of `describe`.
    """
    field, one_colour = (facts["report"].get(name) for name in (FIELD, ONE_COLOUR))
    found: list[str] = []
    if isinstance(field, float) and isinstance(one_colour, float):
        found = doubts_of_field(field, one_colour)
    kept = facts["kept_share_of_box"] / max(facts["seen_share_of_box"], 1e-12)
    return found or doubts_of_occupancy(kept)


def whole_box(occupancy: Occupancy) -> ViewBox:
    """The space's inner cube, cut by the walls between which rays were marched, if any."""
    center = occupancy.space.center.cpu()
    half = float(occupancy.space.half_extent)
    low, high = center - half, center + half
    walls = numbers(occupancy.report.get("aabb"))
    if len(walls) == 6:
        wall = torch.tensor(walls)
        cut_low, cut_high = torch.maximum(low, wall[:3]), torch.minimum(high, wall[3:])
        if bool((cut_low < cut_high).all()):
            return ViewBox(cut_low, cut_high)
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
    if (
        description is None
        or back is None
        or not len(known)
        or "data_frame" not in occupancy.report
    ):
        return description
    here = moved(torch.from_numpy(camera_places(description)), inverse(back))
    found = 0
    if len(here):
        found = int(found_again(known, here, float(occupancy.space.half_extent)).sum())
    if 2 * found >= len(known):
        return description
    if data is None:
        return None
    raise InputError(
        f"--data {data}: {found} of the {len(known)} cameras that the occupancy names are in it; "
        "give the scene that it was learned on"
    )


def to_the_data(occupancy: Occupancy) -> Tensor | None:
    """Takes positions of the run to those that the data's own files have: [3, 4] float64.

    None where the file does not say how its run turned, moved and scaled the data.
    """
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
def query(occupancy: Occupancy, positions: Tensor) -> Tensor:
    """o(x) of positions [..., 3] in pieces: [...] float32 on the CPU."""
    device = occupancy.threshold_value.device
    values = in_parts(lambda part: occupancy.query(part.to(device)).cpu(), positions.reshape(-1, 3))
    return values.reshape(positions.shape[:-1])


@torch.no_grad()
def seen_at(occupancy: Occupancy, positions: Tensor) -> Tensor:
    """Whether any training ray comes near positions [..., 3]: bool [...] on the CPU."""
    device = occupancy.threshold_value.device

    def seen(part: Tensor) -> Tensor:
        mapped = occupancy.space.map(part.to(device))
        inside = mapped.abs().amax(dim=-1) <= 1.0
        return (occupancy.seen(mapped.clamp(-1.0, 1.0)) & inside).cpu()

    return in_parts(seen, positions.reshape(-1, 3)).reshape(positions.shape[:-1])


def in_parts(function: Callable[[Tensor], Tensor], positions: Tensor) -> Tensor:
    """A function of positions [N, 3], some at a time: [N]."""
    return torch.cat([function(part) for part in positions.split(POINTS_AT_ONCE)])


def exposed(kept: Tensor, beyond: bool = False) -> Tensor:
    """Kept cells with at least one skipped neighbour of six: bool [X, Y, Z], as `kept`.

    Args:
        beyond: whether what lies beyond the cells counts as kept.
    """
    skipped = torch.nn.functional.pad(~kept, (1, 1) * 3, value=not beyond)
    shifts = [skipped.roll(step, axis) for axis in range(3) for step in (-1, 1)]
    return kept & torch.stack(shifts).any(dim=0)[1:-1, 1:-1, 1:-1]
