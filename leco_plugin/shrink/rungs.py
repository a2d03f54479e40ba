"""What a search is about and what it finds: bounds, rays, and the gates that were tried."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple

from leco_plugin.occupancy import Occupancy
from leco_plugin.shrink.evidence import Evidence
from leco_plugin.shrink.references import Reference


@dataclass(frozen=True)
class Bounds:
    """What the smaller occupancy may declare in all, the original's share included; without a field
    it is the lost decisions that the first one bounds."""

    lost_surface_mass: float = 1e-3
    image_price_db: float = 0.05


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
    """Of the original: what it loses on other rays than those of the search, at the most."""
    look: int | None = None
    """At the rays that verify, the how many-th of this search; None where it came to none."""

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)


class Ground(NamedTuple):
    """What gates are taught and measured on."""

    original: Occupancy
    taught: Evidence
    references: Sequence[Reference]


class Found(NamedTuple):
    """The outcome: None is that nothing smaller holds."""

    occupancy: Occupancy | None
    rungs: list[Rung]
