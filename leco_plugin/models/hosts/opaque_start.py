"""A guided host begins opaque: what the occupancy keeps of a ray hides its background.

A field begins with one density everywhere, chosen for rays that are sampled from end to end. Of
such a ray an occupancy keeps a short stretch, and the same density leaves that transparent. Before
a random background, whose mean is grey, colours then go to black faster than densities rise, and
stay there: a sigmoid that far out has no gradient.
"""

from __future__ import annotations

import math

from torch import Tensor, nn

from leco_plugin.log import say
from leco_plugin.models.compute.ranks import from_first
from leco_plugin.models.hosts.guide import Guide
from leco_plugin.models.hosts.stand_ins import GuidedEstimator

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
    say(
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
