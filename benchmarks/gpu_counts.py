"""What the fused march has to do for the rays of the GPU suite, counted with its torch twins:
`python benchmarks/gpu_counts.py`, on any machine. `gpu_paper.py` holds what it prints.
"""

from __future__ import annotations

from typing import NamedTuple

import checkout  # noqa: F401
import torch
from gpu_sampling import scenes
from gpu_scale import Scale
from sampling_scene import rays_into

from leco_plugin.samplers.cells.cache import CellCache
from leco_plugin.samplers.estimator import LearnedOccupancyEstimator
from leco_plugin.samplers.marching import Candidates, March, Rays, Samples, number
from leco_plugin.samplers.rays import candidate_edges

STEPS = 32
"""Candidates of a stretch, as in `march_kernel.py`, which is not imported where Triton is not."""


class Counted(NamedTuple):
    """The work of one launch for the suite's rays through unbounded space, and its result."""

    rays: int
    candidates: int
    stretches: int
    """Of `STEPS` candidates each: one coarse question."""
    near: int
    """Stretches whose candidates ask the cells."""
    asked: int
    """Stretches of which the gate is asked about some, and so about all."""
    kept: int
    """Candidates."""
    cell_bytes: int


class Counting(LearnedOccupancyEstimator):
    """Notes the candidates that it is asked about."""

    candidates: Candidates

    def march(self, rays: Rays, rule: March) -> Samples:
        self.candidates = number(rays, rule)
        return super().march(rays, rule)


def count_work(scale: Scale) -> Counted:
    """Counts the last, unbounded scene of the suite."""
    *_, (_, occupancy, options) = scenes(scale)
    made = Counting(occupancy, cache_bytes=scale.cache_bytes, tolerance=scale.tolerance)
    assert made.cache is not None
    kept = len(made.sampling(*rays_into(occupancy.space, scale.rays), **options)[0])
    steps = int(made.candidates.counts.sum())
    cell_bytes = made.cache.tables().bytes
    return Counted(scale.rays, steps, *stretches(made.cache, made.candidates), kept, cell_bytes)


@torch.no_grad()
def stretches(cache: CellCache, candidates: Candidates) -> tuple[int, int, int]:
    """Stretches of rays; of them those near something, and of these those that ask the gate."""
    begun = near = asked = 0
    for first in range(0, int(candidates.counts.max()), STEPS):
        window = candidates.window(first, STEPS)
        window = window.of_rays((window.counts > 0).nonzero()[:, 0])
        begun += len(window.counts)
        starts, ends = (
            candidate_edges(window.t_mins, steps, *window.rule)
            for steps in (window.first, window.first + window.counts)
        )
        origins, directions = window.coordinates
        centers = torch.addcmul(origins, directions, (starts + ends) * 0.5)
        radii = (ends - starts) * 0.5 * directions.norm(dim=0)
        window = window.of_rays(cache.near(centers.T, radii).nonzero()[:, 0])
        near += len(window.counts)
        edges = window.edges(STEPS)
        origins, directions = window.coordinates[:, :, None]
        places = torch.addcmul(origins, directions, (edges[:-1] + edges[1:]) * 0.5)
        _, left_open = cache.decide(places.flatten(1).T)
        is_open = torch.zeros(places[0].shape, dtype=torch.bool, device=places.device)
        is_open.view(-1).index_fill_(0, left_open, True)
        there = torch.arange(STEPS, device=places.device)[:, None] < window.counts
        asked += int((is_open & there).any(dim=0).sum())
    return begun, near, asked


if __name__ == "__main__":
    print(count_work(Scale(torch.device("cpu"))))
