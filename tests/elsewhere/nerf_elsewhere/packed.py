"""A packed host: an estimator and a volumetric sampler, under names of its own."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import nerfacc
import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.engine.callbacks import (
    TrainingCallback,
    TrainingCallbackAttributes,
    TrainingCallbackLocation,
)
from nerfstudio.field_components.field_heads import FieldHeadNames
from nerfstudio.model_components.ray_samplers import VolumetricSampler
from nerfstudio.models.base_model import ModelConfig
from torch import Tensor, nn

from nerf_elsewhere.matter import Matter
from nerf_elsewhere.photographic import PhotographicModel


@dataclass
class PackedModelConfig(ModelConfig):
    """A packed host of another package"""

    _target: type = field(default_factory=lambda: PackedModel)
    """what is built"""
    enable_collider: bool = False
    """The estimator's box bounds the rays."""
    step: float = 0.05
    """Distance between samples."""


class PackedModel(PhotographicModel):
    """Renders what its gatekeeper lets through."""

    config: PackedModelConfig

    def populate_modules(self) -> None:
        super().populate_modules()
        self.matter = Matter()
        box = 2.0 * self.scene_box.aabb.flatten()
        self.gatekeeper = nerfacc.OccGridEstimator(box, resolution=16, levels=1)
        self.walker = VolumetricSampler(self.gatekeeper, density_fn=self.matter.density_fn)

    def get_param_groups(self) -> dict[str, list[nn.Parameter]]:
        return {"everything": list(self.parameters())}

    def get_training_callbacks(
        self, training_callback_attributes: TrainingCallbackAttributes
    ) -> list[TrainingCallback]:
        def update(step: int) -> None:
            self.gatekeeper.update_every_n_steps(
                step=step, occ_eval_fn=lambda x: self.matter.density_fn(x) * self.config.step
            )

        return [TrainingCallback([TrainingCallbackLocation.BEFORE_TRAIN_ITERATION], update)]

    def get_outputs(self, ray_bundle: RayBundle) -> dict[str, Any]:
        with torch.no_grad():
            samples, rays = self.walker(
                ray_bundle=ray_bundle, render_step_size=self.config.step, near_plane=0.05
            )
        found, count = self.matter(samples), len(ray_bundle)
        starts, ends = samples.frustums.starts[..., 0], samples.frustums.ends[..., 0]
        weights, _, _ = nerfacc.render_weight_from_density(
            starts, ends, found[FieldHeadNames.DENSITY][..., 0], ray_indices=rays, n_rays=count
        )

        def gathered(values: Tensor | None) -> Tensor:
            return nerfacc.accumulate_along_rays(weights, values, ray_indices=rays, n_rays=count)

        return {
            "rgb": gathered(found[FieldHeadNames.RGB]),
            "accumulation": gathered(None),
            "depth": gathered(0.5 * (starts + ends)[:, None]),
            "walked": nerfacc.pack_info(rays, count)[:, 1],
        }

    def get_metrics_dict(self, outputs: dict[str, Any], batch: dict[str, Tensor]) -> dict[str, Any]:
        metrics = super().get_metrics_dict(outputs, batch)
        return {**metrics, "num_samples_per_batch": outputs["walked"].sum()}
