"""From small to large: teach, find a threshold, measure; the first gate that holds is the answer.

The threshold gives each gate the kept volume of the original, so that they differ in the loss. It
is found on rays of its own; what is declared is measured on others.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from leco_plugin.capacity.evidence import Evidence, Loss, unlikely_at
from leco_plugin.capacity.gates import ladder, name_of, values_of
from leco_plugin.capacity.references import Bounds, Ground, Reference, Rung, verify
from leco_plugin.evaluation.field_grids import in_parts
from leco_plugin.evaluation.inspection import whole_box
from leco_plugin.learning.calibration import THRESHOLDS
from leco_plugin.learning.lesson import Lesson, round_weights, teach
from leco_plugin.models.gate import GateConfig
from leco_plugin.occupancy import Occupancy

STEPS, LONGER, NEARLY = 1200, 3, 3.0
"""Steps of teaching. A gate whose loss is at most `NEARLY` times what the search allows is taught
again, `LONGER` times as long."""
EMPHASIS, WEIGHT_AT_FULL = 8.0, 0.05
"""How much more a candidate with rendering weight counts, and the weight from which on it does so
fully."""
MARGIN = 0.5
"""Share of the allowed loss that a gate may use on the rays of the search, so that others hold."""
VOLUME_POINTS = 1 << 17
TAUGHT_POINTS = 1 << 18
VOLUMES = (1.0, 1.05)
"""Kept volumes that are tried, as shares of the original's."""


class Found(NamedTuple):
    """The outcome of a search: without an occupancy, nothing smaller holds."""

    occupancy: Occupancy | None
    rungs: list[Rung]


def search(
    ground: Ground,
    bounds: Bounds,
    gates: Sequence[GateConfig] | None = None,
    on_rung: Callable[[Rung], None] | None = None,
    on_progress: Callable[[float], None] | None = None,
) -> Found:
    """Walks up the ladder and stops at the first gate that is within the bounds on unseen rays.

    Args:
        gates: by size; those smaller than the original by default.
        on_rung: called with each gate that was tried.
        on_progress: called with the share of the ladder that is done.
    """
    gates = ladder(values_of(ground.original.gate.config)) if gates is None else gates
    volume = spread_positions(ground.original, VOLUME_POINTS, seed=5)
    kept = kept_of_box(ground.original)
    lesson = lesson_of(ground.original, ground.taught)
    rungs: list[Rung] = []
    looks = 0
    show = on_progress or (lambda share: None)
    for number, config in enumerate(gates):
        started = time.monotonic()
        parts = [(number + done) / len(gates) for done in (0.0, 1.0 / (1 + LONGER), 1.0)]
        for times, (first, last) in zip((1, LONGER), pairwise(parts)):

            def show_part(share: float, first: float = first, last: float = last) -> None:
                show(first + share * (last - first))

            gate = _teach_in_place(config, lesson, times * STEPS, ground.original, show_part)
            rung, gate = _measure(ground, gate, bounds, volume, kept, looks + 1)
            looks = rung.look or looks
            nearly = rung.lost_surface_mass <= NEARLY * MARGIN * bounds.lost_surface_mass
            if rung.verdict == "chosen" or not nearly:
                break
        show(parts[-1])
        rung.seconds = round(time.monotonic() - started, 2)
        rungs.append(rung)
        if on_rung is not None:
            on_rung(rung)
        if rung.verdict == "chosen":
            return Found(gate, rungs)
    return Found(None, rungs)


def _teach_in_place(
    config: GateConfig,
    lesson: Lesson,
    steps: int,
    original: Occupancy,
    on_progress: Callable[[float], None],
) -> Occupancy:
    """A gate in the original's place, without a threshold of its own yet."""
    gate = teach(config, lesson, steps, original.precision, on_progress=on_progress)
    round_weights(gate)
    said = (0.5, original.precision, None)
    smaller = Occupancy(gate, original.space, *said, original.walls, original.seen)
    return smaller.to(original.threshold_value.device).eval()


def lesson_of(original: Occupancy, taught: Evidence) -> Lesson:
    """The original's decisions on candidates of rays, and on as many places anywhere in its box."""
    anywhere = spread_positions(original, TAUGHT_POINTS, seed=6)
    decided = in_parts(original.query, anywhere) >= original.threshold
    kept = torch.cat([taught.kept, decided]).float()
    full = (taught.weights / WEIGHT_AT_FULL).clamp(max=1.0)
    emphasis = torch.cat([full, torch.zeros_like(decided, dtype=full.dtype)])
    mapped = original.space.map(torch.cat([taught.positions, anywhere])).clamp(-1.0, 1.0)
    return Lesson(mapped, kept * (1.0 + EMPHASIS * emphasis), 1.0 - kept)


def _measure(
    ground: Ground, smaller: Occupancy, bounds: Bounds, volume: Tensor, kept: float, look: int
) -> tuple[Rung, Occupancy]:
    """What is found of a gate, and the gate with the threshold that it was found with.

    Args:
        volume: [P, 3] places in the original's box.
        kept: share of them that the original keeps.
        look: number that a look at the verifying rays would have.
    """
    losses_at = _losses_of(smaller, ground.references)
    of_volume = in_parts(smaller.query, volume)
    lost, holds, ratio = 0.0, False, 0.0
    for share in VOLUMES:
        threshold = find_threshold(of_volume, share * kept)
        losses = losses_at(threshold, look)
        lost = max(one.share for one in losses)
        ratio = float((of_volume >= threshold).double().mean()) / max(kept, 1e-12)
        # what is not within the bounds here needs no look at the rays that verify
        holds = all(
            one.bound <= bounds.lost_surface_mass
            and one.share
            <= MARGIN * bounds.lost_surface_mass + (1.0 - MARGIN) * reference.lost_before
            for reference, one in zip(ground.references, losses)
        )
        if holds:
            break
    smaller = smaller.with_threshold(threshold)
    config = smaller.gate.config
    params = values_of(config)
    rung = Rung(name_of(config), params, 2 * params, round(ratio, 4), lost, None, "", 0.0)
    if not holds:
        rung.verdict = "loses too much"
    elif ratio > VOLUMES[-1] + 0.005:
        rung.verdict = "keeps too much"
    else:
        rung.image_price_db = ground.price(smaller, "search")
        if (rung.image_price_db or 0.0) > bounds.image_price_db:
            rung.verdict = "costs too much of the image"
        else:
            holds = verify(ground, smaller, bounds, rung, look)
            rung.verdict = "chosen" if holds else "fails on unseen rays"
    return rung, smaller


def _losses_of(
    gate: Occupancy, references: Sequence[Reference]
) -> Callable[[float, int], list[Loss]]:
    """What a gate loses on the rays of the search, by each reference, at a threshold and a look."""
    scores = [in_parts(gate.query, one.search.evidence.positions) for one in references]

    def losses_at(threshold: float, look: int) -> list[Loss]:
        return [
            one.loss_of(one.search, found < threshold, unlikely_at(look))
            for one, found in zip(references, scores)
        ]

    return losses_at


def lower_threshold(ground: Ground, bounds: Bounds) -> Occupancy | None:
    """The original at the largest lower threshold that meets what is asked of a smaller gate.

    Calibration allows a loss in the mean of some thousand held-out rays, but what is declared has
    to hold on others, too. A smaller gate loses more than the original whose decisions it is
    taught. So an original that itself loses too much is asked to keep more.

    Returns:
        It shares the original's gate; None where the original meets that as it is, no threshold
        does, or nothing measures.
    """
    original = ground.original
    absolute = [reference for reference in ground.references if not reference.guided]
    losses_at = _losses_of(original, absolute)

    def meets(there: Occupancy) -> bool:
        losses = losses_at(there.threshold, 1)
        share, bound = max(one.share for one in losses), max(one.bound for one in losses)
        if share > MARGIN * bounds.lost_surface_mass or not bounds.allow(bound, None):
            return False  # before anything is rendered
        return bounds.allow(bound, ground.price(there, "search", absolute=True))

    if not absolute or meets(original):
        return None
    lower = (original.with_threshold(t) for t in THRESHOLDS if t < original.threshold)
    return next(filter(meets, lower), None)


def find_threshold(scores: Tensor, share: float) -> float:
    """The threshold at which a share of places, with scores [M], is kept."""
    ordered = scores.double().sort(descending=True).values
    return float(ordered[min(max(round(share * len(ordered)) - 1, 0), len(ordered) - 1)])


def kept_of_box(occupancy: Occupancy) -> float:
    """Share of an occupancy's box, or of a contracted cube, that it keeps."""
    places = spread_positions(occupancy, VOLUME_POINTS, seed=5)
    return float((in_parts(occupancy.query, places) >= occupancy.threshold).double().mean())


def spread_positions(occupancy: Occupancy, count: int, seed: int) -> Tensor:
    """Positions [count, 3] spread evenly over the occupancy's box, or over a contracted cube."""
    unit = torch.rand(count, 3, generator=torch.Generator().manual_seed(seed))
    device = occupancy.threshold_value.device
    if occupancy.space.kind == "contraction":
        return occupancy.space.unmap(2.0 * unit.to(device) - 1.0)
    box = whole_box(occupancy)
    return torch.lerp(box.low, box.high, unit).to(device)
