"""The rules for what a guided host renders, and where it asks its field."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest.mock import patch

import torch
from nerfacc.estimators.base import AbstractEstimator
from nerfstudio.cameras.rays import RayBundle, RaySamples
from nerfstudio.fields.base_field import Field
from nerfstudio.model_components.ray_samplers import UniformSampler
from nerfstudio.model_components.renderers import RGBRenderer
from nerfstudio.models.base_model import Model
from nerfstudio.utils.colormaps import apply_colormap, apply_depth_colormap
from torch import Tensor, nn

from leco_plugin.conformance import hosts
from leco_plugin.conformance import scene as kit
from leco_plugin.conformance.hosts import HostCase
from leco_plugin.conformance.proposals import CHORD, INSIDE, NEARBY, chords
from leco_plugin.conformance.rules import checks, raises_nothing, require, require_none
from leco_plugin.conformance.samplers import check_tensor, devices, of_two_seeds
from leco_plugin.conformance.scene import SLAB, Rays
from leco_plugin.hosts.stand_ins import GuidedEstimator, GuidedProposal, is_packed
from leco_plugin.samplers.base import DenseEstimator, Estimator
from leco_plugin.samplers.marching import Samples

DENSE = 512
"""Samples of each ray of a proposal host that is sampled densely."""


@torch.no_grad()
def asked_and_sampled(model: Model) -> tuple[Tensor, Tensor]:
    """Positions [N, 3] at which a host asks its field about the rays of `bundle`, and those [M, 3]
    of what its sampler returns.

    A field is any `Field` of nerfstudio that is called with samples. Of a host that has none, what
    its sampler returns counts as asked.
    """
    asked: list[Tensor] = []
    sampled: list[Tensor] = []

    def before(_: nn.Module, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
        samples = [part for part in (*args, *kwargs.values()) if isinstance(part, RaySamples)]
        asked.extend(positions_of(part) for part in samples)

    with ExitStack() as stack:
        for module in model.modules():
            if isinstance(module, Field):
                stack.enter_context(module.register_forward_pre_hook(before, with_kwargs=True))
            elif isinstance(module, GuidedEstimator | GuidedProposal):
                stack.enter_context(_noting(module, sampled))
        model(hosts.bundle())
    require(bool(asked or sampled), "the field is asked about no sample at all")
    require(bool(sampled), "the sampler is not asked")
    return torch.cat(asked or sampled), torch.cat(sampled)


def positions_of(ray_samples: Any) -> Tensor:
    """Middles of nerfstudio's samples, [N, 3]."""
    positions: Tensor = ray_samples.frustums.get_positions()
    return positions.detach().reshape(-1, 3)


def _noting(seam: GuidedEstimator | GuidedProposal, sampled: list[Tensor]) -> Any:
    """A context in which the positions of what a seam returns are noted."""
    if isinstance(seam, GuidedProposal):
        return seam.register_forward_hook(lambda _, __, out: sampled.append(positions_of(out[0])))
    original: Any = seam.sampling

    def sampling(rays_o: Tensor, rays_d: Tensor, *args: Any, **kwargs: Any) -> Samples:
        ray_indices, t_starts, t_ends = original(rays_o, rays_d, *args, **kwargs)
        middles = ((t_starts + t_ends) / 2.0)[:, None]
        sampled.append(rays_o[ray_indices] + rays_d[ray_indices] * middles)
        return ray_indices, t_starts, t_ends

    return patch.object(seam, "sampling", sampling)


@contextmanager
def sample_densely(model: Model) -> Iterator[None]:
    """While this lasts, a guided host, or a packed one with its own estimator, samples all of the
    box, or all of each ray."""
    with ExitStack() as stack:
        for module in model.modules():
            if isinstance(module, GuidedEstimator | AbstractEstimator | Estimator):
                everywhere = DenseEstimator(kit.box()).sampling
                stack.enter_context(patch.object(module, "sampling", everywhere))
            elif isinstance(module, GuidedProposal):
                stack.enter_context(patch.object(module, "forward", _all_of_each_ray))
        yield


def _all_of_each_ray(
    ray_bundle: Any, density_fns: Any = None, **_: Any
) -> tuple[Any, list[Tensor], list[Any]]:
    """Evenly spaced samples, as a proposal sampler returns them."""
    samples = UniformSampler(DENSE, train_stratified=False)(ray_bundle)
    weights = torch.full_like(samples.frustums.starts, 1.0 / DENSE)
    levels = 1 if density_fns is None else len(density_fns)
    return samples, [weights] * levels, [samples] * levels


CHANNELS = {"rgb": 3, "depth": 1, "accumulation": 1}
"""Outputs that nerfstudio's commands rely on."""
TOLERANCE = {True: 1e-3, False: 0.25}
"""Of a packed host, and of one with a fixed number of samples, which are few: the largest
difference between guided by everything and dense, as a share of the largest value."""
RELATIVE = 1e-5
"""Of a position's distance from the origin: what two ways to compute it may differ by."""
OPAQUE = 1e-4
"""Accumulation up to which a ray has met nothing."""


@checks("outputs-can-be-drawn", "host")
def outputs_can_be_drawn(case: HostCase) -> None:
    for device in devices():
        model = case.shared().to(device)
        rays = hosts.bundle().to(device)
        with torch.no_grad():
            flat = model(rays)
            images = model.get_outputs_for_camera(hosts.cameras()[:1].to(device))
        for name, channels in CHANNELS.items():
            value, wanted = flat.get(name), [len(rays), channels]
            require(isinstance(value, Tensor), f"there is no output {name!r}")
            found = list(value.shape)
            require(found == wanted, f"the output {name!r} has shape {found}, not {wanted}")
            check_tensor(f"the output {name!r}", value, rays.origins)
        for name, image in images.items():
            _check_picture(name, image)
        model.to("cpu")


def _check_picture(name: str, image: Tensor) -> None:
    """As ns-render and the viewer make one of an output."""
    draw = apply_depth_colormap if "depth" in name else apply_colormap
    what = f"{image.dtype} with {image.shape[-1]} channels"
    with raises_nothing(f"no picture can be made of the output {name!r}, {what}:"):
        draw(image)


@checks("same-image-in-eval", "host")
def same_image_in_eval(case: HostCase) -> None:
    model = case.shared()
    one, other = of_two_seeds(lambda seed: rendered(model, hosts.bundle(), seed))
    for name, value in one.items():
        require(value.equal(other[name]), f"two evaluations of the same rays differ in {name!r}")


@torch.no_grad()
def rendered(model: Model, rays: RayBundle, seed: int = 0) -> dict[str, Tensor]:
    """Outputs that are tensors, in evaluation, with random numbers from `seed`."""
    torch.manual_seed(seed)
    outputs = model.eval()(rays)
    return {name: value for name, value in outputs.items() if isinstance(value, Tensor)}


@checks("empty-rays-show-background", "host")
def empty_rays_show_background(case: HostCase) -> None:
    for why, scene, away in (
        ("rays that miss the scene", SLAB, True),
        (kit.KEEPS_NOTHING, kit.NOTHING, False),
    ):
        model = case.shared(scene)
        outputs = rendered(model, hosts.bundle(away))
        for name in CHANNELS:
            finite = bool(outputs[name].isfinite().all())
            require(finite, f"{why}: the output {name!r} holds values that are not finite")
        if is_packed(model):
            _check_background(why, model, outputs)
        loss = hosts.loss_of(model.train(), hosts.bundle(away), hosts.batch())
        require(bool(loss.isfinite()), f"{why}: the loss is {loss.item()}")
        require(loss.requires_grad, f"{why}: the loss has no gradient, so that the step fails")
        loss.backward()  # type: ignore[no-untyped-call]
        gradients = [parameter.grad for parameter in model.parameters()]
        finite = all(bool(grad.isfinite().all()) for grad in gradients if grad is not None)
        require(finite, f"{why}: a gradient is not finite")
        model.zero_grad()


def _check_background(why: str, model: Model, outputs: dict[str, Tensor]) -> None:
    """A ray without samples has met nothing, and has the colour that the host's renderer names."""
    most = float(outputs["accumulation"].max())
    require(most <= OPAQUE, f"{why}: a ray that has no samples has accumulation {most:.2g}")
    renderers = [module for module in model.modules() if isinstance(module, RGBRenderer)]
    if len(renderers) != 1 or renderers[0].background_color in ("random", "last_sample"):
        return  # it has no one colour
    named, rgb = renderers[0].background_color, outputs["rgb"]
    colour = renderers[0].get_background_color(named, (3,), torch.device("cpu"))
    shown = torch.allclose(rgb, colour.expand_as(rgb), atol=1e-3)
    found, wanted = ([round(x, 2) for x in one.tolist()] for one in (rgb[0], colour))
    require(shown, f"{why}: colours {found} instead of {wanted}")


@checks("shades-only-what-is-kept", "host")
def shades_only_what_is_kept(case: HostCase) -> None:
    rays, along = hosts.bundle(), torch.zeros(len(hosts.bundle()))
    enters, leaves = chords(Rays(rays.origins, rays.directions, along, along + 2.0 * kit.DISTANCE))
    require(bool((leaves - enters > CHORD).all()), "the kit's rays do not all cross its slab")
    for training, moved, scene in (
        (False, False, SLAB),
        (True, False, SLAB),
        (False, True, SLAB),
        (False, False, kit.AROUND),
        (True, False, kit.AROUND),
    ):
        model = case.shared(scene, moved).train(training)
        positions, sampled = asked_and_sampled(model)
        depths = scene.depth(positions)
        offsets = positions[depths > 0.0] - rays.origins[:, None]
        beside = torch.linalg.cross(offsets, rays.directions[:, None].expand_as(offsets))
        met = (beside.norm(dim=-1) < 1e-3).any(dim=1)
        require_none(~met, "{} rays have no sample in what is occupied")
        if not is_packed(model):
            near = float((depths > -NEARBY).float().mean())
            require(near >= INSIDE, f"{near:.0%} of all samples lie in or near what is occupied")
            continue
        if not scene.unbounded:  # where a ray ends in a backdrop, whatever is there
            outside = depths < -kit.MARGIN
            require_none(outside, "the field is asked about {} places where all is empty")
        if not training:
            require_none(_apart(sampled, positions), "{} samples that are kept are not shaded")
            more = _apart(positions, sampled)
            require_none(more, "the field is asked about {} places that are no samples")


def _apart(positions: Tensor, others: Tensor) -> Tensor:
    """Which positions [N, 3] are none of the others [M, 3], but for rounding: bool [N]."""
    from scipy.spatial import cKDTree

    distances, _ = cKDTree(others.double().numpy()).query(positions.double().numpy())
    return torch.from_numpy(distances) > kit.ROUNDING + RELATIVE * positions.norm(dim=-1)


@checks("guided-by-everything-is-dense", "host")
def guided_by_everything_is_dense(case: HostCase) -> None:
    model = case.shared(kit.EVERYTHING)
    found = rendered(model, hosts.inside_the_box())
    with sample_densely(model):
        expected = rendered(model, hosts.inside_the_box())
    tolerance = TOLERANCE[is_packed(model)]
    for name in CHANNELS:
        largest = float(expected[name].abs().max().clamp(min=1e-6))
        apart = float((found[name] - expected[name]).abs().max()) / largest
        said = f"{name!r} differs by {apart:.1%} of its largest value from dense sampling"
        require(apart <= tolerance, said)
