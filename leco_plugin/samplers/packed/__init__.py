"""Samples that lie ragged in one flat tensor: sums along rays and volume rendering of them.

Names and argument order are nerfacc's; everything is plain torch and runs on any device.
"""

from leco_plugin.samplers.packed.accumulate import accumulate_along_rays
from leco_plugin.samplers.packed.rendering import (
    render_transmittance_from_alpha,
    render_transmittance_from_density,
    render_visibility_from_alpha,
    render_visibility_from_density,
    render_weight_from_alpha,
    render_weight_from_density,
)
from leco_plugin.samplers.packed.scan import (
    exclusive_prod,
    exclusive_sum,
    inclusive_prod,
    inclusive_sum,
    pack_info,
)

__all__ = [
    "accumulate_along_rays",
    "exclusive_prod",
    "exclusive_sum",
    "inclusive_prod",
    "inclusive_sum",
    "pack_info",
    "render_transmittance_from_alpha",
    "render_transmittance_from_density",
    "render_visibility_from_alpha",
    "render_visibility_from_density",
    "render_weight_from_alpha",
    "render_weight_from_density",
]
