"""A guided host begins by skipping less, until skipping has shown its price in the host itself.

A calibrated threshold keeps its price in the field that the gate was learned with. In haze, which
that field explains by few places, another host that may not look elsewhere from its first step on
never finds a better explanation. So a packed host begins with a lower threshold; after the first
measurement (`host_watch`) it follows the calibrated one, unless that costs too much.
"""

from __future__ import annotations

from torch import nn

from leco_plugin.models.calibration import THRESHOLDS
from leco_plugin.models.guide import Guide
from leco_plugin.models.ranks import say
from leco_plugin.models.stand_ins import GuidedEstimator

CAREFUL = 1.0 / 16.0
"""Share of the calibrated threshold that a host begins with, where that is a threshold at all."""
PROMISED = "promised"
"""In `Guide.watched`, while it lasts: the calibrated threshold."""


def begin_carefully(host: nn.Module, guide: Guide) -> bool:
    """Lowers the threshold for the beginning, in a packed host; returns whether it has."""
    packed = any(isinstance(module, GuidedEstimator) for module in host.modules())
    calibrated = guide.the_occupancy().threshold
    lower = max(CAREFUL * calibrated, THRESHOLDS[-1])
    if not packed or calibrated < 1.1 * lower:
        return False
    guide.watched[PROMISED] = calibrated
    follow(guide, lower)
    return True


def end_probation(guide: Guide, step: int) -> None:
    """Has a host stay with the calibrated threshold, which it follows now."""
    calibrated = guide.watched.pop(PROMISED)
    say(f"step {step}: skipping costs this host what it may; its threshold is {calibrated:.4f} now")


def follow(guide: Guide, threshold: float) -> None:
    """Has the host skip what is below this threshold."""
    guide.the_occupancy().threshold_value.fill_(threshold)
    guide.changed()
