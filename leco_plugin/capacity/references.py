"""The fields that say what a dropped candidate was worth, and what a gate loses by them.

What a smaller gate declares holds against each of them, along rays of held-out pixels and of places
between the cameras, which no photograph shows. No two of these rays share a pixel.
- The field at the moment of freezing, with every candidate rendered, gives the whole loss.
- The run's field of now, guided by the original, gives the loss beyond the original's own. The two
  are added.
Without a run, the original's decisions stand in, along rays of held-out and training pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from torch import Tensor

from leco_plugin.capacity.evidence import (
    Evidence,
    Loss,
    Rendered,
    find_skipped,
    gather,
    image_price,
    join,
    loss,
    unlikely_at,
    worst,
)
from leco_plugin.capacity.sources import Seen, Source, draw_other_pixels, move_between_cameras
from leco_plugin.evaluation.inspection import in_parts
from leco_plugin.models.mixture import Mixture
from leco_plugin.occupancy import Occupancy

NOW = "the run's field as it is now, beyond what the original loses"
AT_FREEZING = "the field at the moment of freezing, all of it"
BY_DECISIONS = "the original's keep decisions, weighed by o(x): no rendering weights were at hand"
DECLARED = ("lost_surface_mass", "lost_mass", "image_price_db")
"""What a report says of the original's own losses."""
LOST_DECISIONS = "lost_decisions"
"""In the report of a gate shrunk without a field: the share of the first original's keep decisions
that it drops, weighed by o(x). The surface mass that it loses is not known."""
RAYS = 1 << 15
"""On each side. Losses lie on few rays, and held-out pixels are few: of n rays of equal worth the
first look declares no loss below 5.3 / n, the tenth none below 9.3 / n."""
HOLDS = "holds"
"""Verdict on an original that is within the bounds."""


class Part(NamedTuple):
    """Some rays, as a reference sees them."""

    evidence: Evidence
    rendered: Sequence[Rendered] = ()
    """Empty where no image price can be measured."""


class Reference(NamedTuple):
    """A field with rays to search on, and others to verify on."""

    name: str
    mixture: Mixture | None
    lost_before: float
    """Share of the surface mass that the original has lost before anything is measured here;
    without a field, of the decisions."""
    mass_before: float
    """The same of all rendering weight."""
    price_before: float
    """The same of the image price, dB."""
    search: Part
    verify: Part
    guided: bool = True
    """Whether the original guides the rendering, and so loses nothing more in it."""


class Ground(NamedTuple):
    """What gates are taught and measured on."""

    original: Occupancy
    taught: Evidence
    references: Sequence[Reference]

    @property
    def measures_original(self) -> bool:
        """Whether a reference measures the original itself."""
        return not all(reference.guided for reference in self.references)

    def scores(self, gate: Occupancy, side: str) -> list[Tensor | None]:
        """o(x) of a gate at the candidates [M] of each reference, on its side `search` or `verify`;
        None where it is the original and guides: it loses exactly what it declares."""
        return [
            None
            if gate is self.original and one.guided
            else in_parts(gate.query, getattr(one, side).evidence.positions)
            for one in self.references
        ]

    def losses(
        self,
        gate: Occupancy,
        side: str,
        unlikely: float,
        scores: Sequence[Tensor | None] | None = None,
    ) -> list[Loss]:
        """What a gate loses in all, by each reference; the bounds may be wrong as often as is
        `unlikely`. `scores` are those of the gate, where they are known."""
        found = []
        for one, score in zip(self.references, scores or self.scores(gate, side)):
            share = bound = mass = 0.0
            if score is not None:
                evidence = getattr(one, side).evidence
                share, bound, mass = loss(evidence, score < gate.threshold, unlikely)
            lost = one.lost_before
            found.append(Loss(lost + share, lost + bound, one.mass_before + mass))
        return found

    def price(self, gate: Occupancy, side: str) -> float | None:
        """The worst image price of a gate by any reference, dB; None where nothing is rendered."""
        prices = []
        for one in self.references:
            part: Part = getattr(one, side)
            if one.mixture is None or not part.rendered:
                continue
            guides = gate is self.original and one.guided
            beyond = 0.0 if guides else image_price(one.mixture, part.rendered, gate)
            prices.append(one.price_before + beyond)
        return max(prices, default=None)


@dataclass(frozen=True)
class Bounds:
    """The most that the smaller occupancy may declare, the original's share included."""

    lost_surface_mass: float = 1e-3
    """Without a field, of the decisions."""
    image_price_db: float = 0.05

    def allow(self, bound: float, price: float | None) -> bool:
        """Whether a loss, as it would be declared, and an image price are within them."""
        return bound <= self.lost_surface_mass and (price or 0.0) <= self.image_price_db


@dataclass
class Rung:
    """One gate that was tried. Losses are the worst of any reference, the original's included;
    without a field they are of its decisions."""

    name: str
    params: int
    bytes: int
    """Of its weights in bfloat16."""
    kept_volume: float
    """Share of the original's."""
    lost_surface_mass: float
    image_price_db: float | None
    verdict: str
    seconds: float
    verified: dict[str, float | None] = field(default_factory=dict)
    verified_against: list[dict[str, str | float]] = field(default_factory=list)
    """The share that each reference has lost on rays of its own, and its bound."""
    bound: float | None = None
    """Of the original: the most that it loses on other rays than those of the search."""
    look: int | None = None
    """Number of the look at the verifying rays, from 1 on; None where it came to none."""


def pair_sides(
    source: Source, original: Occupancy, held_out: Sequence[Seen]
) -> list[tuple[Seen, Seen]]:
    """Rays of held-out pixels, each with as many others as are missing to `RAYS`.

    The others are of further training pixels. Where there is a field they are moved between the
    cameras, and have no image price. No two of all these share a pixel.
    """
    more: list[Seen] = []
    for seen in held_out:
        missing = max(1, RAYS - len(seen.truth))
        more.append(draw_other_pixels(source, original, missing, [*held_out, *more]))
    if source.mixture is not None:
        more = [move_between_cameras(source, seen, seed=side) for side, seen in enumerate(more)]
    return list(zip(held_out, more))


def find_references(
    source: Source, original: Occupancy, sides: Sequence[tuple[Seen, Seen]]
) -> list[Reference]:
    """All references that there are, with rays to search on and to verify on."""

    def parts(mixture: Mixture | None, occupancy: Occupancy | None) -> tuple[Part, Part]:
        found = []
        for held_out, others in sides:
            evidence, rendered = gather(mixture, occupancy, held_out)
            found.append(Part(join([evidence, gather(mixture, occupancy, others)[0]]), rendered))
        return found[0], found[1]

    if source.mixture is None:
        dropped = declared(original, LOST_DECISIONS)
        return [Reference(BY_DECISIONS, None, dropped, 0.0, 0.0, *parts(None, original))]
    lost, mass, price = (declared(original, name) for name in DECLARED)
    now = Reference(NOW, source.mixture, lost, mass, price, *parts(source.mixture, original))
    if source.frozen is None:
        return [now]
    unguided = *parts(source.frozen, None), False
    frozen = Reference(AT_FREEZING, source.frozen, 0.0, 0.0, 0.0, *unguided)
    # measured on more rays than the calibration had, and at the threshold of now
    return [now._replace(lost_before=_share_lost(original, frozen.search.evidence)), frozen]


def measure_shares_lost(
    source: Source, original: Occupancy, smaller: Occupancy, seen: Seen
) -> dict[str, float]:
    """What a smaller gate loses on some rays by each reference: a share of the surface mass, or of
    the decisions where there is no field. Of the original itself, only what is measured."""
    alone, found = source.mixture is None, dict[str, float]()
    before = declared(original, LOST_DECISIONS if alone else "lost_surface_mass")
    if source.frozen is not None:
        evidence, _ = gather(source.frozen, None, seen)
        before = _share_lost(original, evidence)
        found[AT_FREEZING] = _share_lost(smaller, evidence)
    if smaller is not original:
        evidence, _ = gather(source.mixture, original, seen)
        found[BY_DECISIONS if alone else NOW] = before + _share_lost(smaller, evidence)
    return found


def _share_lost(occupancy: Occupancy, evidence: Evidence) -> float:
    return loss(evidence, find_skipped(occupancy, evidence)).share


def declared(original: Occupancy, name: str) -> float:
    """A loss that an occupancy's report names; 0 where it names none or a gain, which is no licence
    to lose it again."""
    value = original.report.get(name)
    return max(float(value), 0.0) if isinstance(value, int | float) else 0.0


def verify(ground: Ground, smaller: Occupancy, bounds: Bounds, rung: Rung, look: int) -> bool:
    """Whether the bounds hold on rays that the search did not see.

    The rung gets what is to be declared. Losses on the rays of the search count where they are
    larger: most of a loss lies on few rays, which may all be among those. Each look at these rays,
    by its number from 1 on, may accept a gate by chance, so that later ones are allowed less.
    """
    unlikely = unlikely_at(look)
    searched = ground.losses(smaller, "search", unlikely)
    found = ground.losses(smaller, "verify", unlikely)
    bound_of = [max(one.bound, other.bound) for one, other in zip(searched, found)]
    prices = [ground.price(smaller, side) for side in ("search", "verify")]
    price = max((value for value in prices if value is not None), default=None)
    first = ground.references[0].verify.evidence
    skipped = find_skipped(smaller, first)
    rung.look = look
    rung.verified = {
        "lost_surface_mass": max(one.share for one in found),
        "lost_surface_mass_bound": max(bound_of),
        "lost_mass": max(one.lost_mass for one in found),
        "image_price_db": price,
        "empty_fraction": float(skipped.double().mean()),
        "kept_candidates_dropped": float(
            (skipped & first.kept).sum() / first.kept.sum().clamp(min=1)
        ),
    }
    rung.verified_against = [
        {"reference": reference.name, "lost_surface_mass": one.share, "bound": bound}
        for reference, one, bound in zip(ground.references, found, bound_of)
    ]
    return bounds.allow(max(bound_of), price)


def measure_original(ground: Ground, bounds: Bounds) -> Rung:
    """The original by the bar of smaller gates, on the rays of the search; nothing is taught."""
    lost = worst(ground.losses(ground.original, "search", unlikely_at(1)))
    price, params = ground.price(ground.original, "search"), ground.original.num_params
    verdict = HOLDS
    if not bounds.allow(lost.bound, None):
        verdict = "is not within the bounds"
    elif not bounds.allow(lost.bound, price):
        verdict = "costs more of the image than the bounds allow"
    sizes = params, 2 * params, 1.0
    return Rung("the original", *sizes, lost.share, price, verdict, 0.0, bound=lost.bound)
