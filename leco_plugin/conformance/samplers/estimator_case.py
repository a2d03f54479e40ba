"""Samplers at the seam of packed hosts, called as nerfacc and nerfstudio call an occupancy grid."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from leco_plugin.conformance.kit.scene import SLAB, STEP, Field, Rays, Slab, box, render
from leco_plugin.conformance.rule import require
from leco_plugin.conformance.samplers.sampler_case import SamplerCase
from leco_plugin.occupancy import Occupancy
from leco_plugin.samplers.marching import Samples
from leco_plugin.samplers.registry import build_estimator

TEACHING_STEPS = (0, 16)
"""Steps at which hosts of an occupancy grid refresh it, as nerfacc has it."""


class EstimatorCase(SamplerCase):
    """A sampler with nerfacc's two verbs, `sampling` and `update_every_n_steps`."""

    seam = "estimator"

    def build(self, occupancy: Occupancy | None) -> Any:
        return build_estimator(self.name, aabb=box(), occupancy=occupancy, **self.options)

    def teach(self, sampler: Any, scene: Slab) -> None:
        sampler.train()
        for step in TEACHING_STEPS:
            sampler.update_every_n_steps(step=step, occ_eval_fn=scene.density)

    def sample(
        self,
        sampler: Any,
        rays: Rays,
        scene: Slab = SLAB,
        *,
        seed: int = 0,
        **options: Any,
    ) -> Samples:
        """ray_indices, t_starts, t_ends, as `sampling` returns them."""
        torch.manual_seed(seed)
        samples = sampler.sampling(
            rays_o=rays.origins,
            rays_d=rays.directions,
            t_min=rays.t_min,
            t_max=rays.t_max,
            **{"render_step_size": STEP, "stratified": sampler.training, **options},
        )
        are_three = isinstance(samples, (tuple, list)) and len(samples) == 3
        require(
            are_three and all(isinstance(part, Tensor) for part in samples),
            f"sampling returned {type(samples).__name__} instead of three tensors "
            "(ray_indices, t_starts, t_ends)",
        )
        ray_indices, t_starts, t_ends = samples
        return ray_indices, t_starts, t_ends

    def colours(self, sampler: Any, rays: Rays, field: Field) -> Tensor:
        def sigma_fn(t_starts: Tensor, t_ends: Tensor, ray_indices: Tensor) -> Tensor:
            return field.density(rays.at(ray_indices, (t_starts + t_ends) / 2.0))

        return render(field, rays, self.sample(sampler, rays, sigma_fn=sigma_fn))
