"""What asking the learned occupancy costs: `python benchmarks/sampling.py`.

Every figure is a ratio of two things that run in turn in one process. Results go to
`benchmarks/results/sampling.json`, from which the table of docs/measurements.md is made.
"""

from __future__ import annotations

import datetime
import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import checkout  # noqa: F401
import torch
import tyro
from sampling_hosts import ngp_like_step, switch_nerf_like_step
from sampling_scene import fit_occupancy, rays_into
from timing import machine, milliseconds, ratio, time_interleaved
from torch import Tensor

from leco_plugin.evaluation.report import describe_code
from leco_plugin.models.compute.device import keep_freed_memory
from leco_plugin.occupancy import Occupancy
from leco_plugin.samplers.estimator import LearnedOccupancyEstimator
from leco_plugin.samplers.grid import OccupancyGridEstimator
from leco_plugin.samplers.marching import March, Rays, march

GRID_ONCE, GRID_PER_LEVEL = 32, 5
"""Bytes that nerfacc's grid holds for a cell once, and for a cell on each level."""


@dataclass
class Options:
    """Settings of the benchmark."""

    occupancy: Path | None = None
    """A frozen occupancy to measure; without one a gate is fitted to a small city of boxes."""
    device: str = "cpu"
    """Where to measure: cpu or cuda."""
    threads: int = 2
    """Threads of torch on the CPU."""
    rounds: int = 15
    """How often each thing is timed."""
    out: Path = Path(__file__).parent / "results" / "sampling.json"
    """Where the figures go."""


@dataclass
class Figure:
    """One line of the table."""

    name: str
    """What was measured."""
    value: float
    """The ratio."""
    bar: float
    """What it must reach."""
    at_most: bool
    """Whether the bar is an upper bound."""
    milliseconds: dict[str, float]
    """Medians behind it."""

    @property
    def reached(self) -> bool:
        return self.value <= self.bar if self.at_most else self.value >= self.bar


def compare_with_grid(occupancy: Occupancy, n_rays: int, rounds: int) -> list[Figure]:
    """Gate with cache against a grid of 128^3 cells: time on the same candidates, and memory."""
    learned = LearnedOccupancyEstimator(occupancy)
    space = occupancy.space
    box = torch.cat([space.center - space.half_extent, space.center + space.half_extent])
    levels = 1 if space.kind == "box" else 4
    grid = OccupancyGridEstimator(box, resolution=128, levels=levels).to(learned.device).train()
    grid.update_every_n_steps(0, lambda x: occupancy.occupied(x).float())
    origins, directions = rays_into(space, n_rays)
    options: dict[str, Any] = {"render_step_size": float(space.half_extent) / 200.0}
    if levels > 1:
        options |= {"cone_angle": 0.004, "far_plane": float(space.half_extent) * 8.0}
    timings = time_interleaved(
        {
            "gate with cache": lambda: learned.sampling(origins, directions, **options),
            "occupancy grid 128^3": lambda: grid.sampling(origins, directions, **options),
        },
        rounds,
    )
    assert learned.cache is not None
    gate_bytes = sum(p.numel() * p.element_size() for p in occupancy.parameters())
    held = learned.cache.tables().bytes + gate_bytes
    held_by_grid = 128**3 * (GRID_ONCE + 4 * GRID_PER_LEVEL)
    return [
        Figure(
            f"sampling, {n_rays} rays: gate with cache / grid 128^3",
            ratio(timings, "gate with cache", "occupancy grid 128^3"),
            1.3,
            True,
            milliseconds(timings),
        ),
        Figure("memory: gate and cache / grid 128^3 x 4", held / held_by_grid, 0.1, True, {}),
    ]


def compare_with_matrix_products(occupancy: Occupancy, rounds: int) -> Figure:
    """The gate without cache against nothing but its matrix products, in its precision."""
    gate, device = occupancy.gate, occupancy.space.center.device
    positions, _ = rays_into(occupancy.space, 1 << 16)
    dtype = torch.bfloat16 if occupancy.precision == "bfloat16" else torch.float32
    layers = [*gate.hidden, gate.head]
    matrices = [layer.weight.detach().to(dtype).T.contiguous() for layer in layers]
    features = torch.randn(len(positions), matrices[0].shape[0], device=device).to(dtype)

    def products() -> Tensor:
        hidden = features
        for matrix in matrices:
            hidden = hidden @ matrix
        return hidden

    functions: dict[str, Callable[[], Any]] = {
        "matrix products": products,
        "gate": lambda: occupancy.occupied(positions),
    }
    timings = time_interleaved(functions, rounds)
    value = ratio(timings, "matrix products", "gate")
    name = f"throughput: gate without cache / its matrix products ({occupancy.precision})"
    return Figure(name, value, 0.5, False, milliseconds(timings))


def compare_with_one_pass(device: str, rounds: int) -> list[Figure]:
    """Marching and packing a million candidates of which 5% are kept, against one pass over them.

    The pass reads the positions once and writes as much, which is the strictest reading; what
    forming the positions takes, in the way of a host, is measured beside it.
    """
    n_rays, n_steps = 4000, 250
    origins = torch.rand(n_rays, 3, device=device)
    directions = torch.nn.functional.normalize(torch.randn(n_rays, 3, device=device), dim=-1)
    bounds = torch.zeros(n_rays, device=device), torch.ones(n_rays, device=device)
    rays = Rays(origins, directions, *bounds), March(1.0 / n_steps)
    dense = march(*rays)
    middles = ((dense[1] + dense[2]) * 0.5)[:, None]
    positions = origins[dense[0]] + directions[dense[0]] * middles
    limit = positions[:, 0].quantile(0.95).item()

    def occupied(places: Tensor) -> Tensor:
        return places[:, 0] > limit

    def near_occupied(places: Tensor, radii: Tensor) -> Tensor:
        return places[:, 0] + radii > limit

    functions: dict[str, Callable[[], Any]] = {
        "one pass over the positions": lambda: positions * 2.0,
        "forming the positions": lambda: torch.addcmul(
            origins.index_select(0, dense[0]), directions.index_select(0, dense[0]), middles
        ),
        "march": lambda: march(*rays, occupied),
        "march with a coarse question": lambda: march(*rays, occupied, near_occupied),
    }
    timings = time_interleaved(functions, rounds)
    medians = milliseconds(timings)
    base = "one pass over the positions"
    return [
        Figure(
            f"marching 1M candidates, 5% kept: {name} / {base}",
            ratio(timings, name, base),
            3.0,
            True,
            medians,
        )
        for name in ("march", "march with a coarse question")
    ] + [
        Figure(
            "marching 1M candidates, 5% kept: march / forming the positions",
            ratio(timings, "march", "forming the positions"),
            3.0,
            True,
            medians,
        )
    ]


def share_of_training(occupancy: Occupancy, rounds: int) -> list[Figure]:
    """Sampling as a share of a guided host's training step."""
    figures = []
    for name, build in (("NGP-like", ngp_like_step), ("Switch-NeRF-like", switch_nerf_like_step)):
        sample, step = build(LearnedOccupancyEstimator(occupancy))
        timings = time_interleaved({"sampling": sample, "training step": step}, max(3, rounds // 3))
        value = ratio(timings, "sampling", "training step")
        figures.append(
            Figure(f"sampling / training step, {name}", value, 0.15, True, milliseconds(timings))
        )
    return figures


def main(options: Options) -> None:
    torch.manual_seed(0)
    torch.set_num_threads(options.threads)
    keep_freed_memory(options.device)
    if options.occupancy is not None:
        occupancy = Occupancy.load(options.occupancy, options.device)
    else:
        occupancy = fit_occupancy(options.device)
    figures = [
        *compare_with_grid(occupancy, 4096, options.rounds),
        compare_with_grid(occupancy, 256, 5 * options.rounds)[0],
        compare_with_matrix_products(occupancy, options.rounds),
        *compare_with_one_pass(options.device, options.rounds),
        *share_of_training(occupancy, options.rounds),
    ]
    report = LearnedOccupancyEstimator(occupancy).cache
    results = {
        "format": 1,
        "date": f"{datetime.date.today()}",
        "code": describe_code(),
        "machine": machine(),
        "scene": {"occupancy": str(options.occupancy or "fitted to boxes")},
        "cache": vars(report.report) if report is not None else None,
        "figures": [{**vars(figure), "reached": figure.reached} for figure in figures],
    }
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(results, indent=2) + "\n")
    for figure in figures:
        sign = "<=" if figure.at_most else ">="
        digits = 3 if figure.value < 0.1 or math.isnan(figure.value) else 2
        verdict = "reached" if figure.reached else "NOT REACHED"
        print(f"{figure.name}: {figure.value:.{digits}f} ({sign} {figure.bar}) {verdict}")
        print(f"    {figure.milliseconds}")


if __name__ == "__main__":
    main(tyro.cli(Options))
