"""An original that loses more than the search allows, at the threshold at which it does not.

Calibration allows a loss in the mean of some thousand rays of held-out pixels; what is declared has
to hold on others, between the cameras too. A smaller gate is taught the original's decisions and
loses more than those do, so that an original which itself loses too much is asked to keep more.
"""

from __future__ import annotations

from leco_plugin.learning.calibration import THRESHOLDS
from leco_plugin.occupancy import Occupancy
from leco_plugin.shrink.evidence import loss, query_in_parts, unlikely_at
from leco_plugin.shrink.rungs import Bounds, Ground
from leco_plugin.shrink.search import MARGIN, kept_of_box
from leco_plugin.shrink.verifying import price_of, within, worst


def lowered(ground: Ground, bounds: Bounds) -> Occupancy | None:
    """The original at the largest lower threshold that meets what is asked of a smaller gate.

    Measured on the rays of the search, by the references that measure the original itself.

    Returns:
        It shares the original's gate; None where the original meets that as it is, no threshold
        does, or nothing measures.
    """
    original = ground.original
    absolute = [reference for reference in ground.references if not reference.guided]
    scores = [query_in_parts(original, each.search.evidence.positions) for each in absolute]

    def meets(there: Occupancy) -> bool:
        losses = [
            loss(each.search.evidence, found < there.threshold, unlikely_at(1))
            for each, found in zip(absolute, scores)
        ]
        share, bound = max(one.share for one in losses), max(one.bound for one in losses)
        if share > MARGIN * bounds.lost_surface_mass or not within(bounds, bound, None):
            return False  # before anything is rendered
        prices = [price_of(ground, each, each.search, there) for each in absolute]
        return within(bounds, bound, worst(prices))

    if not absolute or meets(original):
        return None
    lower = (original.with_threshold(t) for t in THRESHOLDS if t < original.threshold)
    return next(filter(meets, lower), None)


def facts_of(original: Occupancy, lower: Occupancy) -> dict[str, float]:
    """How much lower a threshold is, and how much more of the box is kept: JSON values."""
    return {
        "from": original.threshold,
        "to": lower.threshold,
        "kept_volume": round(kept_of_box(lower) / max(kept_of_box(original), 1e-12), 4),
    }
