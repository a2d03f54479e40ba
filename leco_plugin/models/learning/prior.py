"""A prior before the first step: sparse points show the gate where something is, and what is free.

Points of structure from motion lie on surfaces, and what lies between a camera and a point that it
sees is empty. Space far from any point is guessed to be empty, too, which counts less.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from leco_plugin.models.compute.optimizers import RATES, FusedAdamConfig
from leco_plugin.models.compute.ranks import share
from leco_plugin.models.gate import occupancy_logit
from leco_plugin.models.losses import balance_loss
from leco_plugin.occupancy import gate_precision
from leco_plugin.scenes.pixels.sparse_pixels import SparsePixels

if TYPE_CHECKING:
    from leco_plugin.models.leco import LecoModel

CELLS = 96
"""Cells along each axis of the mapped cube in which points are looked for."""
MOST_SEGMENTS = 200_000
"""Of the lines of sight to points, so many are drawn from."""


@dataclass(frozen=True)
class PriorConfig:
    """What sparse points teach the gate before the first step."""

    steps: int = 0
    """Quick steps of the gate alone; 0 is no prior."""
    positions: int = 4096
    """Of each kind in a step: at points, before them, and far from any."""
    guess: float = 0.25
    """How much a position far from any point counts; one before a point that is seen counts 1."""


def near_points(mapped: Tensor) -> Tensor:
    """Cells of the mapped cube that hold a point or touch one that does: bool [CELLS] * 3.

    Args:
        mapped: [P, 3] points.
    """
    marked = torch.zeros(CELLS**3, device=mapped.device)
    marked[_cells(mapped)] = 1.0
    around = torch.nn.functional.max_pool3d(marked.view(1, 1, CELLS, CELLS, CELLS), 3, 1, 1)
    return around[0, 0] > 0


def _cells(mapped: Tensor) -> Tensor:
    """Flat cell numbers of mapped positions [N, 3]: int64 [N]."""
    x, y, z = ((mapped + 1.0) * (CELLS / 2)).long().clamp(0, CELLS - 1).unbind(dim=-1)
    return (x * CELLS + y) * CELLS + z


def far_positions(count: int, near: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Mapped positions [N <= count, 3], even in the box from `low` to `high`, none near a point.

    Args:
        near: of `near_points`.
        low, high: [3] mapped corners.
    """
    drawn = torch.lerp(low, high, torch.rand(count, 3, device=low.device))
    return drawn[~near.view(-1)[_cells(drawn)]]


def before_points(
    origins: Tensor, directions: Tensor, distances: Tensor, clear: float, near: float
) -> Tensor:
    """Positions on lines of sight, at least `clear` before the point and `near` from the camera.

    Args:
        origins, directions: [S, 3] of rays that see points, scene units.
        distances: [S] to the points.
    Returns:
        [N <= S, 3], one on each line that is long enough.
    """
    ends = distances - clear
    along = near + torch.rand_like(distances) * (ends - near)
    positions = origins + directions * along[:, None]
    return positions[ends > near]


def lines_of_sight(cameras: Cameras, sparse: SparsePixels) -> tuple[Tensor, Tensor, Tensor]:
    """Origins [S, 3], unit directions [S, 3] and distances [S] of rays to the points they see."""
    generator = torch.Generator().manual_seed(0)
    chosen = torch.randperm(len(sparse.distances), generator=generator)[:MOST_SEGMENTS]
    pixels = sparse.indices[chosen]
    bundle = cameras.to("cpu").generate_rays(
        camera_indices=pixels[:, :1], coords=pixels[:, 1:].float() + 0.5
    )
    return bundle.origins, bundle.directions, sparse.distances[chosen]


def warm_start(model: LecoModel, cameras: Cameras, points: Tensor, sparse: SparsePixels) -> float:
    """Teaches the gate alone what sparse points prove; all processes end with the same gate.

    Args:
        model: whose bounds are known and whose gate is new.
        points: [P, 3] scene units.
        sparse: where they are seen.
    Returns:
        Loss of the last step.
    """
    config, device = model.config.prior, model.device
    points = points.to(device).float()
    points = points[points.isfinite().all(dim=-1)]
    half = float(model.space.half_extent)
    # as wide as a learning candidate is long: learning looks at surfaces with that margin
    spread = max(float(model.march_range[3]), 0.01 * half)
    near = near_points(model.space.map(points).clamp(-1.0, 1.0))
    low, high = model.space.map(model.aabb.view(2, 3)).clamp(-1.0, 1.0)
    sight = [part.to(device) for part in lines_of_sight(cameras, sparse)]
    near_plane = float(model.march_range[0])
    optimizer = FusedAdamConfig(lr=RATES["gate"]).setup(list(model.gate.parameters()))
    emphasis = model.config.gate_loss.emphasis
    loss = torch.zeros((), device=device)
    for _ in range(config.steps):
        drawn = points[torch.randint(len(points), (config.positions,), device=device)]
        there = model.space.map(drawn + spread * torch.randn_like(drawn))
        lines = torch.randint(len(sight[0]), (min(config.positions, len(sight[0])),), device=device)
        origins, directions, distances = (part[lines] for part in sight)
        free = before_points(origins, directions, distances, 3.0 * spread, near_plane)
        parts = [
            (there, emphasis, True),
            (model.space.map(free), 1.0, False),
            (far_positions(config.positions, near, low, high), config.guess, False),
        ]
        loss = _loss(model, parts)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    share(model.gate.state_dict().values())
    return float(loss.detach())


def _loss(model: LecoModel, parts: list[tuple[Tensor, float, bool]]) -> Tensor:
    """Cross-entropy of o(x), each kind of position a mean of its own, and the experts' balance."""
    mapped = torch.cat([part.clamp(-1.0, 1.0) for part, _, _ in parts])
    with gate_precision(model.device.type, model.precision):
        logits = model.gate(mapped)
    loss = logits.new_zeros(())
    for (_, weight, is_there), part in zip(parts, logits.split([len(part) for part, *_ in parts])):
        if len(part):
            logit = occupancy_logit(part)
            loss = (
                loss + weight * torch.nn.functional.softplus(-logit if is_there else logit).mean()
            )
    there = logits[: len(parts[0][0])]
    if there.shape[-1] > 2 and len(there):
        scene = there[:, 1:]
        loss = loss + balance_loss(scene.softmax(dim=-1), scene.argmax(dim=-1))
    return loss
