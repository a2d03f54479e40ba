"""The fields that say what a dropped candidate was worth, each on rays of its own.

What a smaller gate declares holds against every one of them:
- the field at the moment of freezing, every candidate rendered: the gate's loss, absolutely;
- the same along rays from between the cameras, which nobody has photographed;
- the run's field as it is now, rendered as the original guides it: the loss beyond the original's.
Without a run, the original's own decisions stand in for the last one.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from leco_plugin.models.leco import LecoModel
from leco_plugin.occupancy import Occupancy
from leco_plugin.shrink.evidence import Evidence, Rendered, gather
from leco_plugin.shrink.sources import Seen, Source, from_between_cameras

NOW = "the run's field as it is now, beyond what the original declares"
AT_FREEZING = "the field at the moment of freezing, all of it"
BETWEEN = "the same from between the cameras"
BY_DECISIONS = "the original's keep decisions, weighed by o(x): no rendering weights were at hand"


DECLARED = ("lost_surface_mass", "lost_mass", "image_price_db")
"""What a report says of the original's own losses."""


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
    """Share of the surface mass that the original has lost before anything is measured here."""
    mass_before: float
    """The same of all rendering weight."""
    price_before: float
    """The same of the image price, dB."""
    search: Part
    verify: Part


def references(
    source: Source, original: Occupancy, searched: Seen, verified: Seen
) -> list[Reference]:
    """All there are; what the original declares comes first where only the rest is measured."""
    # that the original gains something is no licence to lose it
    lost, mass, price = (max(declared(original, name), 0.0) for name in DECLARED)
    name = NOW if source.model is not None else BY_DECISIONS
    sides = [Part(*gather(source, original, seen)) for seen in (searched, verified)]
    found = [Reference(name, source.model, lost, mass, price, *sides)]
    if source.frozen is None:
        return found
    at_freezing = source._replace(model=source.frozen)
    sides = [Part(*gather(at_freezing, None, seen)) for seen in (searched, verified)]
    found.append(Reference(AT_FREEZING, source.frozen, 0.0, 0.0, 0.0, *sides))
    moved = [
        from_between_cameras(at_freezing, seen, seed)
        for seed, seen in enumerate((searched, verified))
    ]
    sides = [Part(gather(at_freezing, None, seen)[0]) for seen in moved]
    found.append(Reference(BETWEEN, source.frozen, 0.0, 0.0, 0.0, *sides))
    return found


def declared(original: Occupancy, name: str) -> float:
    """A figure of an occupancy's report; 0 where it has none."""
    value = original.report.get(name)
    return float(value) if isinstance(value, int | float) else 0.0


def names_of(found: Iterable[Reference]) -> str:
    """What the loss was measured against, in a line."""
    return "; ".join(reference.name for reference in found)
