"""Samplers at the seam of packed hosts, called as nerfacc and nerfstudio call an occupancy grid."""

from __future__ import annotations

import functools
import inspect
import itertools
from typing import Any

import torch
from torch import Tensor

from leco_plugin.conformance import samplers
from leco_plugin.conformance import scene as kit
from leco_plugin.conformance.rules import checks, raises_nothing, require, require_none
from leco_plugin.conformance.samplers import SamplerCase
from leco_plugin.conformance.scene import SLAB, Field, Rays, Slab
from leco_plugin.occupancy import Occupancy
from leco_plugin.samplers.base import Estimator
from leco_plugin.samplers.marching import Samples
from leco_plugin.samplers.packed import pack_info, render_transmittance_from_density
from leco_plugin.samplers.registry import build_estimator


class EstimatorCase(SamplerCase):
    """A sampler with nerfacc's two verbs, `sampling` and `update_every_n_steps`."""

    seam = "estimator"

    def build(self, occupancy: Occupancy | None) -> Any:
        return build_estimator(self.name, aabb=kit.box(), occupancy=occupancy, **self.options)

    def teach(self, sampler: Any, scene: Slab) -> None:
        sampler.train()
        for step in (0, 16):  # at which hosts refresh an occupancy grid, as nerfacc has it
            sampler.update_every_n_steps(step=step, occ_eval_fn=scene.density)

    def sample(
        self, sampler: Any, rays: Rays, scene: Slab = SLAB, *, seed: int = 0, **options: Any
    ) -> Samples:
        torch.manual_seed(seed)
        return self.ask(sampler, rays.copied(), **options)

    def ask(self, sampler: Any, rays: Rays, **options: Any) -> Samples:
        """ray_indices, t_starts, t_ends, as `sampling` returns them."""
        samples = sampler.sampling(
            rays_o=rays.origins,
            rays_d=rays.directions,
            **{
                "t_min": rays.t_min,
                "t_max": rays.t_max,
                "render_step_size": kit.STEP,
                "stratified": sampler.training,
                **options,
            },
        )
        are_three = isinstance(samples, (tuple, list)) and len(samples) == 3
        require(
            are_three and all(isinstance(part, Tensor) for part in samples),
            f"sampling returned {type(samples).__name__} instead of three tensors "
            "(ray_indices, t_starts, t_ends)",
        )
        return samples[0], samples[1], samples[2]

    def colours(self, sampler: Any, rays: Rays, field: Field) -> Tensor:
        def sigma_fn(t_starts: Tensor, t_ends: Tensor, ray_indices: Tensor) -> Tensor:
            return field.density(rays.at(ray_indices, (t_starts + t_ends) / 2.0))

        return kit.render(field, rays, self.sample(sampler, rays, sigma_fn=sigma_fn))


NEAR, FAR = 2.5, 3.4
"""Planes that cut into some of the rays of `cut_short` at either end."""


@checks("signature", "estimator")
def signature(case: EstimatorCase) -> None:
    sampler = case.shared(SLAB)
    samplers.check_module(sampler, "sampling", "update_every_n_steps")
    offered = list(inspect.signature(sampler.sampling).parameters.values())
    takes_anything = {inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD}
    if not takes_anything <= {parameter.kind for parameter in offered}:
        wanted = list(inspect.signature(Estimator.sampling).parameters.values())[1:]
        for number, (given, found) in enumerate(itertools.zip_longest(wanted, offered), 1):
            if given is None:
                break
            fits = found is not None and (found.name, found.default) == (given.name, given.default)
            require(fits, f"argument {number} of sampling is {found}, hosts give '{given}'")
    with raises_nothing("update_every_n_steps(step=, occ_eval_fn=):"):
        inspect.signature(sampler.update_every_n_steps).bind(step=0, occ_eval_fn=SLAB.density)


@checks("shapes-types-devices", "estimator")
def shapes_types_devices(case: EstimatorCase) -> None:
    for device, count in itertools.product(samplers.devices(), kit.COUNTS):
        sampler, rays = case.shared(SLAB).to(device), kit.crossing(count).to(device)
        for training in (False, True):
            given = rays.copied()
            samples = case.ask(sampler.train(training), given)
            samplers.check_rays(given, rays)
            shapes = [list(part.shape) for part in samples]
            require(
                len(shapes[0]) == 1 and shapes[0] == shapes[1] == shapes[2] and shapes[0][0] > 0,
                f"ray_indices, t_starts and t_ends have shapes {shapes}; expected [n_samples] each",
            )
            where = samples[0].device
            require(where == rays.origins.device, f"{kit.PARTS[0]} is on {where}")
            for name, part in zip(kit.PARTS[1:], samples[1:], strict=True):
                samplers.check_tensor(name, part, rays.origins)
        sampler.to("cpu")


@checks("sorted-disjoint-inside", "estimator")
def sorted_disjoint_inside(case: EstimatorCase) -> None:
    sampler, rays = case.shared(SLAB), kit.cut_short()
    for cone_angle in (0.0, 0.02):
        kit.check_intervals(rays, case.sample(sampler, rays, cone_angle=cone_angle))
    many = kit.cut_short(kit.MANY)
    narrower = many._replace(t_min=many.t_min.clamp(min=NEAR), t_max=many.t_max.clamp(max=FAR))
    planes: dict[str, Any] = {
        "near_plane": NEAR,
        "far_plane": FAR,
        "render_step_size": kit.LONG_STEP,
    }
    for training in (False, True):
        kit.check_intervals(narrower, case.sample(sampler.train(training), many, **planes))
    for near, far in ((NEAR, FAR), (0.05, 1e3)):  # the second are Instant-NGP's
        _check_between_planes(case, sampler, near, far)


def _check_between_planes(case: EstimatorCase, sampler: Any, near: float, far: float) -> None:
    """Raises unless rays without limits of their own are sampled from near plane to far plane."""
    rays = kit.crossing()
    planes: dict[str, Any] = {"near_plane": near, "far_plane": far, "t_min": None, "t_max": None}
    ends = torch.full_like(rays.t_min, near), torch.full_like(rays.t_max, far)
    between = Rays(rays.origins, rays.directions, *ends)
    for training in (True, False):
        sampler.train(training)
        with raises_nothing("sampling without t_min and t_max raises"):
            found = case.sample(sampler, rays, **planes)
        kit.check_intervals(between, found)
    expected = case.sample(sampler, between)
    apart = int((~kit.among(expected, found)).sum() + (~kit.among(found, expected)).sum())
    require(
        apart <= ALLOWED_DIFFERENCE * len(expected[0]),
        f"with near_plane {near:g} and far_plane {far:g} in place of t_min and t_max, {apart} of "
        f"{len(expected[0])} samples differ",
    )


@checks("packing-consistent", "estimator")
def packing_consistent(case: EstimatorCase) -> None:
    rays = kit.crossing(kit.MANY)
    ray_indices = case.sample(case.shared(SLAB), rays, render_step_size=kit.LONG_STEP)[0]
    n_rays = len(rays.origins)
    require(ray_indices.dtype == torch.int64, f"ray_indices is {ray_indices.dtype}, not int64")
    low, high = (int(bound) for bound in ray_indices.aminmax())
    inside = low >= 0 and high < n_rays
    require(inside, f"ray_indices go from {low} to {high}; there are {n_rays} rays")
    fall = bool((ray_indices.diff() < 0).any())
    require(
        not fall, "ray_indices fall somewhere: samples of a ray must lie together, rays in order"
    )
    counts = pack_info(ray_indices, n_rays)[:, 1]
    unpacked = torch.arange(n_rays, device=counts.device).repeat_interleave(counts)
    require(unpacked.equal(ray_indices), "pack_info does not give the ray indices back")


@checks("stratified-in-training", "estimator")
def stratified_in_training(case: EstimatorCase) -> None:
    samplers.check_shifts(case)
    sampler, rays = case.shared(kit.EVERYTHING).train(), kit.crossing(kit.MANY)
    ray_indices, t_starts, _ = kit.in_order(
        case.sample(sampler, rays, render_step_size=kit.LONG_STEP)
    )
    shares = ((t_starts - rays.t_min[ray_indices]) / kit.LONG_STEP).remainder(1.0)
    first = torch.searchsorted(ray_indices, ray_indices.unique())
    _check_uniform(shares[first])


def _check_uniform(shares: Tensor) -> None:
    """Raises unless numbers [N] are spread over [0, 1) as uniform random numbers are.

    By the statistic of Kolmogorov and Smirnov, which for these exceeds 4 / sqrt(N) once in 10^13,
    and the correlation of neighbours, which exceeds 6 / sqrt(N) once in 10^8.
    """
    from scipy.stats import ks_1samp, uniform

    n = len(shares)
    apart = float(ks_1samp(shares.cpu().numpy(), uniform.cdf, method="asymp").statistic)
    bound = 4.0 / n**0.5
    require(
        apart <= bound,
        f"the shifts of {n} rays, in steps, are {apart:.2g} away from uniform random numbers, "
        f"which are {bound:.2g} away at most",
    )
    alike = abs(float(torch.corrcoef(torch.stack([shares[:-1], shares[1:]]))[0, 1]))
    require(
        alike <= 1.5 * bound,
        f"the shifts of rays beside each other correlate by {alike:.2g}; each ray has its own",
    )


@checks("zero-samples-well-formed", "estimator")
def zero_samples_well_formed(case: EstimatorCase) -> None:
    sampler = case.shared(SLAB)
    asked: list[dict[str, Any]] = [{}, {"sigma_fn": lambda t_starts, *_: torch.ones_like(t_starts)}]
    empty = [(why, sampler, rays) for why, rays in kit.without_samples().items()]
    if case.needs_occupancy:
        empty.append((kit.KEEPS_NOTHING, case.shared(kit.NOTHING), kit.crossing()))
    for training in (False, True):
        for why, sampler, rays in empty:
            field = Field()
            sampler.train(training)
            for options in asked:
                samples = case.sample(sampler, rays, **options)
                found = [(list(part.shape), part.dtype) for part in samples]
                wanted = [([0], dtype) for dtype in (torch.int64, *[rays.origins.dtype] * 2)]
                require(found == wanted, f"{why}: returned {found}, expected {wanted}")
                colours = kit.render(field, rays, samples)
                background = colours.new_tensor(kit.BACKGROUND).expand_as(colours)
                shown = torch.allclose(colours, background)
                require(shown, f"{why}: the background is not what is rendered")
                colours.sum().backward()
                samplers.check_gradients(field, why)


ALLOWED_DIFFERENCE = 0.005
"""Share of all samples that a rounding at the sides of the box may add or take away."""
CONE_ANGLE = 0.02
"""Growth of the steps with distance, which makes them half as long again at the far end."""


@checks("skips-only-what-it-may", "estimator")
def skips_only_what_it_may(case: EstimatorCase) -> None:
    scenes = [
        (SLAB, kit.STEP, kit.crossing()),
        (SLAB, kit.STEP, kit.stretched()),
        (SLAB, kit.STEP, kit.within()),
        (kit.TWO, kit.LONG_STEP, kit.crossing(kit.MANY)),
    ]
    if case.needs_occupancy:  # the host's box is not where an unbounded scene ends
        scenes.append((kit.AROUND, kit.STEP, kit.leaving()))
    for training, (scene, step, rays) in itertools.product((False, True), scenes):
        samples = case.sample(case.shared(scene).train(training), rays, render_step_size=step)
        if case.needs_occupancy:
            _check_skipped_is_not(rays, samples, scene)
        _check_kept_is_sampled(rays, samples, scene, step, training)


def _check_skipped_is_not(rays: Rays, samples: Samples, scene: Slab) -> None:
    positions = rays.at(samples[0], (samples[1] + samples[2]) / 2.0)
    outside = scene.depth(positions) < -kit.MARGIN
    where = _first(positions[outside])
    require_none(outside, f"{{}} samples lie where the occupancy is empty{where}")


def _check_kept_is_sampled(
    rays: Rays, samples: Samples, scene: Slab = SLAB, step: float = kit.STEP, shifted: bool = False
) -> None:
    """Raises unless every candidate that lies plainly in a slab is in a sample's interval.

    The middles of shifted samples are half a step away, and the ends of a ray may have none.
    """
    ray_indices, middles = _plainly_kept(rays, scene, step, shifted)
    missing = ~kit.covered(ray_indices, middles, samples)
    where = _first(rays.at(ray_indices, middles)[missing])
    require_none(missing, f"{{}} places are not sampled although they are occupied{where}")


@functools.lru_cache(maxsize=32)
def _plainly_kept(rays: Rays, scene: Slab, step: float, shifted: bool) -> tuple[Tensor, Tensor]:
    """Rays and middles of the candidates that `_check_kept_is_sampled` seeks, [N] each."""
    ray_indices, t_starts, t_ends = kit.dense(rays, step=step, unbounded=scene.unbounded)
    middles = (t_starts + t_ends) / 2.0
    from_ends = torch.minimum(middles - rays.t_min[ray_indices], rays.t_max[ray_indices] - middles)
    sought = scene.depth(rays.at(ray_indices, middles)) > kit.MARGIN + shifted * step / 2.0
    sought &= from_ends > shifted * step
    return ray_indices[sought], middles[sought]


def _first(positions: Tensor) -> str:
    where = [[round(value, 2) for value in position.tolist()] for position in positions[:1]]
    return "".join(f", the first at {position}" for position in where)


@checks("all-kept-equals-dense", "estimator")
def all_kept_equals_dense(case: EstimatorCase) -> None:
    rays, few, sampler = kit.crossing(), kit.crossing(4), case.shared(kit.EVERYTHING)
    for training, cone_angle in itertools.product((False, True), (0.0, CONE_ANGLE)):
        options: dict[str, Any] = {"cone_angle": cone_angle, "stratified": False}
        samples = case.sample(sampler.train(training), rays, **options)
        expected = kit.dense(rays, cone_angle)
        missing = int((~kit.among(expected, samples)).sum())
        extra = int((~kit.among(samples, expected)).sum())
        require(
            missing + extra <= ALLOWED_DIFFERENCE * len(expected[0]),
            f"with cone_angle {cone_angle:g}{', in training without stratified,' * training} "
            f"{missing} of {len(expected[0])} candidates are missing, {extra} samples are none of "
            "them",
        )
    found = len(case.sample(sampler.eval(), few, render_step_size=kit.SHORT_STEP)[0])
    count = len(kit.dense(few, step=kit.SHORT_STEP)[0])
    require(
        abs(found - count) <= ALLOWED_DIFFERENCE * count,
        f"of {count} candidates on {len(few.origins)} rays {found} are sampled",
    )


@checks("update-while-frozen-is-harmless", "estimator")
def update_while_frozen_is_harmless(case: EstimatorCase) -> None:
    sampler, rays = case.shared(SLAB), kit.crossing()
    before = case.sample(sampler, rays)
    sampler.train()
    answer = kit.NOTHING.density if case.needs_occupancy else SLAB.density
    thresholds = {"occ_thre": 1e-2, "ema_decay": 0.95, "warmup_steps": 256, "n": 16}
    # as nerfstudio and nerfacc's examples call it; steps in and after nerfacc's warm-up
    named = {"occ_eval_fn": answer}
    forms: tuple[tuple[str, tuple[Any, ...], dict[str, Any]], ...] = (
        ("step=, occ_eval_fn=", (), {"step": 16, **named}),
        ("step, occ_eval_fn", (272, answer), {}),
        ("step=, occ_eval_fn=, occ_thre=", (), {"step": 288, **named, "occ_thre": 1e-2}),
        ("step, occ_eval_fn and all options", (304, answer), thresholds),
    )
    for form, arguments, options in forms:
        with raises_nothing(f"update_every_n_steps({form}) raises"):
            sampler.update_every_n_steps(*arguments, **options)
    after = case.sample(sampler.eval(), rays)
    if case.needs_occupancy:
        require(kit.same(before, after), "updates with an empty field changed what is sampled")
    else:
        _check_kept_is_sampled(rays, after)


SLACK = 1e-3
"""Relative distance from a threshold at which a rounding does not decide."""
LOWEST_CAP = 0.1
"""Of the mean opacity of all samples: the least that an opacity threshold may be lowered to."""


@checks("visibility-pruning", "estimator")
def visibility_pruning(case: EstimatorCase) -> None:
    rays, sampler = kit.crossing(), case.shared(kit.EVERYTHING)
    for training in (False, True):
        sampler.train(training)
        plain = kit.in_order(case.sample(sampler, rays, stratified=False))
        for limits in ((0.0, 0.0), (1e-2, 0.0), (0.0, 1e-2), (1e-2, 1e-2)):
            _check_pruned(case, sampler, rays, plain, *limits)


def _check_pruned(
    case: EstimatorCase, sampler: Any, rays: Rays, plain: Samples, eps: float, alpha_thre: float
) -> None:
    ray_indices, t_starts, t_ends = plain
    densities = _wall(rays, t_starts, t_ends, ray_indices)
    light, alphas = render_transmittance_from_density(
        t_starts, t_ends, densities, ray_indices=ray_indices, n_rays=len(rays.origins)
    )
    visible = light >= eps * (1.0 + SLACK)
    visible &= alphas >= alpha_thre * (1.0 + SLACK)
    dark = light < eps * (1.0 - SLACK)
    faint = alphas < min(alpha_thre, LOWEST_CAP * float(alphas.mean())) * (1.0 - SLACK)
    limits = {"early_stop_eps": eps, "alpha_thre": alpha_thre}

    def alpha_fn(t_starts: Tensor, t_ends: Tensor, ray_indices: Tensor) -> Tensor:
        return 1.0 - torch.exp(-_wall(rays, t_starts, t_ends, ray_indices) * (t_ends - t_starts))

    for name, function in (("sigma_fn", functools.partial(_wall, rays)), ("alpha_fn", alpha_fn)):
        options: dict[str, Any] = {name: function, "stratified": False, **limits}
        kept = kit.among(plain, case.sample(sampler, rays, **options))
        given = f"with {name}, early_stop_eps {eps} and alpha_thre {alpha_thre}"
        require_none(~kept[visible], f"{given}: {{}} visible samples are dropped")
        require_none(kept[dark], f"{given}: {{}} samples in the dark are kept")
        require_none(kept[faint], f"{given}: {{}} samples too faint to be seen are kept")


def _wall(rays: Rays, t_starts: Tensor, t_ends: Tensor, ray_indices: Tensor) -> Tensor:
    """A thin fog with an opaque slab in it: density of samples, [N]."""
    positions = rays.at(ray_indices, (t_starts + t_ends) / 2.0)
    return 0.05 + SLAB.density(positions)[:, 0] / kit.STEP
