"""Samplers at the seam of proposal hosts, called as nerfstudio's nerfacto calls its own."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from leco_plugin.conformance.kit.scene import BACKGROUND, SLAB, Field, Rays, Slab
from leco_plugin.conformance.rule import Broken, require
from leco_plugin.conformance.samplers.sampler_case import SamplerCase
from leco_plugin.occupancy import Occupancy
from leco_plugin.samplers.marching import Samples
from leco_plugin.samplers.registry import build_proposal

LEVELS, NUM_SAMPLES = 2, 48
"""Proposal levels and samples a ray of the host, nerfacto's defaults."""


class ProposalCase(SamplerCase):
    """A sampler called as (ray_bundle, density_fns=...) -> (ray_samples, weights, samples)."""

    seam = "proposal"
    imports = ("torch", "nerfstudio.model_components.ray_samplers")

    def build(self, occupancy: Occupancy | None, **more: Any) -> Any:
        from nerfstudio.model_components.ray_samplers import UniformLinDispPiecewiseSampler

        return build_proposal(
            self.name,
            occupancy=occupancy,
            num_samples=NUM_SAMPLES,
            initial_sampler=UniformLinDispPiecewiseSampler(),
            single_jitter=False,
            **self.options,
            **more,
        )

    def teach(self, sampler: Any, scene: Slab) -> None:
        """Nothing: it asks the host for densities whenever it samples."""

    def answer(
        self, sampler: Any, rays: Rays, scene: Slab = SLAB, density: Any = None
    ) -> tuple[Any, Any, Any]:
        """ray_samples, weights_list and ray_samples_list, as a host gets them.

        Args:
            density: what each of the host's density_fns is; None is the density of the scene.
        """
        density_fns = [scene.density if density is None else density] * LEVELS
        answer = sampler(ray_bundle(rays), density_fns=density_fns)
        are_three = isinstance(answer, (tuple, list)) and len(answer) == 3
        require(
            are_three,
            f"the call returned {type(answer).__name__} instead of ray_samples, weights_list and "
            "ray_samples_list",
        )
        ray_samples, weights, candidates = answer
        return ray_samples, weights, candidates

    def sample(
        self, sampler: Any, rays: Rays, scene: Slab = SLAB, *, seed: int = 0, **options: Any
    ) -> Samples:
        torch.manual_seed(seed)
        return packed(self.answer(sampler, rays, scene, **options)[0])

    def colours(self, sampler: Any, rays: Rays, field: Field) -> Tensor:
        ray_samples, _, _ = self.answer(sampler, rays)
        positions = ray_samples.frustums.get_positions()
        weights = ray_samples.get_weights(field.density(positions)[..., None])
        colours = (weights * field.colours(positions)).sum(dim=-2)
        return colours + (1.0 - weights.sum(dim=-2)) * colours.new_tensor(BACKGROUND)


def no_density(*_: Any, **__: Any) -> None:
    """What a guided host has in the place of its proposal networks.

    Raises:
        Broken: always.
    """
    raise Broken("density_fns are called, and a guided host has no proposal networks to answer")


def ray_bundle(rays: Rays) -> Any:
    """Rays as nerfstudio hands them to a sampler."""
    from nerfstudio.cameras.rays import RayBundle

    return RayBundle(
        origins=rays.origins,
        directions=rays.directions,
        pixel_area=torch.full_like(rays.t_min, 1e-6)[:, None],
        nears=rays.t_min[:, None],
        fars=rays.t_max[:, None],
    )


def packed(ray_samples: Any) -> Samples:
    """The samples of all rays one after another."""
    starts, ends = ray_samples.frustums.starts, ray_samples.frustums.ends
    require(
        starts.dim() == 3 and starts.shape == ends.shape,
        f"starts are {list(starts.shape)} and ends {list(ends.shape)}; expected [n_rays, n, 1]",
    )
    rays = torch.arange(len(starts), device=starts.device)
    return rays.repeat_interleave(starts.shape[1]), starts.reshape(-1), ends.reshape(-1)
