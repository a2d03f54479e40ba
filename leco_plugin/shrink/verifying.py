"""What a gate may declare: measured on rays that the search did not see, one look after the other.

Each look may accept a gate by chance, so that the later ones are allowed less of it.
"""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from leco_plugin.occupancy import Occupancy
from leco_plugin.shrink.evidence import Loss, image_price, loss, query_in_parts, unlikely_at
from leco_plugin.shrink.references import Part, Reference
from leco_plugin.shrink.rungs import Bounds, Ground, Rung


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
        searched, unseen = (
            loss(part.evidence, _skipped(smaller, part), unlikely) for part in parts
        )
        before = reference.lost_before
        found.append(
            Loss(
                before + unseen.share,
                before + max(searched.bound, unseen.bound),
                reference.mass_before + unseen.lost_mass,
            )
        )
        prices += [price_of(reference, part, smaller) for part in parts]
    first = ground.references[0].verify
    kept, skipped = first.evidence.kept, _skipped(smaller, first)
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
    price = rung.verified["image_price_db"] or 0.0
    return (
        max(one.bound for one in found) <= bounds.lost_surface_mass
        and price <= bounds.image_price_db
    )


def _skipped(smaller: Occupancy, part: Part) -> Tensor:
    return query_in_parts(smaller, part.evidence.positions) < smaller.threshold


def price_of(reference: Reference, part: Part, smaller: Occupancy) -> float | None:
    """The image price of skipping what a gate skips, dB; None where nothing is rendered."""
    if reference.model is None or not part.rendered:
        return None
    return reference.price_before + image_price(reference.model, part.rendered, smaller)


def worst(values: Sequence[float | None]) -> float | None:
    """The largest of what was measured; None where nothing was."""
    return max((value for value in values if value is not None), default=None)
