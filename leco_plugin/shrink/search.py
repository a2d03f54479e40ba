"""From small to large: teach, find a threshold, measure; the first gate that holds is the answer.

The threshold gives each gate the kept volume of the original, so that what differs is the loss. It
is found on rays of its own; what is declared is measured on others.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from itertools import pairwise

import torch
from torch import Tensor

from leco_plugin.evaluation.inspection import whole_box
from leco_plugin.models.gate import GateConfig
from leco_plugin.occupancy import Occupancy
from leco_plugin.shrink.evidence import Evidence, loss, query_in_parts, unlikely_at
from leco_plugin.shrink.ladder import ladder, name_of, values_of
from leco_plugin.shrink.rungs import Bounds, Found, Ground, Rung
from leco_plugin.shrink.teaching import Lesson, round_weights, teach
from leco_plugin.shrink.verifying import price_of, verify, worst

STEPS, LONGER, NEARLY = 1200, 3, 3.0
"""Of teaching; how many times as many a gate gets that nearly holds, and what that means: a loss of
so many times what the search allows."""
EMPHASIS, WEIGHT_AT_FULL = 8.0, 0.05
"""How much dearer a candidate is that carries rendering weight, and from which weight on fully."""
MARGIN = 0.5
"""Share of the allowed loss that a gate may use on the rays of the search, so that others hold."""
VOLUME_POINTS = 1 << 17
TAUGHT_POINTS = 1 << 18
VOLUMES = (1.0, 1.05)
"""Kept volumes that are tried, as shares of the original's."""


def search(
    ground: Ground,
    bounds: Bounds,
    gates: Sequence[GateConfig] | None = None,
    on_rung: Callable[[Rung], None] | None = None,
    on_progress: Callable[[float], None] | None = None,
) -> Found:
    """Walks up the ladder and stops at the first gate whose price, on unseen rays, is in bounds.

    Args:
        gates: by size; those smaller than the original by default.
        on_rung: called with each gate that was tried.
        on_progress: called with the share of the ladder that is done.
    """
    gates = ladder(values_of(ground.original.gate.config)) if gates is None else gates
    volume = _places_to_count(ground.original)
    kept = query_in_parts(ground.original, volume) >= ground.original.threshold
    lesson = lesson_of(ground.original, ground.taught)
    rungs: list[Rung] = []
    looks = 0
    show = on_progress or (lambda share: None)
    for number, config in enumerate(gates):
        started = time.monotonic()
        parts = [(number + done) / len(gates) for done in (0.0, 1.0 / (1 + LONGER), 1.0)]
        for times, part in zip((1, LONGER), pairwise(parts)):
            gate = _taught(config, lesson, times * STEPS, ground.original, part_of(show, *part))
            rung = _measured(ground, gate, bounds, volume, kept, looks + 1)
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


def part_of(show: Callable[[float], None], first: float, last: float) -> Callable[[float], None]:
    """Shows the progress of a part that goes from `first` to `last` of all."""
    return lambda share: show(first + share * (last - first))


def _taught(
    config: GateConfig,
    lesson: Lesson,
    steps: int,
    original: Occupancy,
    on_progress: Callable[[float], None],
) -> Occupancy:
    """A gate in the original's place, without a threshold of its own yet."""
    gate = round_weights(teach(config, lesson, steps, original.precision, on_progress=on_progress))
    smaller = Occupancy(gate, original.space, 0.5, original.precision, walls=original.walls)
    return smaller.to(original.threshold_value.device).eval()


def lesson_of(original: Occupancy, taught: Evidence) -> Lesson:
    """The original's decisions on candidates of rays, and as many places anywhere in its box."""
    anywhere = _volume(original, TAUGHT_POINTS, seed=6)
    decided = query_in_parts(original, anywhere) >= original.threshold
    kept = torch.cat([taught.kept, decided]).float()
    full = (taught.weights / WEIGHT_AT_FULL).clamp(max=1.0)
    emphasis = torch.cat([full, torch.zeros_like(decided, dtype=full.dtype)])
    mapped = original.space.map(torch.cat([taught.positions, anywhere])).clamp(-1.0, 1.0)
    return Lesson(mapped, kept * (1.0 + EMPHASIS * emphasis), 1.0 - kept)


def _measured(
    ground: Ground, smaller: Occupancy, bounds: Bounds, volume: Tensor, kept: Tensor, look: int
) -> Rung:
    """Gives the gate the threshold that suits it; what was found.

    Args:
        look: at the rays that verify, the how many-th it would be.
    """
    scores = [
        query_in_parts(smaller, reference.search.evidence.positions)
        for reference in ground.references
    ]
    of_volume = query_in_parts(smaller, volume)
    losses: list[float] = []
    holds, ratio = False, 0.0
    for share in VOLUMES:
        threshold = threshold_keeping(of_volume, share * float(kept.double().mean()))
        beyond = [
            loss(reference.search.evidence, found < threshold, unlikely_at(look))
            for reference, found in zip(ground.references, scores)
        ]
        losses = [each.lost_before + one.share for each, one in zip(ground.references, beyond)]
        ratio = float((of_volume >= threshold).double().mean() / kept.double().mean())
        # what is not within the bounds here needs no look at the rays that verify
        holds = all(
            lost <= MARGIN * bounds.lost_surface_mass + (1.0 - MARGIN) * reference.lost_before
            and reference.lost_before + one.bound <= bounds.lost_surface_mass
            for reference, lost, one in zip(ground.references, losses, beyond)
        )
        if holds:
            break
    smaller.threshold_value.fill_(threshold)
    config = smaller.gate.config
    params = values_of(config)
    rung = Rung(name_of(config), params, 2 * params, round(ratio, 4), max(losses), None, "", 0.0)
    if not holds:
        rung.verdict = "loses too much"
        return rung
    if ratio > VOLUMES[-1] + 0.005:
        rung.verdict = "keeps too much"
        return rung
    rung.image_price_db = worst(
        [price_of(ground, each, each.search, smaller) for each in ground.references]
    )
    if (rung.image_price_db or 0.0) > bounds.image_price_db:
        rung.verdict = "costs too much of the image"
        return rung
    holds = verify(ground, smaller, bounds, rung, look)
    rung.verdict = "chosen" if holds else "fails on unseen rays"
    return rung


def threshold_keeping(scores: Tensor, share: float) -> float:
    """The threshold at which a share of places, with scores [M], is kept."""
    ordered = scores.double().sort(descending=True).values
    return float(ordered[min(max(round(share * len(ordered)) - 1, 0), len(ordered) - 1)])


def kept_of_box(occupancy: Occupancy) -> float:
    """Share of an occupancy's box, or of a contracted cube, that it keeps."""
    kept = query_in_parts(occupancy, _places_to_count(occupancy)) >= occupancy.threshold
    return float(kept.double().mean())


def _places_to_count(occupancy: Occupancy) -> Tensor:
    return _volume(occupancy, VOLUME_POINTS, seed=5)


def _volume(occupancy: Occupancy, count: int, seed: int) -> Tensor:
    """Positions [count, 3] spread evenly over the occupancy's box, or over a contracted cube."""
    unit = torch.rand(count, 3, generator=torch.Generator().manual_seed(seed))
    device = occupancy.threshold_value.device
    if occupancy.space.kind == "contraction":
        return occupancy.space.unmap(2.0 * unit.to(device) - 1.0)
    box = whole_box(occupancy)
    return torch.lerp(box.low, box.high, unit).to(device)
