"""Rendering that evaluates no samples behind opaque surfaces.

The kept samples of each ray are evaluated from the front, a few at a time. A ray stops when no
light is left. The slow twin is `rendering.shade`, which evaluates all of them.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from leco_plugin.models.field import HMoEField
from leco_plugin.models.gate import Gate
from leco_plugin.models.rendering import (
    Answers,
    Intervals,
    Rays,
    Routing,
    Shaded,
    ask,
    render,
)
from leco_plugin.samplers.packed import pack_info
from leco_plugin.space import Space

LEAST_LIGHT = 1e-4
"""Transmittance below which a ray is given up: what lies behind changes a pixel by less than a
thirtieth of a step of an 8-bit image."""

FEWEST_AT_ONCE, MOST_LOOKS = 8, 16
"""Samples of a ray between two looks at its transmittance, and looks at the longest ray."""

MANY_RAYS = 2048
"""In a batch from which on a CPU is no slower for looking; see `docs/decisions.md`."""


def is_no_slower(num_rays: int, guided: bool, device: torch.device) -> bool:
    """Whether shading from the front was measured to take no longer than shading everything.

    Args:
        num_rays: in the batch.
        guided: whether only what an occupancy keeps is shaded.
        device: of the model.
    """
    return guided and device.type == "cpu" and num_rays >= MANY_RAYS


@torch.no_grad()
def shade_front_to_back(
    field: HMoEField,
    gate: Gate,
    space: Space,
    rays: Rays,
    intervals: Intervals,
    routing: Routing,
) -> tuple[Shaded, Intervals]:
    """Renders packed intervals; arguments as for `rendering.shade`, without gradients.

    Returns:
        The rendering, and the intervals that were asked about, to which it belongs.
    """
    starts, counts = pack_info(intervals.ray_indices, len(rays.origins)).unbind(dim=-1)
    longest = int(counts.max()) if len(counts) else 0
    at_once = max(FEWEST_AT_ONCE, -(-longest // MOST_LOOKS))
    opaque = -math.log(LEAST_LIGHT)
    depths = torch.zeros_like(rays.t_mins)
    alive = torch.arange(len(counts), device=counts.device)
    asked: list[Tensor] = []
    heard: list[Answers] = []
    for first in range(0, max(longest, 1), at_once):
        going_on = (counts[alive] > first) & (depths[alive] <= opaque)
        alive = alive[going_on]
        part = samples_of(
            starts[alive] + first, (counts[alive] - first).clamp(max=at_once), at_once
        )
        some = Intervals(*(values.index_select(0, part) for values in intervals))
        answers = ask(field, gate, space, rays, some, routing, freeze_gate=True)
        lengths = (some.t_ends - some.t_starts) / space.half_extent
        depths.index_add_(0, some.ray_indices, (answers.sigmas * lengths).to(depths.dtype))
        asked.append(part)
        heard.append(answers)
    together, order = torch.cat(asked).sort()
    answers = Answers(*(torch.cat(values).index_select(0, order) for values in zip(*heard)))
    seen = Intervals(*(values.index_select(0, together) for values in intervals))
    return render(field, space, rays, seen, answers), seen


def samples_of(starts: Tensor, counts: Tensor, most: int) -> Tensor:
    """Numbers of the packed samples of some rays: starts [R] and counts [R] to [M] int64.

    Args:
        most: no count is larger.
    """
    steps = torch.arange(most, device=starts.device)
    return (starts[:, None] + steps)[steps < counts[:, None]]
