"""Rendering that evaluates no samples behind opaque surfaces, and few before them.

The kept samples of each ray are evaluated from the front, a few at a time: every second one first,
and one between two others where either is not faint. A ray stops when no light is left. The slow
twin is `rendering.shade`, which evaluates all of them. On a CPU all of it is one routine in C,
`compute/front_to_back.c`, where that knows gate and field.
"""

from __future__ import annotations

import math

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

LEAST_LIGHT = 1.0 / 256.0
"""Transmittance below which a ray is given up: what lies behind changes a pixel by less than a step
of an 8-bit image."""
FAINT = 3e-4
"""Opacity below which a sample says nothing about the one beside it."""

FEWEST_AT_ONCE, MOST_LOOKS = 8, 16
"""In torch, samples of a ray between two looks at its transmittance, and looks at the longest."""
AT_ONCE_IN_C = 2
"""The same samples in C, where a look costs less. Even, as the others: see `asked_first`."""


MANY_RAYS = 2048
"""In a batch from which on a CPU torch is no slower for looking; see `docs/decisions.md`."""


def is_no_slower(scene: Scene, rays: Rays, intervals: Intervals, guided: bool) -> bool:
    """Whether `shade_front_to_back` was measured to take no longer than shading all: in C, and in
    torch for many rays on a CPU of which only what an occupancy keeps is shaded (`guided`)."""
    many = rays.origins.device.type == "cpu" and len(rays.origins) >= MANY_RAYS
    return (guided and many) or suits_native(scene, rays, intervals)


@torch.no_grad()
def shade_front_to_back(scene: Scene, rays: Rays, intervals: Intervals) -> tuple[Shaded, Intervals]:
    """As `rendering.shade`, without gradients, and the intervals that were asked about, to which
    the rendering belongs."""
    native = suits_native(scene, rays, intervals)
    return (shade_natively if native else shade_in_torch)(scene, rays, intervals)


@torch.no_grad()
def shade_in_torch(scene: Scene, rays: Rays, intervals: Intervals) -> tuple[Shaded, Intervals]:
    """`shade_front_to_back` on any device."""
    starts, counts = pack_info(intervals.ray_indices, len(rays.origins)).unbind(dim=-1)
    longest = int(counts.max()) if len(counts) else 0
    at_once = 2 * max(FEWEST_AT_ONCE // 2, -(-longest // (2 * MOST_LOOKS)))
    opaque = -math.log(LEAST_LIGHT)
    depths = torch.zeros_like(rays.t_mins)
    alive = torch.arange(len(counts), device=counts.device)
    first = asked_first(intervals, starts)
    lit = torch.zeros_like(first)
    asked: list[Tensor] = []
    parts: list[Answers] = []

    def ask_about(part: Tensor) -> None:
        if parts and not len(part):
            return
        some = Intervals(*(values.index_select(0, part) for values in intervals))
        answers = ask(scene, rays, some, freeze_gate=True)
        lengths = (some.t_ends - some.t_starts) / scene.space.half_extent
        absorbed = (answers.sigmas * lengths).to(depths.dtype)
        depths.index_add_(0, some.ray_indices, absorbed)
        lit[part] = ~(-(-absorbed).expm1() < FAINT)
        asked.append(part)
        parts.append(answers)

    for begin in range(0, max(longest, 1), at_once):
        going_on = (counts[alive] > begin) & (depths[alive] <= opaque)
        alive = alive[going_on]
        left = (counts[alive] - begin).clamp(max=at_once)
        part = samples_of(starts[alive] + begin, left, at_once)
        ask_about(part[first[part]])
        between = part[~first[part]]
        ask_about(between[lit[between - 1] | lit[between + 1]])
    together, order = torch.cat(asked).sort()
    answers = Answers(*(torch.cat(values).index_select(0, order) for values in zip(*parts)))
    seen = Intervals(*(values.index_select(0, together) for values in intervals))
    return render(scene.field.color, answers, rays, seen, scene.space.half_extent), seen


def asked_first(intervals: Intervals, starts: Tensor) -> Tensor:
    """Which samples [M] of packed intervals are asked whatever those beside them say: every second
    one of a ray, and both ends of each stretch without a gap. `starts` [R] has the first of each
    ray. An even number of samples, from the first, ends with such a one."""
    rays, t_starts, t_ends = intervals
    gaps = t_starts[1:] - t_ends[:-1] > 0.5 * (t_ends - t_starts)[:-1]
    edges = torch.ones(len(rays) + 1, dtype=torch.bool, device=rays.device)
    edges[1:-1] = gaps | (rays[1:] != rays[:-1])
    odd = (torch.arange(len(rays), device=rays.device) - starts[rays]) % 2 == 1
    return odd | edges[:-1] | edges[1:]


def samples_of(starts: Tensor, counts: Tensor, most: int) -> Tensor:
    """Numbers of the packed samples of some rays: starts [R] and counts [R], up to `most`, to [M]
    int64."""
    steps = torch.arange(most, device=starts.device)
    return (starts[:, None] + steps)[steps < counts[:, None]]


def suits_native(scene: Scene, rays: Rays, intervals: Intervals) -> bool:
    """Whether `front_to_back.c` serves."""
    field, gate, _, routing, _ = scene
    by_threshold = routing.empty_below is not None and not routing.homogeneous
    known = (
        by_threshold
        and len(rays.origins) > 0
        and isinstance(field.encoding, HashEncoding)
        and field.suits_native()
        and not (torch.is_grad_enabled() and gate.head.weight.requires_grad)
    )
    if not known:
        return False
    assert isinstance(field.encoding, HashEncoding)
    parts = field.encoding.table, *field.native_parts(), *field.color.layer_parts()
    # C is in float32, whatever torch's products have: it is faster than torch in bfloat16
    with torch.autocast("cpu", enabled=False):
        known = gate.suits_native(rays.origins)
        return known and native.suits_networks([*rays[:4], *intervals[1:]], parts)


@torch.no_grad()
def shade_natively(scene: Scene, rays: Rays, intervals: Intervals) -> tuple[Shaded, Intervals]:
    """`shade_front_to_back` in C; `evaluation/queries.py` counts what it asks."""
    color = scene.field.color
    ray_indices, t_starts, t_ends = intervals
    count = len(rays.origins)
    starts, counts = pack_info(ray_indices, count).T.contiguous()
    with torch.autocast("cpu", enabled=False):
        of_rays = color.hidden_of_rays(rays.directions, rays.images, rays.origins).contiguous()
        asked_of = in_c(scene)
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
    }
    asked = native.call_along_rays(
        "front_to_back",
        starts,
        asked_of,
        {
            "origins": rays.origins.contiguous(),
            "directions": rays.directions.contiguous(),
            "of_rays": of_rays,
            "ends": backdrop_ends(rays).contiguous(),
            "starts": starts,
            "counts": counts,
            "given_starts": t_starts.contiguous(),
            "given_ends": t_ends.contiguous(),
            "first": asked_first(intervals, starts),
            **totals,
            **samples,
            "least_light": LEAST_LIGHT,
            "visible": VISIBLE,
            "opaque": OPAQUE,
            "faint": FAINT,
            "at_once": AT_ONCE_IN_C,
        },
    )
    of = {name: torch.cat([values[part] for part in asked]) for name, values in samples.items()}
    seen = Intervals(of.pop("ray_indices"), of.pop("t_starts"), of.pop("t_ends"))
    ends = totals["asked"].cumsum(0)
    packed_info = torch.stack([ends - totals["asked"], totals["asked"]], dim=-1)
    accumulation = totals["accumulation"]
    depth = mean_distance(accumulation, totals["distance"], rays)
    of["logits"] = depth.new_empty(len(of["weights"]), 0)  # of pictures nobody asks for them
    return Shaded(totals["rgb"], accumulation, depth, **of, packed_info=packed_info), seen


def in_c(scene: Scene) -> native.Values:
    """As `front_to_back.c: Scene` has it."""
    field, gate, space, routing, kept = scene
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
        "outputs": 0 if kept else gate.head.out_features,
        "levels": levels,
        "log2": native.log2_of(rows // levels),
        "features": features,
        "width": field.config.experts.width,
        "layers": field.config.experts.layers,
        "units": field.config.color_width,
        "unbounded": int(space.unbounded),
    }
