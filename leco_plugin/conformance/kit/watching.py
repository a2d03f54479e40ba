"""Where a host asks its field, and a host that samples densely: both seen from outside."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from leco_plugin.conformance.kit.scene import box
from leco_plugin.hosts.stand_ins import GuidedEstimator, GuidedProposal
from leco_plugin.samplers.base import DenseEstimator, Estimator
from leco_plugin.samplers.marching import Samples

if TYPE_CHECKING:
    from nerfstudio.models.base_model import Model

DENSE = 512
"""Samples of each ray of a proposal host that is sampled densely."""


def is_packed(model: Model) -> bool:
    """Whether the host shades only what its sampler keeps, and not a fixed number a ray."""
    return any(isinstance(module, GuidedEstimator) for module in model.modules())


@contextmanager
def shaded(model: Model) -> Iterator[list[Tensor]]:
    """While this lasts, collects positions [N, 3] at which the host asks its field.

    A field is any `Field` of nerfstudio that is called with samples. Of a host that has none, what
    its sampler returns is collected when this ends.
    """
    from nerfstudio.cameras.rays import RaySamples
    from nerfstudio.fields.base_field import Field

    asked: list[Tensor] = []
    sampled: list[Tensor] = []

    def before(_: nn.Module, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
        samples = [part for part in (*args, *kwargs.values()) if isinstance(part, RaySamples)]
        asked.extend(positions_of(part) for part in samples)

    with ExitStack() as stack:
        for module in model.modules():
            if isinstance(module, Field):
                handle = module.register_forward_pre_hook(before, with_kwargs=True)
                stack.callback(handle.remove)
            elif isinstance(module, GuidedEstimator | GuidedProposal):
                stack.enter_context(_answers_noted(module, sampled))
        yield asked
    if not asked:
        asked.extend(sampled)


def positions_of(ray_samples: Any) -> Tensor:
    """Middles of nerfstudio's samples, [N, 3]."""
    positions: Tensor = ray_samples.frustums.get_positions()
    return positions.detach().reshape(-1, 3)


@contextmanager
def _answers_noted(seam: GuidedEstimator | GuidedProposal, sampled: list[Tensor]) -> Iterator[None]:
    """While this lasts, notes the positions of what a seam returns."""
    if isinstance(seam, GuidedProposal):
        note = seam.register_forward_hook(lambda _, __, out: sampled.append(positions_of(out[0])))
        with note:
            yield
        return
    original: Any = seam.sampling

    def sampling(rays_o: Tensor, rays_d: Tensor, *args: Any, **kwargs: Any) -> Samples:
        samples: Samples = original(rays_o, rays_d, *args, **kwargs)
        ray_indices, t_starts, t_ends = samples
        middles = ((t_starts + t_ends) / 2.0)[:, None]
        sampled.append(rays_o[ray_indices] + rays_d[ray_indices] * middles)
        return samples

    with _instead(seam, "sampling", sampling):
        yield


@contextmanager
def densely(model: Model) -> Iterator[None]:
    """While this lasts, a guided host samples all of the box, or all of each ray.

    So does a packed host with its own estimator.
    """
    from nerfacc.estimators.base import AbstractEstimator

    with ExitStack() as stack:
        for module in model.modules():
            if isinstance(module, GuidedEstimator | AbstractEstimator | Estimator):
                stack.enter_context(_instead(module, "sampling", DenseEstimator(box()).sampling))
            elif isinstance(module, GuidedProposal):
                stack.enter_context(_instead(module, "forward", _all_of_each_ray))
        yield


def _all_of_each_ray(
    ray_bundle: Any, density_fns: Any = None, **_: Any
) -> tuple[Any, list[Tensor], list[Any]]:
    """Evenly spaced samples, as a proposal sampler returns them."""
    from nerfstudio.model_components.ray_samplers import UniformSampler

    samples = UniformSampler(DENSE, train_stratified=False)(ray_bundle)
    weights = torch.full_like(samples.frustums.starts, 1.0 / DENSE)
    levels = 1 if density_fns is None else len(density_fns)
    return samples, [weights] * levels, [samples] * levels


@contextmanager
def _instead(module: nn.Module, name: str, method: Any) -> Iterator[None]:
    """While this lasts, a module has another method."""
    setattr(module, name, method)
    try:
        yield
    finally:
        delattr(module, name)
