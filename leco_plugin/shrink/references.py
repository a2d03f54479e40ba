"""The fields that say what a dropped candidate was worth.

What a smaller gate declares holds against each of them, along rays of held-out pixels and rays from
between the cameras, which nobody has photographed; no two of all these share a pixel:
- the field at the moment of freezing, every candidate rendered: the gate's loss, absolutely;
- the run's field as it is now, rendered as the original guides it: the loss beyond the original's.
Without a run, the original's own decisions stand in, along rays of held-out and training pixels.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from leco_plugin.models.leco import LecoModel
from leco_plugin.occupancy import Occupancy
from leco_plugin.shrink.evidence import Evidence, Rendered, gather, join, loss, query_in_parts
from leco_plugin.shrink.sources import Seen, Source, from_between_cameras, of_other_pixels

NOW = "the run's field as it is now, beyond what the original declares"
AT_FREEZING = "the field at the moment of freezing, all of it"
BY_DECISIONS = "the original's keep decisions, weighed by o(x): no rendering weights were at hand"
DECLARED = ("lost_surface_mass", "lost_mass", "image_price_db")
"""What a report says of the original's own losses."""
LOST_DECISIONS = "lost_decisions"
"""In the report of a gate that was shrunk without a field: what it drops of the keep
decisions of the first original, weighed by o(x). What it loses of the surface mass is not known."""


RAYS = 1 << 15
"""On each side: what is lost lies on few rays, so that many have to be looked at, and held-out
pixels are few. Of n rays of equal worth the first look declares no loss below 5.3 / n, the tenth
none below 9.3 / n."""


class Part(NamedTuple):
    """Some rays, as a reference sees them."""

    evidence: Evidence
    rendered: Sequence[Rendered] = ()
    """Empty where no image price can be measured."""


class Reference(NamedTuple):
    """A field with rays to search on, and others to verify on."""

    name: str
    model: LecoModel | None
    lost_before: float
    """Share of the surface mass, or without a field of the decisions, that the original has lost
    before anything is measured here."""
    mass_before: float
    """The same of all rendering weight."""
    price_before: float
    """The same of the image price, dB."""
    search: Part
    verify: Part
    guided: bool = True
    """Rendered as the original guides it, which itself loses nothing there."""


def references(
    source: Source, original: Occupancy, searched: Seen, verified: Seen
) -> list[Reference]:
    """All there are; what the original declares comes first where only the rest is measured."""
    sides = searched, verified
    more = _more_rays(source, original, sides)
    if source.model is None:
        search, verify = (
            Part(join([gather(source, original, seen)[0] for seen in each]))
            for each in zip(sides, more)
        )
        dropped = max(declared(original, LOST_DECISIONS), 0.0)
        return [Reference(BY_DECISIONS, None, dropped, 0.0, 0.0, search, verify)]
    # that the original gains something is no licence to lose it
    lost, mass, price = (max(declared(original, name), 0.0) for name in DECLARED)
    moved = [from_between_cameras(source, seen, seed=side) for side, seen in enumerate(more)]
    search, verify = (_rendered(source, original, *each) for each in zip(sides, moved))
    found = [Reference(NOW, source.model, lost, mass, price, search, verify)]
    if source.frozen is not None:
        before = source._replace(model=source.frozen)
        search, verify = (_rendered(before, None, *each) for each in zip(sides, moved))
        found.append(
            Reference(AT_FREEZING, source.frozen, 0.0, 0.0, 0.0, search, verify, guided=False)
        )
    return found


def shares_lost(
    source: Source, original: Occupancy, smaller: Occupancy, seen: Seen
) -> dict[str, float]:
    """What a smaller gate loses on some rays by each reference: a share of the surface mass, or of
    the decisions where there is no field.

    Of the original itself only what is measured: beyond itself it loses nothing.
    """

    def share(part: Source, guiding: Occupancy | None) -> float:
        evidence, _ = gather(part, guiding, seen)
        skipped = query_in_parts(smaller, evidence.positions) < smaller.threshold
        return loss(evidence, skipped).share

    found: dict[str, float] = {}
    if smaller is not original:
        alone = source.model is None
        before = declared(original, LOST_DECISIONS if alone else "lost_surface_mass")
        found[BY_DECISIONS if alone else NOW] = max(before, 0.0) + share(source, original)
    if source.frozen is not None:
        found[AT_FREEZING] = share(source._replace(model=source.frozen), None)
    return found


def _more_rays(source: Source, original: Occupancy, sides: Sequence[Seen]) -> list[Seen]:
    """Of each side, rays of as many training pixels as are missing to `RAYS`."""
    found: list[Seen] = []
    for seen in sides:
        missing = max(1, RAYS - len(seen.truth))
        found.append(of_other_pixels(source, original, missing, [*sides, *found]))
    return found


def _rendered(source: Source, occupancy: Occupancy | None, seen: Seen, moved: Seen) -> Part:
    """Held-out pixels with their renderings, and rays from between the cameras without."""
    evidence, rendered = gather(source, occupancy, seen)
    return Part(join([evidence, gather(source, occupancy, moved)[0]]), rendered)


def declared(original: Occupancy, name: str) -> float:
    """A figure of an occupancy's report; 0 where it has none."""
    value = original.report.get(name)
    return float(value) if isinstance(value, int | float) else 0.0


def names_of(found: Iterable[Reference]) -> str:
    """What the loss was measured against, in a line."""
    return "; ".join(reference.name for reference in found)
