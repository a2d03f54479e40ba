"""A sampler of its own: every second sample of those that the occupancy keeps."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from leco_plugin.samplers.estimator import LearnedOccupancyEstimator
from leco_plugin.samplers.registry import SamplerSpec


class EverySecond(LearnedOccupancyEstimator):
    """Thins out the samples of a frozen gate; it asks the gate itself, without a cache."""

    def __init__(self, occupancy: Any, aabb: Tensor | None = None) -> None:
        super().__init__(occupancy, aabb, cache_bytes=0)

    def sampling(self, *args: Any, **kwargs: Any) -> tuple[Tensor, Tensor, Tensor]:
        ray_indices, t_starts, t_ends = super().sampling(*args, **kwargs)
        return ray_indices[::2], t_starts[::2], t_ends[::2]


EVERY_SECOND = SamplerSpec(
    "every second sample of a learned occupancy", estimator=EverySecond, needs_occupancy=True
)
