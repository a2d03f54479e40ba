"""A proposal host: a sampler with two scouts, under names of its own."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from nerfstudio.cameras.rays import RayBundle
from nerfstudio.field_components.field_heads import FieldHeadNames
from nerfstudio.model_components.losses import distortion_loss, interlevel_loss
from nerfstudio.model_components.ray_samplers import ProposalNetworkSampler, UniformSampler
from nerfstudio.models.base_model import ModelConfig
from torch import Tensor, nn

from nerf_elsewhere.matter import Matter, Scout
from nerf_elsewhere.photographic import PhotographicModel


@dataclass
class ProposalModelConfig(ModelConfig):
    """A proposal host of another package"""

    _target: type = field(default_factory=lambda: ProposalModel)
    """what is built"""
    collider_params: dict[str, float] | None = field(
        default_factory=lambda: {"near_plane": 0.05, "far_plane": 4.0}
    )
    """Where rays begin and end."""
    samples: int = 24
    """Samples that are shaded on each ray."""


class ProposalModel(PhotographicModel):
    """Renders where its scouts have seen something."""

    config: ProposalModelConfig

    def populate_modules(self) -> None:
        super().populate_modules()
        self.matter = Matter()
        self.far_scout, self.near_scout = Scout(), Scout()
        self.looks = (self.far_scout.density_fn, self.near_scout.density_fn)
        self.chooser = ProposalNetworkSampler(
            num_proposal_samples_per_ray=(32, 24),
            num_nerf_samples_per_ray=self.config.samples,
            num_proposal_network_iterations=2,
            initial_sampler=UniformSampler(single_jitter=True),
        )

    def get_param_groups(self) -> dict[str, list[nn.Parameter]]:
        scouts = [*self.far_scout.parameters(), *self.near_scout.parameters()]
        return {"scouts": scouts, "matter": list(self.matter.parameters())}

    def get_outputs(self, ray_bundle: RayBundle) -> dict[str, Any]:
        samples, weights_list, samples_list = self.chooser(ray_bundle, density_fns=self.looks)
        found = self.matter(samples)
        weights = samples.get_weights(found[FieldHeadNames.DENSITY])
        middles = 0.5 * (samples.frustums.starts + samples.frustums.ends)
        outputs: dict[str, Any] = {
            "rgb": (weights * found[FieldHeadNames.RGB]).sum(dim=-2),
            "accumulation": weights.sum(dim=-2),
            "depth": (weights * middles).sum(dim=-2),
        }
        if self.training:
            outputs["levels"] = [*weights_list, weights], [*samples_list, samples]
        return outputs

    def get_loss_dict(
        self,
        outputs: dict[str, Any],
        batch: dict[str, Tensor],
        metrics_dict: dict[str, Any] | None = None,
    ) -> dict[str, Tensor]:
        losses = super().get_loss_dict(outputs, batch, metrics_dict)
        if self.training:
            losses["scout_loss"] = interlevel_loss(*outputs["levels"])
            losses["distortion_loss"] = 0.002 * distortion_loss(*outputs["levels"])
        return losses
