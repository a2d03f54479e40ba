"""What a search is about and what it finds: bounds, rays, and the gates that were tried."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple

from leco_plugin.occupancy import Occupancy
from leco_plugin.shrink.evidence import Evidence
from leco_plugin.shrink.references import LOST_DECISIONS, Reference, declared


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


def check_room(original: Occupancy, bounds: Bounds) -> None:
    """Whether anything is left to lose after what the original declares.

    Raises:
        ValueError: nothing is, or a bound is out of range.
    """
    if not 0.0 <= bounds.lost_surface_mass < 1.0 or not math.isfinite(bounds.image_price_db):
        raise ValueError(
            "bounds are a lost surface mass from 0 to 1 and a number of dB, not "
            f"{bounds.lost_surface_mass} and {bounds.image_price_db}"
        )
    lost, decisions, price = (
        max(declared(original, name), 0.0)
        for name in ("lost_surface_mass", LOST_DECISIONS, "image_price_db")
    )
    if decisions >= bounds.lost_surface_mass:
        raise ValueError(
            f"the occupancy itself has lost {decisions:.2e} of the decisions, which leaves nothing "
            f"of {bounds.lost_surface_mass:.2e}: raise --lost-surface-mass, or shrink its original"
        )
    if lost >= bounds.lost_surface_mass:
        raise ValueError(
            f"the occupancy itself declares a lost surface mass of {lost:.2e}, which leaves "
            f"nothing of {bounds.lost_surface_mass:.2e}: raise --lost-surface-mass"
        )
    if price >= bounds.image_price_db:
        raise ValueError(
            f"the occupancy itself declares an image price of {price:.3f} dB, which leaves nothing "
            f"of {bounds.image_price_db:.3f} dB: raise --image-price"
        )
