"""Sampling by the gate with its cells against occupancy grids, on the same rays.

A grid of 128^3 cells knows less of a scene than a gate does, and how much of it it keeps depends on
how it is filled. So that no one wins by skipping more, its cells are marked from the gate's own
values, down to the one at which as many candidates of the rays are kept as the gate keeps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import torch
from gpu_floor import seconds
from gpu_nerfacc import nerfacc_grid
from gpu_scale import Scale, figure
from sampling_scene import fit_occupancy, rays_into
from torch import Tensor

from leco_plugin.occupancy import Occupancy
from leco_plugin.samplers.boxes import cell_centers
from leco_plugin.samplers.estimator import LearnedOccupancyEstimator
from leco_plugin.samplers.kernels import fused
from leco_plugin.samplers.marching import March, Rays
from leco_plugin.space import Space

POINTS, AT_ONCE, HALVINGS = 4, 1 << 20, 12
"""Points of a cell at which the gate is asked, how many at once, and how often the value from which
a cell is marked is halved in on."""


def sampling(scale: Scale, before: dict[str, Any]) -> dict[str, Any]:
    """The fused march against its twin and against grids of one and of four levels."""
    figures, kept, cells, running = [], {}, {}, {}
    for levels, occupancy, options in scenes(scale):
        learned = LearnedOccupancyEstimator(
            occupancy, cache_bytes=scale.cache_bytes, tolerance=scale.tolerance
        )
        rays = rays_into(occupancy.space, scale.rays)

        def sample(estimator: Any, rays: Any = rays, options: Any = options) -> Any:
            return estimator.sampling(*rays, **options)

        def time(estimator: Any, sample: Callable[[Any], Any] = sample) -> float:
            return seconds(lambda: sample(estimator), scale.device, scale.rounds)

        space = "box" if levels == 1 else "unbounded"
        kept[f"learned, {space}"] = len(sample(learned)[0])
        cells[space] = None if learned.cache is None else vars(learned.cache.report)
        running[f"march, {space}"] = march_answers(learned)
        ours = time(learned)
        with fused.twins_only():
            twin = time(learned)
        title = f"sampling {scale.rays} rays, {space}"
        figures.append(
            figure(f"{title}: torch twin / fused", twin / ours, 1.0, False, fused=ours, twin=twin)
        )
        for name, grid in grids(occupancy, levels, sample, kept[f"learned, {space}"], scale):
            theirs = time(grid)
            kept[f"{name}, {space}"] = len(sample(grid)[0])
            title = f"sampling {scale.rays} rays, {space}: learned / {name}"
            figures.append(figure(title, ours / theirs, 1.0, True, learned=ours, grid=theirs))
    return {"kept": kept, "cells": cells, "running": running, "figures": figures}


def march_answers(learned: LearnedOccupancyEstimator) -> bool:
    """Whether the fused march answers for an estimator, and not its twin."""
    points = torch.zeros(1, 3, device=learned.device), torch.ones(1, 3, device=learned.device)
    limits = torch.zeros(1, device=learned.device), torch.ones(1, device=learned.device)
    occupancy, cache = learned.occupancy, learned.cache
    return fused.march(occupancy, cache, Rays(*points, *limits), March(0.5)) is not None


def scenes(scale: Scale) -> Iterator[tuple[int, Occupancy, dict[str, Any]]]:
    """Levels of a grid for it, an occupancy, and how its rays are marched: bounded and not."""
    fitted = fit_occupancy(str(scale.device), steps=scale.fit_steps)
    half_extent = float(fitted.space.half_extent)
    yield 1, fitted, {"render_step_size": half_extent / 200.0}
    unbounded = Space("contraction").to(scale.device)
    options = {"cone_angle": 0.004, "far_plane": 8.0 * half_extent}
    yield (
        4,
        Occupancy(fitted.gate, unbounded, fitted.threshold, fitted.precision).to(scale.device),
        {"render_step_size": half_extent / 200.0, **options},
    )


def grids(
    occupancy: Occupancy,
    levels: int,
    sample: Callable[[Any], Any],
    wanted: int,
    scale: Scale,
) -> Iterator[tuple[str, Any]]:
    """Our torch grid and nerfacc's where its kernels run, marked so that they keep as much.

    Ours has nerfacc's cells: where nerfacc is not installed there is neither.
    """
    try:
        from leco_plugin.samplers.grid import OccupancyGridEstimator
    except ImportError as error:
        print(f"no comparison with grids: {error}")
        return
    space = occupancy.space
    box = torch.cat([space.center - space.half_extent, space.center + space.half_extent]).cpu()
    ours = OccupancyGridEstimator(box, resolution=scale.grid, levels=levels).to(scale.device)
    mark(ours, highest_in_cells(occupancy, ours), sample, wanted)
    yield f"torch grid {scale.grid}^3 x {levels}", ours
    theirs = nerfacc_grid(ours, sample)
    if theirs is not None:
        yield f"nerfacc {scale.grid}^3 x {levels}", theirs


@torch.no_grad()
def highest_in_cells(occupancy: Occupancy, grid: Any) -> Tensor:
    """The highest o(x) of a few points of each cell, as `binaries` lie: [levels, n, n, n]."""
    generator = torch.Generator(grid.device).manual_seed(0)
    centres = cell_centers(grid.aabbs, grid.resolution)
    widths = (grid.aabbs[:, 3:] - grid.aabbs[:, :3]) / grid.resolution
    widths = widths.repeat_interleave(grid.cells_per_lvl, dim=0)
    highest = torch.zeros(len(centres), device=grid.device)
    for part in torch.arange(len(centres), device=grid.device).split(AT_ONCE):
        for _ in range(POINTS):
            shift = torch.rand(len(part), 3, device=grid.device, generator=generator) - 0.5
            values = occupancy.query(centres[part] + shift * widths[part])
            highest[part] = torch.maximum(highest[part], values)
    return highest.view_as(grid.binaries)


def mark(grid: Any, values: Tensor, sample: Callable[[Any], Any], wanted: int) -> None:
    """Marks the cells with the highest values, so many that about as many samples are kept."""
    low, high = 0.0, 1.0
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        torch.ge(values, middle, out=grid.binaries)
        if len(sample(grid)[0]) > wanted:
            low = middle
        else:
            high = middle
    torch.ge(values, high, out=grid.binaries)
