"""A guided host begins by skipping less, until skipping has shown its price in the host itself.

A calibrated threshold keeps its price in the field that the gate was learned with. In haze, which
that field explains by few places, another host that may not look elsewhere from its first step on
never finds a better explanation. So a packed host begins with a lower threshold; after the first
measurement (`host_watch`) it follows the calibrated one, unless that costs too much.

A host that begins with nothing skipped explains pictures by haze anywhere, and that haze then
forbids to skip. So what it follows at first skips 40% of what the calibrated threshold does.
"""

from __future__ import annotations

from collections.abc import Callable

from torch import nn

from leco_plugin.learning.calibration import THRESHOLDS
from leco_plugin.log import say
from leco_plugin.models.compute.ranks import from_first
from leco_plugin.models.hosts.guide import Guide
from leco_plugin.models.hosts.stand_ins import GuidedEstimator
from leco_plugin.occupancy import Occupancy

CAREFUL = 1.0 / 16.0
"""Share of the calibrated threshold that a host begins with, where that skips enough."""
STILL_SKIPPED = 0.4
"""Of what the calibrated threshold skips within the scene's bounds, the least share that is skipped
at first too."""
ANYTHING = 1e-30
"""A threshold that keeps all that is within the bounds."""


def begin_carefully(host: nn.Module, guide: Guide, skipped: Callable[[Occupancy], float]) -> bool:
    """Has a packed host follow a lower threshold for the beginning; returns whether it does.

    Args:
        skipped: share of what the cameras see that an occupancy skips.
    """
    if not any(isinstance(module, GuidedEstimator) for module in host.modules()):
        return False
    occupancy = guide.the_occupancy()
    lower = from_first(lambda: _first_threshold(occupancy, skipped), guide.frame.device)
    if lower is None:
        return False
    guide.watched.lower = lower
    guide.changed()
    say(
        f"the host begins at threshold {lower:.4f} instead of {occupancy.threshold:.4f}, until "
        "skipping has shown in it what it costs"
    )
    return True


def _first_threshold(occupancy: Occupancy, skipped: Callable[[Occupancy], float]) -> float | None:
    """The lower threshold to begin with; None where only the calibrated one skips enough."""
    calibrated = occupancy.threshold
    lower = max(CAREFUL * calibrated, THRESHOLDS[-1])
    if calibrated < 1.1 * lower:
        return None
    beyond = skipped(occupancy.with_threshold(ANYTHING))
    enough = beyond + STILL_SKIPPED * (skipped(occupancy) - beyond)
    while skipped(occupancy.with_threshold(lower)) < enough:
        lower *= 2.0
        if calibrated < 1.1 * lower:
            return None
    return lower


def end_probation(guide: Guide) -> float | None:
    """Has a host follow the calibrated threshold; returns the lower one, None where it has none."""
    lower, guide.watched.lower = guide.watched.lower, None
    if lower is not None:
        guide.changed()
    return lower
