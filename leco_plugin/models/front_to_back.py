"""Rendering that evaluates no samples behind opaque surfaces.

The kept samples of each ray are evaluated from the front, a few at a time. A ray stops when no
light is left. The slow twin is `rendering.shade`, which evaluates all of them. On a CPU all of it
is one routine in C, `compute/front_to_back.c`, where that knows gate and field.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from leco_plugin.models.compute import native
from leco_plugin.models.encodings import FRESH, FrequencyEncoding, HashEncoding
from leco_plugin.models.rendering import (
    OPAQUE,
    VISIBLE,
    Answers,
    Intervals,
    Rays,
    Scene,
    Shaded,
    ask,
    backdrop_ends,
    mean_distance,
    render,
)
from leco_plugin.samplers.packed import pack_info

LEAST_LIGHT = 1e-4
"""Transmittance below which a ray is given up: what lies behind changes a pixel by less than a
thirtieth of a step of an 8-bit image."""

FEWEST_AT_ONCE, MOST_LOOKS = 8, 16
"""In torch, samples of a ray between two looks at its transmittance, and looks at the longest."""
AT_ONCE_IN_C = 4
"""The same samples in C, where a look costs less."""


@contextmanager
def in_float32() -> Iterator[None]:
    """What C computes in, whatever torch's products have: it is faster than torch in bfloat16.

    Each call has an `autocast` of its own. It restores what it found, so that one which threads
    share would leave each thread in the precision of another.
    """
    with torch.autocast("cpu", enabled=False):
        yield


MANY_RAYS = 2048
"""In a batch from which on a CPU torch is no slower for looking; see `docs/decisions.md`."""


def is_no_slower(num_rays: int, guided: bool, device: torch.device) -> bool:
    """Whether shading a batch from the front in torch was measured to take no longer than shading
    all; `guided` is where only what an occupancy keeps is shaded."""
    return guided and device.type == "cpu" and num_rays >= MANY_RAYS


def shade_where_faster(
    scene: Scene, rays: Rays, intervals: Intervals, guided: bool
) -> tuple[Shaded, Intervals] | None:
    """`shade_front_to_back`, or None where that was not measured to take no longer."""
    if suits_native(scene, rays, intervals):
        return shade_natively(scene, rays, intervals)
    if is_no_slower(len(rays.origins), guided, rays.origins.device):
        return shade_in_torch(scene, rays, intervals)
    return None


@torch.no_grad()
def shade_front_to_back(scene: Scene, rays: Rays, intervals: Intervals) -> tuple[Shaded, Intervals]:
    """Renders packed intervals; arguments as for `rendering.shade`, without gradients.

    Returns:
        The rendering, and the intervals that were asked about, to which it belongs.
    """
    native = suits_native(scene, rays, intervals)
    return (shade_natively if native else shade_in_torch)(scene, rays, intervals)


@torch.no_grad()
def shade_in_torch(scene: Scene, rays: Rays, intervals: Intervals) -> tuple[Shaded, Intervals]:
    """`shade_front_to_back` on any device."""
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
        answers = ask(scene, rays, some, freeze_gate=True)
        lengths = (some.t_ends - some.t_starts) / scene.space.half_extent
        depths.index_add_(0, some.ray_indices, (answers.sigmas * lengths).to(depths.dtype))
        asked.append(part)
        heard.append(answers)
    together, order = torch.cat(asked).sort()
    answers = Answers(*(torch.cat(values).index_select(0, order) for values in zip(*heard)))
    seen = Intervals(*(values.index_select(0, together) for values in intervals))
    return render(scene.field.color, answers, rays, seen, scene.space.half_extent), seen


def samples_of(starts: Tensor, counts: Tensor, most: int) -> Tensor:
    """Numbers of the packed samples of some rays: starts [R] and counts [R] to [M] int64.

    Args:
        most: no count is larger.
    """
    steps = torch.arange(most, device=starts.device)
    return (starts[:, None] + steps)[steps < counts[:, None]]


@in_float32()
def suits_native(scene: Scene, rays: Rays, intervals: Intervals) -> bool:
    """Whether `front_to_back.c` serves."""
    field, gate, _, routing = scene
    by_threshold = routing.empty_below is not None and not routing.homogeneous
    known = (
        by_threshold
        and len(rays.origins) > 0
        and isinstance(field.encoding, HashEncoding)
        and field.suits_native()
        and not (torch.is_grad_enabled() and gate.head.weight.requires_grad)
    )
    if not (known and gate.suits_native(rays.origins)):
        return False
    assert isinstance(field.encoding, HashEncoding)
    parts = field.encoding.table, *field.native_parts(), *field.color.layer_parts()
    return native.suits_networks([*rays[:4], *intervals[1:]], parts)


@in_float32()
@torch.no_grad()
def shade_natively(scene: Scene, rays: Rays, intervals: Intervals) -> tuple[Shaded, Intervals]:
    """`shade_front_to_back` in C; `evaluation/queries.py` counts what it asks."""
    color = scene.field.color
    ray_indices, t_starts, t_ends = intervals
    count, outputs = len(rays.origins), scene.gate.head.out_features
    starts, counts = pack_info(ray_indices, count).T.contiguous()
    totals = {
        "rgb": rays.origins.new_zeros(count, 3),
        "accumulation": rays.origins.new_zeros(count),
        "distance": rays.origins.new_zeros(count),
        "asked": torch.zeros_like(counts),
    }
    samples = {
        "ray_indices": torch.empty_like(ray_indices),
        "routes": torch.empty_like(ray_indices),
        "t_starts": torch.empty_like(t_starts),
        "t_ends": torch.empty_like(t_starts),
        "weights": torch.empty_like(t_starts),
        "sigmas": torch.empty_like(t_starts),
        "logits": t_starts.new_empty(len(t_starts), outputs),
    }
    asked = native.call_along_rays(
        "front_to_back",
        starts,
        in_c(scene),
        {
            "origins": rays.origins.contiguous(),
            "directions": rays.directions.contiguous(),
            "of_rays": color.hidden_of_rays(
                rays.directions, rays.images, rays.origins
            ).contiguous(),
            "ends": backdrop_ends(rays).contiguous(),
            "starts": starts,
            "counts": counts,
            "given_starts": t_starts.contiguous(),
            "given_ends": t_ends.contiguous(),
            **totals,
            **samples,
            "least_light": LEAST_LIGHT,
            "visible": VISIBLE,
            "opaque": OPAQUE,
            "at_once": AT_ONCE_IN_C,
        },
    )
    of = {name: torch.cat([values[part] for part in asked]) for name, values in samples.items()}
    seen = Intervals(of.pop("ray_indices"), of.pop("t_starts"), of.pop("t_ends"))
    ends = totals["asked"].cumsum(0)
    packed_info = torch.stack([ends - totals["asked"], totals["asked"]], dim=-1)
    accumulation = totals["accumulation"]
    depth = mean_distance(accumulation, totals["distance"], rays)
    return Shaded(totals["rgb"], accumulation, depth, **of, packed_info=packed_info), seen


def in_c(scene: Scene) -> native.Values:
    """As `front_to_back.c: Scene` has it."""
    field, gate, space, routing = scene
    encoding, waves = field.encoding, gate.encoding
    assert isinstance(encoding, HashEncoding) and isinstance(waves, FrequencyEncoding)
    empty_below = routing.empty_below or 0.0
    levels = len(encoding.resolutions)
    rows, features = encoding.table.shape
    return {
        "scales": waves.scales,
        "resolutions": encoding.resolutions,
        "table": encoding.table,
        "center": space.center,
        "gate": gate.native_parts(),
        "field": field.native_parts(),
        "color": field.color.native_parts(),
        "left": field.experts.left,
        "epsilon": float(gate.norm.eps),
        "half_extent": float(space.half_extent),
        "empty_odds": empty_below / (1.0 - empty_below) if empty_below < 1.0 else math.inf,
        "octaves": len(waves.scales),
        "fresh": FRESH[torch.float32],
        "gate_layers": len(gate.hidden),
        "gate_width": gate.config.width,
        "outputs": gate.head.out_features,
        "levels": levels,
        "log2": native.log2_of(rows // levels),
        "features": features,
        "width": field.config.experts.width,
        "layers": field.config.experts.layers,
        "units": field.config.color_width,
        "unbounded": int(space.unbounded),
    }
