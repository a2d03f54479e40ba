"""The fields that say what a dropped candidate was worth.

What a smaller gate declares holds against each of them, along rays of held-out pixels and rays from
between the cameras, which nobody has photographed; no two of all these share a pixel:
- the field at the moment of freezing, every candidate rendered: the gate's loss, absolutely;
- the run's field as it is now, rendered as the original guides it: the loss beyond the original's,
  which is added.
Without a run, the original's own decisions stand in, along rays of held-out and training pixels.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from leco_plugin.models.leco import LecoModel
from leco_plugin.occupancy import Occupancy
from leco_plugin.shrink.evidence import Evidence, Rendered, gather, join, loss, skipped_by
from leco_plugin.shrink.sources import Seen, Source, from_between_cameras, of_other_pixels

NOW = "the run's field as it is now, beyond what the original loses"
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


class Side(NamedTuple):
    """Rays on one side of a search: to search on, or to verify on."""

    held_out: Seen
    """With an image price where there is a field."""
    others: Seen
    """As many as are missing to `RAYS`: of other training pixels, where there is a field from
    between the cameras, and without an image price."""


def sides_of(source: Source, original: Occupancy, held_out: Sequence[Seen]) -> list[Side]:
    """Fills up rays of held-out pixels; no two of all these share a pixel."""
    more: list[Seen] = []
    for seen in held_out:
        missing = max(1, RAYS - len(seen.truth))
        more.append(of_other_pixels(source, original, missing, [*held_out, *more]))
    if source.model is not None:
        more = [from_between_cameras(source, seen, seed=side) for side, seen in enumerate(more)]
    return [Side(*each) for each in zip(held_out, more)]


def references(source: Source, original: Occupancy, sides: Sequence[Side]) -> list[Reference]:
    """All there are. Where only the rest is measured, what the original loses is added: what the
    field at freezing says of it, or without that what it declares.

    Args:
        sides: to search on, and to verify on.
    """
    if source.model is None:
        search, verify = (
            Part(join([gather(source, original, seen)[0] for seen in side])) for side in sides
        )
        dropped = max(declared(original, LOST_DECISIONS), 0.0)
        return [Reference(BY_DECISIONS, None, dropped, 0.0, 0.0, search, verify)]
    # that the original gains something is no licence to lose it
    lost, mass, price = (max(declared(original, name), 0.0) for name in DECLARED)
    search, verify = (_rendered(source, original, side) for side in sides)
    now = Reference(NOW, source.model, lost, mass, price, search, verify)
    if source.frozen is None:
        return [now]
    before = source._replace(model=source.frozen)
    search, verify = (_rendered(before, None, side) for side in sides)
    frozen = Reference(AT_FREEZING, source.frozen, 0.0, 0.0, 0.0, search, verify, guided=False)
    # on more rays than those of its calibration, and at the threshold that it has here
    return [now._replace(lost_before=_lost_by(original, search.evidence)), frozen]


def _lost_by(occupancy: Occupancy, evidence: Evidence) -> float:
    """The share of the surface mass that an occupancy skips."""
    return loss(evidence, skipped_by(occupancy, evidence)).share


def shares_lost(
    source: Source, original: Occupancy, smaller: Occupancy, seen: Seen
) -> dict[str, float]:
    """What a smaller gate loses on some rays by each reference: a share of the surface mass, or of
    the decisions where there is no field.

    Of the original itself only what is measured: beyond itself it loses nothing.
    """
    alone, found = source.model is None, dict[str, float]()
    before = max(declared(original, LOST_DECISIONS if alone else "lost_surface_mass"), 0.0)
    if source.frozen is not None:
        evidence, _ = gather(source._replace(model=source.frozen), None, seen)
        before = _lost_by(original, evidence)
        found[AT_FREEZING] = _lost_by(smaller, evidence)
    if smaller is not original:
        evidence, _ = gather(source, original, seen)
        found[BY_DECISIONS if alone else NOW] = before + _lost_by(smaller, evidence)
    return found


def _rendered(source: Source, occupancy: Occupancy | None, side: Side) -> Part:
    """Held-out pixels with their renderings, and rays from between the cameras without."""
    evidence, rendered = gather(source, occupancy, side.held_out)
    return Part(join([evidence, gather(source, occupancy, side.others)[0]]), rendered)


def declared(original: Occupancy, name: str) -> float:
    """A figure of an occupancy's report; 0 where it has none."""
    value = original.report.get(name)
    return float(value) if isinstance(value, int | float) else 0.0


def names_of(found: Iterable[Reference]) -> str:
    """What the loss was measured against, in a line."""
    return "; ".join(reference.name for reference in found)
