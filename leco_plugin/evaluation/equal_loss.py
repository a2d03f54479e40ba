"""How much space an occupancy keeps when all lose equally much: representations side by side.

Each representation has a score of its own, o(x) of a gate or the running occupancy of a grid's
cell; its threshold is set so that exactly the same share of the weight near surfaces is lost.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from leco_plugin.evaluation.clock import Clock
from leco_plugin.evaluation.inspection import whole_box
from leco_plugin.models.calibration import Reference
from leco_plugin.models.freezing import calibration_rays, dense_reference
from leco_plugin.models.gate import occupancy_from_logits
from leco_plugin.models.leco import LecoModel
from leco_plugin.models.rendering import Rays, gate_values_and_routes, mapped_middles
from leco_plugin.occupancy import gate_precision
from leco_plugin.samplers.grid import OccupancyGridEstimator

LOST_SURFACE_MASS = 1e-3
"""Of the weight near surfaces."""
VOLUME_POINTS = 1 << 16
GRID_UPDATES = 4
"""Times that a grid asks the density of all its cells, each time somewhere else in them. nerfacc's
asks 16 times before it begins to ask fewer; thin things in large cells want several."""
POINTS_AT_ONCE = 1 << 16


def threshold_losing(weights: Tensor, scores: Tensor, lost: float) -> float:
    """The largest score below which samples hold at most a share `lost` of all weight.

    Args:
        weights: [M] non-negative.
        scores: [M]; what is below the threshold is skipped.
    """
    ordered, order = scores.double().sort()
    skipped = weights.double()[order].cumsum(0)
    first_too_many = int((skipped <= lost * skipped[-1]).sum())
    return float(ordered[min(first_too_many, len(ordered) - 1)])


@torch.no_grad()
def at_equal_loss(
    model: LecoModel, datamanager: Any, grids: Sequence[int | tuple[int, int, int]] = ()
) -> dict[str, Any]:
    """What the model's gate keeps at `LOST_SURFACE_MASS`, and grids made from the same field.

    Meant for the moment of freezing: what a gate skips is not trained from then on.

    Args:
        model: whose gate has just been frozen; it is left as it was.
        datamanager: with held-out training pixels.
        grids: cells along each axis of the grids, one number for all three or one for each.
    Returns:
        `lost_surface_mass`; `kept_volume` and `kept_candidates`, shares of the scene's box and of
        the candidates between near and far; and `grids`, the same for each with its `resolution`,
        its `bytes` at one bit a cell and the `update_seconds` that it took beyond the field.
    """
    was_training = model.training
    model.eval()
    rays, _ = calibration_rays(model, datamanager)
    most = model.config.calibration.rays_at_once
    chunks = [
        Rays._make(None if part is None else part[i : i + most] for part in rays)
        for i in range(0, len(rays.origins), most)
    ]
    references = [dense_reference(model, chunk) for chunk in chunks]
    volume = _points_of_box(model)
    gate = _kept(
        references,
        [reference.occupancies for reference in references],
        _in_parts(lambda mapped: _occupancy(model, mapped), volume),
    )
    rows = [_grid_row(model, chunks, references, volume, size) for size in grids]
    model.train(was_training)
    return {"lost_surface_mass": LOST_SURFACE_MASS, **gate, "grids": rows}


def _grid_row(
    model: LecoModel,
    chunks: Sequence[Rays],
    references: Sequence[Reference],
    volume: Tensor,
    resolution: int | tuple[int, int, int],
) -> dict[str, Any]:
    clock = Clock()
    clock.start()
    grid = grid_of_field(model, resolution)
    seconds = clock.stop()
    scores = [
        grid.values(mapped_middles(model.space, rays, reference.intervals))
        for rays, reference in zip(chunks, references)
    ]
    return {
        "resolution": resolution,
        "bytes": math.ceil(grid.cells_per_lvl / 8),
        "update_seconds": round(seconds, 3),
        **_kept(references, scores, grid.values(volume)),
    }


def grid_of_field(
    model: LecoModel, resolution: int | tuple[int, int, int]
) -> OccupancyGridEstimator:
    """An occupancy grid in mapped coordinates, filled from the density of a model's field."""
    low, high = _mapped_box(model)
    grid = OccupancyGridEstimator(torch.cat([low, high]), resolution).to(model.device).train()

    def density(mapped: Tensor) -> Tensor:
        return _in_parts(lambda part: _sigmas(model, part), mapped)

    for _ in range(GRID_UPDATES):
        grid.update_every_n_steps(step=0, occ_eval_fn=density)
    return grid


def _sigmas(model: LecoModel, mapped: Tensor) -> Tensor:
    with gate_precision(model.device.type, model.precision):
        left = model.field.experts.those_left()
        values, routes = gate_values_and_routes(model.gate(mapped), model.routing, left)
        sigmas: Tensor = model.field.density(mapped, routes, values)[0]
    return sigmas


def _occupancy(model: LecoModel, mapped: Tensor) -> Tensor:
    with gate_precision(model.device.type, model.precision):
        return occupancy_from_logits(model.gate(mapped))


def _in_parts(function: Any, mapped: Tensor) -> Tensor:
    return torch.cat([function(part) for part in mapped.split(POINTS_AT_ONCE)])


def _mapped_box(model: LecoModel) -> tuple[Tensor, Tensor]:
    """Corners of the scene's box in mapped coordinates; an unbounded scene fills the cube."""
    device = model.device
    if model.space.kind != "box":
        return -torch.ones(3, device=device), torch.ones(3, device=device)
    box = whole_box(model.occupancy())
    corners = torch.stack([box.low, box.high]).to(device)
    low, high = model.space.map(corners).clamp(-1.0, 1.0)
    return low, high


def _points_of_box(model: LecoModel) -> Tensor:
    """Mapped positions [P, 3] spread evenly over the volume of the scene's box."""
    box = whole_box(model.occupancy())
    unit = torch.rand(VOLUME_POINTS, 3, generator=torch.Generator().manual_seed(0))
    positions = torch.lerp(box.low, box.high, unit).to(model.device)
    return model.space.map(positions).clamp(-1.0, 1.0)


def _kept(
    references: Sequence[Reference], scores: Sequence[Tensor], volume_scores: Tensor
) -> dict[str, float]:
    """Shares kept at the threshold that loses `LOST_SURFACE_MASS`; the backdrop is left out."""
    counted = [~reference.always_kept for reference in references]
    weights = torch.cat([r.weights * r.near_surface for r in references])
    all_scores, before_backdrop = torch.cat(list(scores)), torch.cat(counted)
    weights, all_scores = weights[before_backdrop], all_scores[before_backdrop]
    threshold = threshold_losing(weights, all_scores, LOST_SURFACE_MASS)
    return {
        "kept_volume": round(float((volume_scores >= threshold).double().mean()), 5),
        "kept_candidates": round(float((all_scores >= threshold).double().mean()), 5),
    }
