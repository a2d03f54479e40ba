"""How a guided host begins: opaque, and at a lower threshold."""

from __future__ import annotations

import math
from collections.abc import Callable

from torch import Tensor, nn

from leco_plugin.hosts.guide import Guide
from leco_plugin.hosts.stand_ins import GuidedEstimator
from leco_plugin.learning.calibration import THRESHOLDS
from leco_plugin.log import note
from leco_plugin.models.compute.ranks import from_first
from leco_plugin.occupancy import Occupancy

OPACITY = 0.9
"""Of half of the rays, what is kept hides at least so much at first."""
SCALE = "average_init_density"
"""nerfstudio's name for the density with which a field begins."""


def begin_opaque(host: nn.Module, guide: Guide, kept_lengths: Tensor) -> None:
    """Raises the density with which a packed host's field begins, where its kept stretches need it.

    Args:
        host: before its first step; one that has no such density to set stays as it is.
        guide: remembers the density for checkpoints.
        kept_lengths: [R] kept of each ray, scene units of the host; those of 0 are left out.
    """
    scales = [float(getattr(module, SCALE)) for module in _scaled(host)]
    if not scales:
        return
    lengths = kept_lengths[kept_lengths > 0.0]
    length = from_first(lambda: float(lengths.median()) if len(lengths) else 0.0, lengths.device)
    if length == 0.0 or (wanted := -math.log(1.0 - OPACITY) / length) <= min(scales):
        return
    guide.first_density = wanted
    set_first_density(host, guide)
    note(
        f"the host begins with a density of {wanted:.3g} instead of {min(scales):.3g}, with which "
        f"the {length:.3g} scene units that are kept of a ray are opaque"
    )


def set_first_density(host: nn.Module, guide: Guide) -> None:
    """Gives the host's fields what a guide has found or has read from a checkpoint."""
    for module in _scaled(host):
        if guide.first_density is not None:
            setattr(module, SCALE, max(guide.first_density, float(getattr(module, SCALE))))


def _scaled(host: nn.Module) -> list[nn.Module]:
    """What has that density to set in a host whose samples are packed: its fields, or itself."""
    if not any(isinstance(module, GuidedEstimator) for module in host.modules()):
        return []
    return [module for module in host.modules() if hasattr(module, SCALE)]


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
    note(
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
