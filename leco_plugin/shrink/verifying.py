"""What a gate may declare: measured on rays that the search did not see, one look after the other.

Each look may accept a gate by chance, so that the later ones are allowed less of it.
"""

from __future__ import annotations

from collections.abc import Sequence

from leco_plugin.occupancy import Occupancy
from leco_plugin.shrink.evidence import Loss, image_price, loss, skipped_by, unlikely_at
from leco_plugin.shrink.references import Part, Reference
from leco_plugin.shrink.rungs import Bounds, Ground, Rung

HOLDS = "holds"
"""Verdict of an original that is within the bounds."""


def verify(ground: Ground, smaller: Occupancy, bounds: Bounds, rung: Rung, look: int) -> bool:
    """Whether the bounds hold on rays that the search did not see; measures what to declare.

    What the rays of the search have lost counts as well, where it is more: most of a loss lies on
    few rays, and they may all be among those.

    Args:
        rung: gets what was measured.
        look: the how many-th at these rays, from 1 on.
    """
    unlikely = unlikely_at(look)
    found: list[Loss] = []
    prices: list[float | None] = []
    for reference in ground.references:
        parts = reference.search, reference.verify
        searched, unseen = (_loss(ground, reference, part, smaller, unlikely) for part in parts)
        found.append(unseen._replace(bound=max(searched.bound, unseen.bound)))
        prices += [price_of(ground, reference, part, smaller) for part in parts]
    first = ground.references[0].verify
    kept, skipped = first.evidence.kept, skipped_by(smaller, first.evidence)
    rung.look = look
    rung.verified = {
        "lost_surface_mass": max(one.share for one in found),
        "lost_surface_mass_bound": max(one.bound for one in found),
        "lost_mass": max(one.lost_mass for one in found),
        "image_price_db": worst(prices),
        "empty_fraction": float(skipped.double().mean()),
        "kept_candidates_dropped": float((skipped & kept).sum() / kept.sum().clamp(min=1)),
    }
    rung.verified_against = [
        {"reference": reference.name, "lost_surface_mass": one.share, "bound": one.bound}
        for reference, one in zip(ground.references, found)
    ]
    return within(bounds, max(one.bound for one in found), rung.verified["image_price_db"])


def of_original(ground: Ground, bounds: Bounds) -> Rung:
    """The original by its own bar, on the rays of the search; nothing is taught.

    A smaller gate is taught its decisions, so that what that gate loses comes on top.
    """
    parts = [(reference, reference.search) for reference in ground.references]
    found = [_loss(ground, *each, ground.original, unlikely_at(1)) for each in parts]
    price = worst([price_of(ground, *each, ground.original) for each in parts])
    bound, params = max(one.bound for one in found), ground.original.num_params
    verdict = HOLDS
    if not within(bounds, bound, None):
        verdict = "is not within the bounds"
    elif not within(bounds, bound, price):
        verdict = "costs more of the image than the bounds allow"
    lost = max(one.share for one in found)
    return Rung(
        "the original", params, 2 * params, 1.0, lost, price, verdict, seconds=0.0, bound=bound
    )


def is_measured(ground: Ground) -> bool:
    """Whether a reference measures the original itself."""
    return not all(reference.guided for reference in ground.references)


def within(bounds: Bounds, bound: float, price: float | None) -> bool:
    """Whether a loss, as it would be declared, and an image price are allowed."""
    return bound <= bounds.lost_surface_mass and (price or 0.0) <= bounds.image_price_db


def _loss(
    ground: Ground, reference: Reference, part: Part, gate: Occupancy, unlikely: float
) -> Loss:
    """What a gate loses in all; of the original, exactly what it declares where it guides."""
    beyond = Loss(0.0, 0.0, 0.0)
    if gate is not ground.original or not reference.guided:
        beyond = loss(part.evidence, skipped_by(gate, part.evidence), unlikely)
    return Loss(
        reference.lost_before + beyond.share,
        reference.lost_before + beyond.bound,
        reference.mass_before + beyond.lost_mass,
    )


def price_of(ground: Ground, reference: Reference, part: Part, gate: Occupancy) -> float | None:
    """The image price of skipping what a gate skips, dB; None where nothing is rendered."""
    if reference.model is None or not part.rendered:
        return None
    if gate is ground.original and reference.guided:
        return reference.price_before
    return reference.price_before + image_price(reference.model, part.rendered, gate)


def worst(values: Sequence[float | None]) -> float | None:
    """The largest of what was measured; None where nothing was."""
    return max((value for value in values if value is not None), default=None)
