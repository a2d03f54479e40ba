"""What is shown of rays beside their colours: what they meet, and which expert answers there.

A backdrop gives a ray its colour and counts as nothing met, so that sky is transparent to whoever
asks for opacities, and no export makes points of it.
"""

from __future__ import annotations

import warnings

import torch
from nerfstudio.model_components.renderers import RGBRenderer
from torch import Tensor

from leco_plugin.models.gate import EMPTY, occupancy_from_logits
from leco_plugin.models.rendering import MET, Intervals, Rays, Shaded, backdrop_of, sum_up
from leco_plugin.samplers.packed import accumulate_along_rays

NONE = -1
"""Stands for the expert of a ray that meets nothing."""


def over_background(shaded: Shaded, rays: Rays) -> Tensor:
    """Colours [R, 3] over nerfstudio's background where rays are cut off: black, or a crop's."""
    if rays.cut_off is None:
        return shaded.rgb
    color = RGBRenderer.get_background_color("black", shaded.rgb.shape, shaded.rgb.device)
    through = (1.0 - shaded.accumulation).clamp(min=0.0) * rays.cut_off
    return shaded.rgb + through[:, None] * color


@torch.no_grad()
def before_the_backdrop(
    shaded: Shaded, intervals: Intervals, rays: Rays
) -> tuple[Shaded, dict[str, Tensor]]:
    """A rendering with weights, accumulation and depth of what lies before the backdrop alone.

    Returns:
        That rendering, and its `depth` and `accumulation`, [R, 1] each. A ray with an accumulation
        below `MET` meets nothing, and has depth `t_maxs`, scene units.
    """
    met = shaded.weights.detach().masked_fill(backdrop_of(intervals, rays), 0.0)
    accumulation, depth = sum_up(met, rays, intervals)
    shown = {"depth": depth[:, None], "accumulation": accumulation[:, None]}
    return shaded._replace(weights=met, accumulation=accumulation, depth=depth), shown


@torch.no_grad()
def gate_pictures(met: Shaded, ray_indices: Tensor) -> dict[str, Tensor]:
    """What the gate did along each ray, for the viewer: each [R, 1] float32.

    `occupancy` is o(x), averaged with the rendering weights; `expert` the number of the one with
    the greatest weight, 0 for the empty-space expert; both are 0 where nothing is met.
    `samples_per_ray` is a float because nerfstudio cannot show integers.

    Args:
        met: without the weight of backdrops.
        ray_indices: [M] int64.
    """
    occupancies = occupancy_from_logits(met.logits)[:, None]
    seen = accumulate_along_rays(met.weights, occupancies, ray_indices, len(met.rgb))
    expert = leading_expert(met, ray_indices, met.logits.shape[-1])
    met_something = met.accumulation[:, None] >= MET
    return {
        "occupancy": (seen / met.accumulation.clamp(min=MET)[:, None]).where(met_something, 0.0),
        "expert": expert.clamp(min=EMPTY).float(),
        "samples_per_ray": met.packed_info[:, 1:].float(),
    }


@torch.no_grad()
def leading_expert(met: Shaded, ray_indices: Tensor, experts: int) -> Tensor:
    """The expert in [0, experts) with the greatest weight along each ray: [R, 1] int64, or `NONE`.

    Args:
        met: without the weight of backdrops.
        ray_indices: [M] int64.
        experts: of which `routes` are numbers.
    """
    sums = met.weights.new_zeros(len(met.rgb) * experts)
    sums.index_add_(0, ray_indices * experts + met.routes, met.weights)
    expert = sums.view(-1, experts).argmax(dim=-1, keepdim=True)
    return expert.where(met.accumulation[:, None] >= MET, NONE)


def with_alpha(outputs: dict[str, Tensor], output_name: str) -> Tensor:
    """A colour picture with what was met before the backdrop as its alpha, [..., 4].

    Warns where nothing is met at all, for nerfstudio's exporter goes on until it has met enough.

    Args:
        output_name: of the picture, `rgb` somewhere in it.
    """
    accumulation = outputs[output_name.replace("rgb", "accumulation")]
    if not bool((accumulation >= MET).any()):
        warnings.warn(
            "none of these rays meets anything but the backdrop: an export finds no points there, "
            "and waits for ever if that is so everywhere, as in a run of a few steps",
            stacklevel=3,
        )
    return torch.cat([outputs[output_name], accumulation], dim=-1)
