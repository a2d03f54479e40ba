"""What the GPU suite measures, part by part; each returns JSON values."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from gpu_floor import floor_seconds, measure_ceilings, seconds
from sampling_scene import fit_occupancy, rays_into
from torch import Tensor

from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.field import HMoEField
from leco_plugin.models.gate import Gate, GateConfig
from leco_plugin.models.rendering import Intervals, Rays, Routing, shade
from leco_plugin.models.sizes import LARGE, PAPER, SMALL, Sizes
from leco_plugin.occupancy import Occupancy, gate_precision
from leco_plugin.samplers import fused
from leco_plugin.samplers.estimator import LearnedOccupancyEstimator
from leco_plugin.samplers.grid import DenseEstimator, OccupancyGridEstimator
from leco_plugin.space import Space

NEAR_THRESHOLD = 2e-2
"""How far from the threshold o may lie where the fused gate decides otherwise than its twin."""


@dataclass(frozen=True)
class Scale:
    """How much is measured."""

    device: torch.device
    positions: int = 1 << 22
    rays: int = 4096
    grid: int = 128
    matrix: int = 8192
    rounds: int = 30
    fit_steps: int = 300
    cache_bytes: int = 1 << 20
    sizes: Sizes = PAPER

    def dry(self) -> Scale:
        """The smallest of everything."""
        tiny = replace(SMALL, candidates=16)
        small = replace(self, positions=512, rays=32, grid=16, matrix=64, rounds=2)
        return replace(small, fit_steps=20, cache_bytes=0, sizes=tiny)


def figure(name: str, value: float, bar: float, at_most: bool, **parts: float) -> dict[str, Any]:
    """A ratio with the bar it must reach and the milliseconds behind it."""
    reached = value <= bar if at_most else value >= bar
    milliseconds = {part: round(time * 1e3, 5) for part, time in parts.items()}
    return {
        "name": name,
        "value": value,
        "bar": bar,
        "at_most": at_most,
        "reached": reached,
        "milliseconds": milliseconds,
    }


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


def correctness(scale: Scale) -> dict[str, Any]:
    """Decisions and intervals against the torch twins.

    Raises:
        RuntimeError: they differ farther from the threshold than is stated.
    """
    found = {}
    for name, config in gates().items():
        occupancy = random_occupancy(config, scale.device)
        places = torch.randn(min(scale.positions, 1 << 18), 3, device=scale.device) * 2.0
        ours = occupancy.occupied(places)
        with fused.twins_only():
            differing = ours != occupancy.occupied(places)
        distances = (occupancy.query(places) - occupancy.threshold_value).abs()[differing]
        farthest = float(distances.max()) if len(distances) else 0.0
        found[name] = {"differing": float(differing.float().mean()), "farthest": farthest}
        if farthest > NEAR_THRESHOLD:
            raise RuntimeError(f"the fused gate is wrong ({name}): {farthest} from the threshold")
    return {"gates": found, "kernels": fused.ready(scale.device)}


def gate_throughput(scale: Scale) -> dict[str, Any]:
    """The fused gate against its floor and against the eager twin in bf16."""
    ceilings = measure_ceilings(scale.device, scale.matrix, scale.rounds)
    figures = []
    for name in ("small", "large", "paper"):
        config = gates()[name]
        occupancy = random_occupancy(config, scale.device)
        places = torch.randn(scale.positions, 3, device=scale.device)
        ours = seconds(lambda o=occupancy, p=places: o.occupied(p), scale.device, scale.rounds)
        with fused.twins_only():
            twin = seconds(lambda o=occupancy, p=places: o.occupied(p), scale.device, scale.rounds)
        floor = floor_seconds(config, scale.positions, ceilings)
        title = f"{name} gate, {scale.positions} positions"
        figures += [
            figure(
                f"{title}: floor / fused", floor["floor"] / ours, 0.5, False, fused=ours, **floor
            ),
            figure(f"{title}: eager twin / fused", twin / ours, 5.0, False, fused=ours, twin=twin),
        ]
    return {"ceilings": vars(ceilings), "figures": figures}


def sampling(scale: Scale) -> dict[str, Any]:
    """Sampling rays by the gate with its cells, by its torch twin, and by grids of the same set."""
    occupancy = fit_occupancy(str(scale.device), steps=scale.fit_steps)
    learned = LearnedOccupancyEstimator(occupancy, cache_bytes=scale.cache_bytes)
    origins, directions = rays_into(occupancy.space, scale.rays)
    options: dict[str, Any] = {"render_step_size": float(occupancy.space.half_extent) / 200.0}
    sample = lambda e: e.sampling(origins, directions, **options)  # noqa: E731
    ours = seconds(lambda: sample(learned), scale.device, scale.rounds)
    kept = {"learned": len(sample(learned)[0])}
    with fused.twins_only():
        twin = seconds(lambda: sample(learned), scale.device, scale.rounds)
        kept["twin"] = len(sample(learned)[0])
    figures = [
        figure("sampling: torch twin / fused", twin / ours, 1.0, False, ours=ours, twin=twin)
    ]
    for name, grid in grids(occupancy, scale).items():
        theirs = seconds(lambda g=grid: sample(g), scale.device, scale.rounds)
        kept[name] = len(sample(grid)[0])
        title = f"sampling {scale.rays} rays: learned / {name}"
        figures.append(figure(title, ours / theirs, 1.0, True, learned=ours, grid=theirs))
    cells = None if learned.cache is None else vars(learned.cache.report)
    return {"kept": kept, "cache": cells, "figures": figures}


def grids(occupancy: Occupancy, scale: Scale) -> dict[str, Any]:
    """Our torch grid and, where its kernels build, nerfacc's, filled from the occupancy."""
    space = occupancy.space
    box = torch.cat([space.center - space.half_extent, space.center + space.half_extent])
    classes: dict[str, Callable[..., Any]] = {"torch grid": OccupancyGridEstimator}
    if scale.device.type == "cuda" and importlib.util.find_spec("nerfacc"):
        import nerfacc

        classes["nerfacc grid"] = nerfacc.OccGridEstimator
    made = {}
    for name, build in classes.items():
        for levels in (1, 4):
            grid = build(box.cpu(), resolution=scale.grid, levels=levels).to(scale.device).train()
            grid.update_every_n_steps(0, lambda x: occupancy.occupied(x).float())
            made[f"{name} {scale.grid}^3 x {levels}"] = grid
    return made


def training(scale: Scale) -> dict[str, Any]:
    """A training step of the HMoE on all candidates, and guided, with their peak memory."""
    occupancy = fit_occupancy(str(scale.device), steps=scale.fit_steps)
    space, device = occupancy.space, scale.device
    origins, directions = rays_into(space, scale.rays // 4)
    zeros = torch.zeros_like(origins[:, 0])
    reach = 4.0 * float(space.half_extent)
    rays = Rays(origins, directions, zeros, zeros + reach, None)
    image = torch.rand(len(origins), 3, device=device)
    options = {"render_step_size": reach / scale.sizes.candidates, "far_plane": reach}
    box = torch.cat([space.center - space.half_extent, space.center + space.half_extent])
    samplers = {
        "dense": DenseEstimator(box).to(device),
        "guided": LearnedOccupancyEstimator(occupancy, cache_bytes=scale.cache_bytes),
    }
    times, peaks = {}, {}
    for name, sampler in samplers.items():
        torch.manual_seed(0)
        field = HMoEField(scale.sizes.field, num_images=1).to(device)
        optimizer = torch.optim.Adam(field.parameters(), lr=1e-3)

        def step(s: Any = sampler, f: HMoEField = field, o: Any = optimizer) -> None:
            intervals = Intervals(*s.sampling(origins, directions, stratified=True, **options))
            loss = loss_of(f, occupancy, rays, intervals, image)
            o.zero_grad()
            loss.backward()
            o.step()

        if device.type == "cuda":
            torch.cuda.reset_peak_memory_stats()
        times[name] = seconds(step, device, max(2, scale.rounds // 3))
        peaks[name] = torch.cuda.max_memory_allocated() if device.type == "cuda" else 0
    figures = [
        figure(
            "training step: dense / guided", times["dense"] / times["guided"], 2.5, False, **times
        )
    ]
    if peaks["dense"]:
        ratio = peaks["guided"] / peaks["dense"]
        figures.append(figure("peak memory: guided / dense", ratio, 0.5, True))
    return {"peak_bytes": peaks, "figures": figures}


def loss_of(
    field: HMoEField, occupancy: Occupancy, rays: Rays, intervals: Intervals, image: Tensor
) -> Tensor:
    """Photometric loss of a mixture of experts on packed intervals; every point meets an expert."""
    routing = Routing(None, homogeneous=True)
    with gate_precision(image.device.type, "bfloat16"):
        shaded = shade(
            field, occupancy.gate, occupancy.space, rays, intervals, routing, freeze_gate=True
        )
    return (shaded.rgb.float() - image).square().mean()


PARTS: dict[str, Callable[[Scale], dict[str, Any]]] = {
    "correctness": correctness,
    "gate": gate_throughput,
    "sampling": sampling,
    "training": training,
}
"""In the order in which they run."""
