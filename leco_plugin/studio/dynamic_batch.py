"""nerfstudio's dynamic batches for hosts that skip most samples: with bounds, and resumed.

The original divides by the samples of the last batch. `VolumetricSampler` hides an empty batch
behind one fake sample, and the next batch then has 262,144 times as many rays.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any

import torch
from nerfstudio.pipelines.dynamic_batch import DynamicBatchPipeline, DynamicBatchPipelineConfig
from torch import Tensor

from leco_plugin.models.compute.ranks import mean
from leco_plugin.scenes.pixels.known_distances import drawable

MOST_GROWTH = 2.0
"""Factor by which a batch may grow from one step to the next; it shrinks as far as it must."""
FEWEST_RAYS, MOST_RAYS = 64, 1 << 16
"""Rays of the smallest and of the largest batch."""


@dataclass
class ClampedDynamicBatchPipelineConfig(DynamicBatchPipelineConfig):
    """Dynamic batches within bounds"""

    _target: type = field(default_factory=lambda: ClampedDynamicBatchPipeline)
    """target class to instantiate"""
    fewest_rays: int = FEWEST_RAYS
    """Of leco-ngp: rays of the smallest batch."""
    most_rays: int = MOST_RAYS
    """Of leco-ngp: rays of the largest batch."""


class ClampedDynamicBatchPipeline(DynamicBatchPipeline):
    """The number of rays stays within bounds, travels with a checkpoint, and is that of all
    processes of a data-parallel run."""

    rays_per_batch: Tensor

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.register_buffer("rays_per_batch", torch.tensor(self.dynamic_num_rays_per_batch))
        self.register_load_state_dict_post_hook(lambda pipeline, _: pipeline.restore())
        self.restore()

    def _update_dynamic_num_rays_per_batch(self, num_samples_per_batch: int) -> None:
        samples = mean(float(num_samples_per_batch), self.device)
        if samples <= 1:  # the fake one, which says nothing about a batch that keeps something
            return
        factor = min(MOST_GROWTH, self.config.target_num_samples / samples)
        self._set_rays(round(self.dynamic_num_rays_per_batch * factor))

    def restore(self) -> None:
        """Goes on with `rays_per_batch`, of a checkpoint too, within the bounds of this run."""
        self._set_rays(int(self.rays_per_batch))
        self._update_pixel_samplers()

    def _set_rays(self, wanted: int) -> None:
        fewest = getattr(self.config, "fewest_rays", FEWEST_RAYS)
        most = getattr(self.config, "most_rays", MOST_RAYS)
        rays = min(most, max(fewest, wanted))
        self.dynamic_num_rays_per_batch = drawable(rays, self.datamanager)
        self.rays_per_batch.fill_(self.dynamic_num_rays_per_batch)


@dataclass(frozen=True)
class Clamping:
    """Set as `_target` of the config of another package's dynamic batches: they are clamped too."""

    pipeline: type[DynamicBatchPipeline]
    """The class of that package."""

    def __call__(self, config: Any, **arguments: Any) -> DynamicBatchPipeline:
        """The pipeline, of a class that is both."""
        both = (ClampedDynamicBatchPipeline, self.pipeline)
        made: DynamicBatchPipeline = type(f"Clamped{self.pipeline.__name__}", both, {})(
            config, **arguments
        )
        return made


def clamped(pipeline: Any) -> Any:
    """The config of a pipeline of dynamic batches as one that keeps within bounds; any other as it
    is."""
    target = getattr(pipeline, "_target", None)
    if not isinstance(target, type) or not issubclass(target, DynamicBatchPipeline):
        return pipeline
    if issubclass(target, ClampedDynamicBatchPipeline):
        return pipeline
    if type(pipeline) is DynamicBatchPipelineConfig and target is DynamicBatchPipeline:
        values = {f.name: getattr(pipeline, f.name) for f in fields(pipeline)}
        values.pop("_target")
        return ClampedDynamicBatchPipelineConfig(**values)
    return replace(pipeline, _target=Clamping(target))
