"""From intervals along rays to pixels: gate, field and volume rendering of packed samples."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from leco_plugin.models.compute.dispatch import select_rows
from leco_plugin.models.compute.learned import Colors
from leco_plugin.models.field import ColorHead, HMoEField
from leco_plugin.models.gate import EMPTY, Gate, route
from leco_plugin.samplers.base import midpoints
from leco_plugin.samplers.packed import accumulate_along_rays, pack_info, render_weight_from_density
from leco_plugin.space import Space

VISIBLE = 1e-4
"""Samples whose rendering weight is below this are not coloured: each changes a pixel by a fortieth
of a step of an 8-bit image at most, a ray that is nothing but such haze by a few steps."""


OPAQUE = 1e6
"""Density, per half extent, that is added to the backdrop."""

MET = 0.5
"""Accumulation from which a ray meets something, as nerfstudio's exporter has it. Below it there is
haze, whose distance is nobody's."""


class Rays(NamedTuple):
    """A batch of rays."""

    origins: Tensor
    """[R, 3] scene units."""
    directions: Tensor
    """[R, 3] unit vectors."""
    t_mins: Tensor
    """[R] where each ray begins, scene units."""
    t_maxs: Tensor
    """[R] where each ray ends."""
    images: Tensor | None
    """[R] int64 of the training image whose appearance is shown, or None for those nearby."""
    cut_off: Tensor | None = None
    """[R] bool, rays without a backdrop, behind which the background shows; None is no ray."""


class Intervals(NamedTuple):
    """Packed intervals, sorted by ray and distance."""

    ray_indices: Tensor
    """[M] int64."""
    t_starts: Tensor
    """[M] scene units."""
    t_ends: Tensor
    """[M] scene units."""


class Shaded(NamedTuple):
    """What the field says about packed intervals, and the pixels it gives."""

    rgb: Tensor
    """[R, 3] without background."""
    accumulation: Tensor
    """[R], that of a backdrop included where `weights` include it."""
    depth: Tensor
    """[R] expected distance, scene units; the end of the ray where it meets nothing."""
    weights: Tensor
    """[M] rendering weights; what is shown and exported leaves those of backdrops out."""
    sigmas: Tensor
    """[M] densities per half extent."""
    logits: Tensor
    """[M, 1 + n] of the gate."""
    routes: Tensor
    """[M] int64, the expert of each sample."""
    packed_info: Tensor
    """[R, 2] start and count of each ray."""


class Routing(NamedTuple):
    """How samples are sent to experts."""

    empty_below: float | None
    """See `gate.route`; None is the paper's rule, and scales features by G_i* as the paper does."""
    homogeneous: bool
    """No empty-space expert at all: the gate chooses among the scene experts."""


class Scene(NamedTuple):
    """Whom to ask at a place, and how."""

    field: HMoEField
    gate: Gate
    space: Space
    """How positions are mapped for both."""
    routing: Routing
    kept: bool = False
    """Whether a frozen gate has let all through that is asked about, and the only scene expert has
    it: then nobody asks the gate again."""


def gate_values_and_routes(
    logits: Tensor, routing: Routing, remaining: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """The factor of each sample's features [M] float32, and its expert [M] int64.

    Points of a scene expert that was dropped go to the best of those that are left, with the factor
    that they had; which points are empty, and all other points, stay as they are.

    Args:
        logits: [M, 1 + n].
        remaining: bool [n], scene experts that were not dropped; None is all of them.
    """
    gate_values, routes = _values_and_routes(logits, routing)
    if remaining is not None:
        scene = logits[:, 1:]
        best = scene.masked_fill(~remaining[: scene.shape[-1]], -torch.inf).argmax(dim=-1) + 1
        routes = torch.where(routes == EMPTY, EMPTY, best)
    return gate_values, routes


def _values_and_routes(logits: Tensor, routing: Routing) -> tuple[Tensor, Tensor]:
    """`gate_values_and_routes` while all scene experts remain.

    The paper's factor is G_i*(x), which jumps where a sample changes experts. With `empty_below`
    the factor is 1, with the gradient of log(share of the scene expert) (straight-through), so that
    a changed route changes the image little. In a homogeneous mixture the factor is that share.
    """
    if routing.empty_below is None and not routing.homogeneous:
        routes = route(logits, None)
        return logits.softmax(dim=-1).gather(1, routes[:, None])[:, 0], routes
    if not logits.requires_grad and not routing.homogeneous:  # one, or NaN where a logit is
        return 1.0 + 0.0 * logits.sum(dim=-1), route(logits, routing.empty_below)
    scene = logits[:, 1:]
    best = scene.argmax(dim=-1)
    share = scene.softmax(dim=-1).gather(1, best[:, None])[:, 0]
    if routing.homogeneous:
        return share, best + 1
    routes = route(logits, routing.empty_below)
    on_scene = (routes > 0).to(share.dtype)
    return 1.0 + on_scene * (share / share.detach() - 1.0), routes


def with_backdrop(
    intervals: Intervals, rays: Rays, step_size: float, cone_angle: float
) -> Intervals:
    """Ends each ray in an opaque interval, its backdrop, whatever a gate thinks of the place.

    What is not explained on the way is then explained there, behind everything, and surfaces grow
    in front of it where views disagree about it; rays that could stay transparent would be filled
    with fog from the front. Sky and whatever lies beyond the bounds is the backdrop's to keep.

    Args:
        intervals: [M] packed; those whose middle lies in the backdrop give way to it.
        step_size, cone_angle: of the march, which give the backdrop's length.
    Returns:
        [M' + R] packed.
    """
    num_rays = len(rays.origins)
    starts = backdrop_starts(rays, step_size, cone_angle)
    middles = 0.5 * (intervals.t_starts + intervals.t_ends)
    inside = (middles < starts.index_select(0, intervals.ray_indices)).nonzero()[:, 0]
    ray_indices, t_starts, t_ends = (part.index_select(0, inside) for part in intervals)
    # every ray gets one more sample, so a sample moves back by the number of rays before it
    slots = torch.arange(len(inside), device=inside.device) + ray_indices
    numbers = torch.arange(num_rays, device=inside.device)
    last_slots = torch.searchsorted(ray_indices, numbers, right=True) + numbers
    merged = []
    pairs = (ray_indices, numbers), (t_starts, starts), (t_ends, rays.t_maxs)
    for of_samples, of_rays in pairs:
        together = of_samples.new_empty(len(inside) + num_rays)
        together[slots], together[last_slots] = of_samples, of_rays.to(of_samples.dtype)
        merged.append(together)
    return Intervals(*merged)


def backdrop_starts(rays: Rays, step_size: float, cone_angle: float) -> Tensor:
    """Where the backdrop of each ray begins [R]: the march's last step before the ray's end.

    The backdrop of a ray that is cut off has no length.
    """
    starts = rays.t_maxs - (rays.t_maxs * cone_angle).clamp(min=step_size)
    if rays.cut_off is None:
        return starts
    return torch.where(rays.cut_off, rays.t_maxs, starts.maximum(rays.t_mins))


def backdrop_of(intervals: Intervals, rays: Rays) -> Tensor:
    """Which intervals [M] are backdrops; rays that are cut off or have no length have none."""
    return intervals.t_ends >= backdrop_ends(rays).index_select(0, intervals.ray_indices)


def backdrop_ends(rays: Rays) -> Tensor:
    """Where the backdrop of each ray ends [R]; infinity where it has none."""
    without = rays.t_maxs <= rays.t_mins
    without = without if rays.cut_off is None else without | rays.cut_off
    return rays.t_maxs.masked_fill(without, torch.inf)


def mapped_middles(space: Space, rays: Rays, intervals: Intervals) -> Tensor:
    """Middles of packed intervals as gate and field take them: [M, 3] in [-1, 1]."""
    return space.map(midpoints(intervals, rays.origins, rays.directions)).clamp(-1.0, 1.0)


def shade(scene: Scene, rays: Rays, intervals: Intervals, freeze_gate: bool) -> Shaded:
    """Renders packed intervals; only visible samples are coloured. With `freeze_gate` no gradient
    reaches the gate."""
    answers = ask(scene, rays, intervals, freeze_gate)
    return render(scene.field.color, answers, rays, intervals, scene.space.half_extent)


class Answers(NamedTuple):
    """What gate and field say of M points."""

    sigmas: Tensor
    """[M] densities per half extent."""
    features: Tensor
    """[M, width] of which colour is made."""
    logits: Tensor
    """[M, 1 + n] of the gate, [M, 0] where it was not asked; Switch-NeRF's has no empty-space
    expert."""
    routes: Tensor
    """[M] int64, the expert of each point."""


def ask(scene: Scene, rays: Rays, intervals: Intervals, freeze_gate: bool) -> Answers:
    """Asks gate and field at the middles of intervals; arguments as for `shade`."""
    return ask_at(scene, mapped_middles(scene.space, rays, intervals), freeze_gate)


def ask_at(scene: Scene, mapped: Tensor, freeze_gate: bool) -> Answers:
    """Asks gate and field at mapped positions [M, 3] in [-1, 1]; `freeze_gate` as for `shade`."""
    if scene.kept:
        logits, gate_values = mapped.new_empty(len(mapped), 0), mapped.new_ones(len(mapped))
        routes = torch.ones_like(gate_values, dtype=torch.int64)
    else:
        with torch.set_grad_enabled(torch.is_grad_enabled() and not freeze_gate):
            logits = scene.gate(mapped)
            remaining = scene.field.experts.remaining_experts()
            gate_values, routes = gate_values_and_routes(logits, scene.routing, remaining)
    sigmas, features = scene.field.density(mapped, routes, gate_values)
    return Answers(sigmas, features, logits, routes)


def render(
    color: ColorHead,
    answers: Answers,
    rays: Rays,
    intervals: Intervals,
    half_extent: Tensor,
    meets_backdrop: bool = True,
) -> Shaded:
    """Pixels from what was said of packed intervals.

    Args:
        half_extent: scalar, scene units.
        meets_backdrop: False has a backdrop give its colour only, and count as nothing met.
    """
    sigmas, features, logits, routes = answers
    is_backdrop = backdrop_of(intervals, rays)
    weights, packed_info = weigh(sigmas, is_backdrop, intervals, half_extent, len(rays.origins))
    rgb = composite(color, features, weights, rays, intervals)
    if not meets_backdrop:
        weights = weights.masked_fill(is_backdrop, 0.0)
    accumulation, depth = sum_up(weights, rays, intervals)
    return Shaded(rgb, accumulation, depth, weights, sigmas, logits, routes, packed_info)


def weigh(
    sigmas: Tensor, is_backdrop: Tensor, intervals: Intervals, half_extent: Tensor, num_rays: int
) -> tuple[Tensor, Tensor]:
    """Rendering weights of packed intervals [M] and where each ray has them [R, 2].

    Args:
        sigmas: [M] per half extent.
        is_backdrop: bool [M], which intervals are opaque whatever their density is.
        half_extent: scalar, scene units.
    """
    packed_info = pack_info(intervals.ray_indices, num_rays)
    # for the weights only: what the field says of the place stays the field's
    absorbing = torch.where(is_backdrop, sigmas + OPAQUE, sigmas)
    edges = intervals.t_starts / half_extent, intervals.t_ends / half_extent
    weights, _, _ = render_weight_from_density(*edges, absorbing, packed_info=packed_info)
    return weights, packed_info


def composite(
    color: ColorHead, features: Tensor, weights: Tensor, rays: Rays, intervals: Intervals
) -> Tensor:
    """Colours of rays [R, 3], without background; only visible samples are coloured."""
    visible = (weights.detach() > VISIBLE).nonzero()[:, 0]
    if isinstance(color, ColorHead) and color.suits_native(features, weights):
        of_rays = color.hidden_of_rays(rays.directions, rays.images, rays.origins)
        given = features, weights, intervals.ray_indices, visible, of_rays
        rgb: Tensor = Colors.apply(*given, *color.native_parts())
        return rgb
    rays_seen = intervals.ray_indices.index_select(0, visible)
    colors = color(
        select_rows(features, visible), rays_seen, rays.directions, rays.images, rays.origins
    )
    return accumulate_along_rays(
        select_rows(weights, visible), colors, rays_seen, len(rays.origins)
    )


def sum_up(weights: Tensor, rays: Rays, intervals: Intervals) -> tuple[Tensor, Tensor]:
    """Accumulation and expected depth of rays, both [R]; one that meets nothing has its end.

    Depth is that of what is met, so that a leaf half transparent is not moved towards the sky.
    """
    middles = 0.5 * (intervals.t_starts + intervals.t_ends)
    values = torch.stack([torch.ones_like(middles), middles], dim=-1)
    sums = accumulate_along_rays(weights, values, intervals.ray_indices, len(rays.origins))
    accumulation, distance = sums[:, 0], sums[:, 1]
    return accumulation, mean_distance(accumulation, distance, rays)


def mean_distance(accumulation: Tensor, distance: Tensor, rays: Rays) -> Tensor:
    """Expected depth [R] from sums of weights and of weighted distances, both [R]."""
    return torch.where(accumulation >= MET, distance / accumulation.clamp(min=MET), rays.t_maxs)
