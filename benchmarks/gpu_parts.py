"""Parts of the GPU suite: correctness of the kernels, the gate against its floor, the experts."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from gpu_floor import floor_seconds, measure_ceilings, seconds
from gpu_sampling import march_answers
from gpu_scale import Scale, figure
from gpu_training import peak_of
from sampling_scene import fit_occupancy, rays_into
from torch import Tensor

from leco_plugin.models.compute import grouped as grouped_trial
from leco_plugin.models.compute.dispatch import dispatch
from leco_plugin.models.compute.grouped import grouped_dispatch
from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.gate import Gate, GateConfig
from leco_plugin.models.hmoe import Expert
from leco_plugin.models.sizing.sizes import LARGE, PAPER, SMALL
from leco_plugin.occupancy import Occupancy
from leco_plugin.samplers.estimator import LearnedOccupancyEstimator
from leco_plugin.samplers.kernels import fused
from leco_plugin.space import Space

NEAR_THRESHOLD = 2e-2
"""How far from the threshold o may lie where the fused gate decides otherwise than its twin."""
FEWEST = 1 << 16
"""Positions below which a card has too little memory for the suite."""
MOST_OTHERWISE = 5e-3
"""Share of the kept candidates of which the fused march may keep others than its twin: cells add
planes, whose own errors lie around the threshold, to the roundings of the gate."""


class Disagreement(RuntimeError):
    """A kernel answers otherwise than its torch twin."""


def random_occupancy(config: GateConfig, device: torch.device) -> Occupancy:
    """A gate that nobody taught: what it costs does not depend on what it knows."""
    torch.manual_seed(0)
    occupancy = Occupancy(Gate(config), Space("contraction"), 0.5, "bfloat16").to(device).eval()
    places = torch.randn(4096, 3, device=device)
    occupancy.threshold_value.copy_(occupancy.query(places).median())
    return occupancy


def gates() -> dict[str, GateConfig]:
    """The gates of the three sizes, and one of each further width."""
    small = SMALL.gate
    others = {f"width {width}": replace(small, width=width) for width in (16, 32, 128)}
    deep = {"octaves 12": replace(small, encoding=EncodingConfig(octaves=12))}
    return {"small": small, "large": LARGE.gate, "paper": PAPER.gate, **others, **deep}


def correctness(scale: Scale, before: dict[str, Any]) -> dict[str, Any]:
    """Decisions and intervals against the torch twins.

    Raises:
        Disagreement: they differ farther from the threshold, or more often, than is stated.
    """
    found, running = {}, {}
    for name, config in gates().items():
        occupancy = random_occupancy(config, scale.device)
        found[name] = differing = decisions_differ(occupancy, scale)
        running[f"{name} gate"] = gate_answers(occupancy, scale.device)
        if differing["farthest"] > NEAR_THRESHOLD:
            raise Disagreement(
                f"the fused gate is wrong ({name}): it differs from its torch twin at "
                f"{differing['farthest']:.3g} from the threshold, more than {NEAR_THRESHOLD}"
            )
    occupancy = fit_occupancy(str(scale.device), steps=scale.fit_steps)
    learned = LearnedOccupancyEstimator(occupancy, cache_bytes=scale.cache_bytes, tolerance=1.0)
    differing = {
        f"cone angle {angle}": intervals_differ(learned, angle, scale) for angle in (0.0, 0.01)
    }
    for name, share in differing.items():
        if share > MOST_OTHERWISE:
            raise Disagreement(
                f"the fused march is wrong ({name}): {share:.2%} of what it keeps is not what its "
                f"torch twin keeps, more than {MOST_OTHERWISE:.2%}"
            )
    running["march"] = march_answers(learned)
    return {"gates": found, "march": differing, "running": running}


def gate_answers(occupancy: Occupancy, device: torch.device) -> bool:
    """Whether the fused gate answers for an occupancy; if not, figures are those of its twin."""
    return fused.decide(occupancy, torch.zeros(1, 3, device=device)) is not None


def decisions_differ(occupancy: Occupancy, scale: Scale) -> dict[str, float]:
    """Share of positions about which kernel and twin differ, and how far off the threshold."""
    places = torch.randn(min(scale.positions, 1 << 18), 3, device=scale.device) * 2.0
    ours = occupancy.occupied(places)
    with fused.twins_only():
        differing = ours != occupancy.occupied(places)
    distances = (occupancy.query(places) - occupancy.threshold_value).abs()
    return {
        "differing": float(differing.float().mean()),
        "farthest": float((distances * differing).max()),
    }


def intervals_differ(learned: LearnedOccupancyEstimator, angle: float, scale: Scale) -> float:
    """Share of the kept intervals that only one of the march's kernel and its twin keeps."""
    rays = rays_into(learned.occupancy.space, scale.rays)
    options: dict[str, Any] = {"render_step_size": 0.01, "far_plane": 8.0, "cone_angle": angle}
    ours = numbers_of(learned.sampling(*rays, **options))
    with fused.twins_only():
        theirs = numbers_of(learned.sampling(*rays, **options))
    single = (~torch.isin(ours, theirs)).sum() + (~torch.isin(theirs, ours)).sum()
    return float(single) / max(len(theirs), 1)


def numbers_of(samples: tuple[Tensor, Tensor, Tensor]) -> Tensor:
    """One number for each interval, which a rounding of its ends leaves alone; [N] int64."""
    ray_indices, t_starts, t_ends = samples
    return (ray_indices << 32) + ((t_starts + t_ends) * 1e3).round().long()


def gate_throughput(scale: Scale, before: dict[str, Any]) -> dict[str, Any]:
    """The fused gate against its floor and against the eager twin in bf16."""
    ceilings = measure_ceilings(scale.device, scale.matrix, scale.rounds)
    figures, running = [], {}
    for name in ("small", "large", "paper"):
        config = gates()[name]
        occupancy = random_occupancy(config, scale.device)
        places = places_that_fit(occupancy, scale)
        running[f"{name} gate"] = gate_answers(occupancy, scale.device)
        ours = seconds(lambda o=occupancy, p=places: o.occupied(p), scale.device, scale.rounds)
        with fused.twins_only():
            twin = seconds(lambda o=occupancy, p=places: o.occupied(p), scale.device, scale.rounds)
        floor = floor_seconds(config, len(places), ceilings)
        title = f"{name} gate, {len(places)} positions"
        figures += [
            figure(
                f"{title}: floor / fused", floor["floor"] / ours, 0.5, False, fused=ours, **floor
            ),
            figure(f"{title}: eager twin / fused", twin / ours, 5.0, False, fused=ours, twin=twin),
        ]
    return {"ceilings": vars(ceilings), "running": running, "figures": figures}


def places_that_fit(occupancy: Occupancy, scale: Scale) -> Tensor:
    """Random positions [N, 3]; fewer where the twin, which holds kilobytes of each, finds no room.

    Raises:
        torch.cuda.OutOfMemoryError: not even for a few.
    """
    count = scale.positions
    while True:
        places = torch.randn(count, 3, device=scale.device)
        try:
            occupancy.query(places)
        except torch.cuda.OutOfMemoryError:
            if count <= FEWEST:
                raise
            count //= 2
        else:
            return places


def experts(scale: Scale, before: dict[str, Any]) -> dict[str, Any]:
    """Points through the scene experts, forward and backward: grouped, and one expert by one."""
    config, device = scale.sizes.field.experts, scale.device
    n, count = config.scene_experts, scale.batch * scale.sizes.candidates
    made = [Expert(config.width, config.layers, config.skip, config.residual) for _ in range(n)]
    scene = torch.nn.ModuleList(made).to(device)
    points = torch.randn(count, config.width, device=device).bfloat16().requires_grad_()
    routes = torch.randint(1 + n, (count,), device=device)

    def through(grouped: bool) -> None:
        if grouped:
            answers = grouped_dispatch(points, routes, made)
        else:
            with torch.autocast(device.type, dtype=torch.bfloat16):
                answers = dispatch(points, routes, [None, *made])
        torch.autograd.grad(answers.float().sum(), [points, *scene.parameters()])

    ways = {"one by one": False} | ({"grouped": True} if grouped_is_right(device) else {})
    taken, peaks = {}, {}
    for name, grouped in ways.items():
        peak = peak_of(device)
        taken[name] = seconds(lambda g=grouped: through(g), device, max(2, scale.rounds // 3))
        peaks[name] = peak()
    measured = {"seconds": taken, "peak_bytes": peaks}
    if "grouped" not in ways:
        return {**measured, "grouped is chosen": False, "figures": []}
    title = f"{n} experts of {config.layers} x {config.width}, {count} points"
    ratio = taken["one by one"] / taken["grouped"]
    figures = [figure(f"{title}: one by one / grouped", ratio, 1.0, False, **taken)]
    chosen = grouped_trial.is_grouping_faster(device, n, config.width)
    return {**measured, "grouped is chosen": chosen, "figures": figures}


def grouped_is_right(device: torch.device) -> bool:
    """Whether torch has grouped products for this device, and they are right."""
    try:
        if grouped_trial.is_right(device):
            return True
        reason = "they are wrong"
    except (AttributeError, RuntimeError) as error:  # an older torch, or a card without a kernel
        reason = next(iter(str(error).splitlines()), type(error).__name__)
    print(f"no grouped products: {reason}")
    return False
