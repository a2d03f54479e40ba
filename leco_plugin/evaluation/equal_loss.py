"""How much space an occupancy keeps when all lose equally much: representations side by side.

Each representation has a score of its own, o(x) of a gate or the largest density in a grid's cell;
its threshold is set so that exactly the same share of the weight near surfaces is lost.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from leco_plugin.evaluation.field_grids import (
    FieldGrids,
    density_of,
    fits_memory,
    in_parts,
    looked_up,
    plain_and_dilated,
)
from leco_plugin.evaluation.inspection import ViewBox
from leco_plugin.evaluation.reached_volume import (
    candidates_of,
    mapped_box,
    rays_of_photographs,
    reached_volume,
)
from leco_plugin.learning.dense import dense_reference, evaluating
from leco_plugin.learning.held_out_rendering import calibration_rays
from leco_plugin.models.gate import occupancy_from_logits
from leco_plugin.models.leco import LecoModel
from leco_plugin.models.rendering import Rays, mapped_middles
from leco_plugin.occupancy import gate_precision

LOST_SURFACE_MASS = 1e-3
"""Of the weight near surfaces."""
VOLUME_POINTS = 1 << 17
"""In the whole box, those that no ray reaches among them."""
TAUGHT_RAYS = 1 << 15
MOST_ON_CPU = 2e8
"""Densities asked for one grid: about three minutes of two cores."""
SPARED = 0.1
"""Of the allowed loss: cells of a coarse grid that can be had for it are empty in finer ones."""


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


def kept_shares(
    weights: Tensor, scores: Tensor, of_volume: Tensor, lost: float
) -> tuple[float, float]:
    """Shares of the volume and of the candidates that are kept where a share of weight is lost.

    Args:
        weights: [M] of candidates, near surfaces.
        scores: [M] of the candidates.
        of_volume: [P] scores of places spread evenly over what rays reach of the scene's box.
        lost: share of the weight.
    """
    threshold = threshold_losing(weights, scores, lost)
    volume, candidates = ((some >= threshold).double().mean() for some in (of_volume, scores))
    return float(volume), float(candidates)


@torch.no_grad()
def at_equal_loss(
    model: LecoModel,
    datamanager: Any,
    grids: Sequence[int | tuple[int, int, int]] = (),
    until_as_little: bool = False,
    others: Mapping[str, Callable[[Tensor], Tensor]] | None = None,
) -> dict[str, Any]:
    """What the model's gate keeps at `LOST_SURFACE_MASS`, and grids made from the same field.

    Meant for the model as it was at the moment of freezing: what a gate skips is not trained from
    then on. Only places that rays of photographs reach count as volume. Grids hear of the densities
    along those rays, as a gate does while it learns, beside random places in their cells.

    Args:
        model: whose gate is frozen; it is left as it was.
        datamanager: with held-out training pixels.
        grids: cells along each axis of the grids, one number for all three or one for each.
        until_as_little: whether the first grid that keeps as little as the gate is the last.
        others: further representations by name, each a score of mapped positions [N, 3]: [N].
    Returns:
        `lost_surface_mass`; `reached_volume`, the share of the scene's box that rays reach;
        `kept_reached_volume` and `kept_candidates`, shares of that and of the candidates between
        near and far; `grids`, the same for each with its `resolution`, its `bytes` at one bit a
        cell, the `update_seconds` that it took beyond the field, coarser grids included, and
        whether it keeps least `dilated` by a cell; `others`, what each keeps if there are any; and
        `left_out`, resolutions that would not fit the free memory, or take minutes of a CPU.
    Raises:
        ValueError: held-out rays see no surface.
    """
    with evaluating(model):
        mapped, weights, occupancies = _measured(model, datamanager)
        if not bool((weights > 0.0).any()):
            raise ValueError("no surface is seen by the held-out rays, so that none can be lost")
        taught = candidates_of(model, rays_of_photographs(datamanager, TAUGHT_RAYS))
        volume = reached_volume(model, taught, VOLUME_POINTS)
        kept = kept_shares(
            weights, occupancies, in_parts(partial(_occupancy, model), volume), LOST_SURFACE_MASS
        )
        beside = {}
        for name, score in (others or {}).items():
            of_rays, of_volume = in_parts(score, mapped), in_parts(score, volume)
            beside[name] = _shares(kept_shares(weights, of_rays, of_volume, LOST_SURFACE_MASS))
        rows, left_out = [], []
        if grids:
            box = mapped_box(model)

            def floor_of(scores: Tensor) -> float:
                of_rays = looked_up(scores, box, mapped)
                return threshold_losing(weights, of_rays, SPARED * LOST_SURFACE_MASS)

            known = taught, density_of(model, taught)
            most = MOST_ON_CPU if model.device.type == "cpu" else math.inf
            filling = FieldGrids(partial(density_of, model), box, known, floor_of, most)
            for resolution in grids:
                sizes = (resolution,) * 3 if isinstance(resolution, int) else resolution
                scores = filling.fill(sizes) if fits_memory(math.prod(sizes)) else None
                if scores is None:
                    left_out.append(resolution)
                    continue
                row: dict[str, Any] = {
                    "resolution": resolution,
                    "bytes": math.ceil(math.prod(sizes) / 8),
                    "update_seconds": round(filling.clock.seconds, 3),
                }
                rows.append(row | _better_of_dilations(scores, box, mapped, weights, volume))
                if until_as_little and rows[-1]["kept_reached_volume"] <= round(kept[0], 5):
                    break
    return {
        "lost_surface_mass": LOST_SURFACE_MASS,
        "reached_volume": round(len(volume) / VOLUME_POINTS, 5),
        **_shares(kept),
        **({"others": beside} if beside else {}),
        "grids": rows,
        "left_out": left_out,
    }


def _better_of_dilations(
    scores: Tensor, box: ViewBox, mapped: Tensor, weights: Tensor, volume: Tensor
) -> dict[str, Any]:
    """What a grid keeps as it is, or dilated, whichever is less."""
    found = []
    for dilated, (of_rays, of_volume) in enumerate(plain_and_dilated(scores, box, mapped, volume)):
        kept = kept_shares(weights, of_rays, of_volume, LOST_SURFACE_MASS)
        found.append({"dilated": bool(dilated), **_shares(kept)})
    return min(found, key=lambda one: one["kept_reached_volume"])


def _shares(kept: tuple[float, float]) -> dict[str, float]:
    return {"kept_reached_volume": round(kept[0], 5), "kept_candidates": round(kept[1], 5)}


def _measured(model: LecoModel, datamanager: Any) -> tuple[Tensor, Tensor, Tensor]:
    """Candidates of held-out rays before the backdrop: mapped [M, 3], weights near surfaces [M],
    and o(x) [M]."""
    rays, _ = calibration_rays(model, datamanager)
    most = model.config.calibration.rays_at_once
    pieces = []
    for first in range(0, len(rays.origins), most):
        part = slice(first, first + most)
        some = Rays._make(None if value is None else value[part] for value in rays)
        found = dense_reference(model, some)
        before = ~found.always_kept
        places = mapped_middles(model.space, some, found.intervals)
        weights = found.weights * found.near_surface
        pieces.append((places[before], weights[before], found.occupancies[before]))
    places, weights, occupancies = (torch.cat(parts) for parts in zip(*pieces))
    return places, weights, occupancies


def _occupancy(model: LecoModel, mapped: Tensor) -> Tensor:
    with gate_precision(model.device.type, model.precision):
        return occupancy_from_logits(model.gate(mapped))
