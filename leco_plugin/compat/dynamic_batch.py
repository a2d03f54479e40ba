"""nerfstudio's dynamic batches for hosts that skip most samples: with bounds, and resumed.

The original divides by the samples of the last batch. `VolumetricSampler` hides an empty batch
behind one fake sample, and the next batch then has 262,144 times as many rays.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from nerfstudio.pipelines.dynamic_batch import DynamicBatchPipeline, DynamicBatchPipelineConfig
from torch import Tensor

MOST_CHANGE = 2.0
"""Factor by which a batch may grow or shrink from one step to the next."""


@dataclass
class ClampedDynamicBatchPipelineConfig(DynamicBatchPipelineConfig):
    """Dynamic batches within bounds"""

    _target: type = field(default_factory=lambda: ClampedDynamicBatchPipeline)
    """target class to instantiate"""
    fewest_rays: int = 64
    """Rays of the smallest batch."""
    most_rays: int = 1 << 16
    """Rays of the largest batch: a batch in which nothing is kept says nothing about the next."""


class ClampedDynamicBatchPipeline(DynamicBatchPipeline):
    """The number of rays changes by steps, stays within bounds, and travels with a checkpoint."""

    config: ClampedDynamicBatchPipelineConfig
    rays_per_batch: Tensor

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.register_buffer("rays_per_batch", torch.tensor(self.dynamic_num_rays_per_batch))
        self.register_load_state_dict_post_hook(lambda pipeline, _: pipeline.restore())

    def _update_dynamic_num_rays_per_batch(self, num_samples_per_batch: int) -> None:
        factor = self.config.target_num_samples / max(num_samples_per_batch, 1)
        factor = min(MOST_CHANGE, max(1.0 / MOST_CHANGE, factor))
        wanted = round(self.dynamic_num_rays_per_batch * factor)
        self.dynamic_num_rays_per_batch = min(
            self.config.most_rays, max(self.config.fewest_rays, wanted)
        )
        self.rays_per_batch.fill_(self.dynamic_num_rays_per_batch)

    def restore(self) -> None:
        """Goes on with the batch of the checkpoint."""
        self.dynamic_num_rays_per_batch = int(self.rays_per_batch)
        self._update_pixel_samplers()
