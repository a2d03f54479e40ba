"""Checks of what an estimator returns: its form, whatever it says about the scene."""

from __future__ import annotations

import inspect
from typing import Any

import torch
from torch import nn

from leco_plugin.conformance.kit.intervals import PARTS, check_intervals, check_order
from leco_plugin.conformance.kit.scene import (
    BACKGROUND,
    SLAB,
    Field,
    Rays,
    crossing,
    cut_short,
    render,
    without_samples,
)
from leco_plugin.conformance.rule import Broken, require
from leco_plugin.conformance.samplers.estimator_case import EstimatorCase
from leco_plugin.conformance.samplers.sampler_case import devices
from leco_plugin.samplers.base import Estimator
from leco_plugin.samplers.marching import Samples
from leco_plugin.samplers.packed import pack_info

NEAR, FAR = 2.5, 3.4
"""Planes that cut into some of the rays of `cut_short` at either end."""


def signature(case: EstimatorCase) -> None:
    """The two verbs take nerfacc's arguments in nerfacc's order with nerfacc's defaults."""
    sampler = case.shared(SLAB)
    require(isinstance(sampler, nn.Module), f"it is a {type(sampler).__name__}, no torch module")
    for verb in ("sampling", "update_every_n_steps"):
        require(callable(getattr(sampler, verb, None)), f"it has no method {verb}")
    offered = list(inspect.signature(sampler.sampling).parameters.values())
    takes_anything = {inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD}
    if not takes_anything <= {parameter.kind for parameter in offered}:
        wanted = list(inspect.signature(Estimator.sampling).parameters.values())[1:]
        for position, parameter in enumerate(wanted):
            found = offered[position] if position < len(offered) else None
            fits = found is not None and _known_as(found) == _known_as(parameter)
            require(
                fits, f"argument {position + 1} of sampling is {found}, hosts give '{parameter}'"
            )
    try:
        inspect.signature(sampler.update_every_n_steps).bind(step=0, occ_eval_fn=SLAB.density)
    except TypeError as error:
        raise Broken(f"update_every_n_steps(step=, occ_eval_fn=): {error}") from None


def _known_as(parameter: inspect.Parameter) -> tuple[str, Any]:
    return parameter.name, parameter.default


def shapes_types_devices(case: EstimatorCase) -> None:
    """Three flat tensors of one length, of the type and on the device of the rays."""
    for device in devices():
        sampler, rays = case.shared(SLAB).to(device), crossing().to(device)
        for training in (False, True):
            samples = case.sample(sampler.train(training), rays)
            shapes = [list(part.shape) for part in samples]
            require(
                len(shapes[0]) == 1 and shapes[0] == shapes[1] == shapes[2] and shapes[0][0] > 0,
                f"ray_indices, t_starts and t_ends have shapes {shapes}; expected [n_samples] each",
            )
            for name, part in zip(PARTS, samples, strict=True):
                require(part.device == rays.origins.device, f"{name} is on {part.device}")
            for name, part in zip(PARTS[1:], samples[1:], strict=True):
                require(
                    part.dtype == rays.origins.dtype,
                    f"{name} is {part.dtype}, the rays are {rays.origins.dtype}",
                )
                require(bool(part.isfinite().all()), f"{name} holds values that are not finite")
        sampler.to("cpu")


def sorted_disjoint_inside(case: EstimatorCase) -> None:
    """Along each ray, samples follow one another between its ends."""
    sampler, rays = case.shared(SLAB), cut_short()
    for cone_angle in (0.0, 0.02):
        check_intervals(rays, case.sample(sampler, rays, cone_angle=cone_angle))
    narrower = rays._replace(t_min=rays.t_min.clamp(min=NEAR), t_max=rays.t_max.clamp(max=FAR))
    check_intervals(narrower, case.sample(sampler, rays, near_plane=NEAR, far_plane=FAR))
    check_order(case.sample(sampler.train(), rays))


def packing_consistent(case: EstimatorCase) -> None:
    """Rays come in order, by indices that `pack_info` can turn into starts and counts."""
    rays = crossing()
    ray_indices = case.sample(case.shared(SLAB), rays)[0]
    n_rays = len(rays.origins)
    require(ray_indices.dtype == torch.int64, f"ray_indices is {ray_indices.dtype}, not int64")
    low, high = (int(bound) for bound in ray_indices.aminmax())
    require(
        low >= 0 and high < n_rays, f"ray_indices go from {low} to {high}; there are {n_rays} rays"
    )
    require(
        bool((ray_indices[1:] >= ray_indices[:-1]).all()),
        "ray_indices fall somewhere: samples of a ray must lie together, rays in order",
    )
    counts = pack_info(ray_indices, n_rays)[:, 1]
    unpacked = torch.arange(n_rays, device=counts.device).repeat_interleave(counts)
    require(unpacked.equal(ray_indices), "pack_info does not give the ray indices back")


def zero_samples_well_formed(case: EstimatorCase) -> None:
    """Where there is nothing to sample, nothing is returned, and it renders as background."""
    sampler = case.shared(SLAB)
    asked: list[dict[str, Any]] = [{}, {"sigma_fn": lambda t_starts, *_: torch.ones_like(t_starts)}]
    for training in (False, True):
        for why, rays in without_samples().items():
            field = Field()
            sampler.train(training)
            for options in asked:
                samples = case.sample(sampler, rays, **options)
                found = [(list(part.shape), part.dtype) for part in samples]
                wanted = [([0], dtype) for dtype in (torch.int64, *[rays.origins.dtype] * 2)]
                require(found == wanted, f"{why}: returned {found}, expected {wanted}")
                check_background(why, field, rays, samples)


def check_background(why: str, field: Field, rays: Rays, samples: Samples) -> None:
    """Raises unless rays without samples show the background, and gradients are finite."""
    colours = render(field, rays, samples)
    background = colours.new_tensor(BACKGROUND).expand_as(colours)
    require(torch.allclose(colours, background), f"{why}: the background is not what is rendered")
    colours.sum().backward()
    gradients = [parameter.grad for parameter in field.parameters()]
    finite = all(gradient is not None and gradient.isfinite().all() for gradient in gradients)
    require(finite, f"{why}: gradients are missing or not finite")
