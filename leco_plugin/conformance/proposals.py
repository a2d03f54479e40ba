"""Samplers at the seam of proposal hosts, called as nerfstudio's nerfacto calls its own."""

from __future__ import annotations

import functools
import itertools
from typing import Any

import torch
from torch import Tensor

from leco_plugin.conformance import samplers
from leco_plugin.conformance import scene as kit
from leco_plugin.conformance.rules import Broken, checks, require
from leco_plugin.conformance.samplers import SamplerCase
from leco_plugin.conformance.scene import SLAB, Field, Rays, Slab
from leco_plugin.log import counted
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

    def answer(
        self, sampler: Any, rays: Rays, scene: Slab = SLAB, density: Any = None
    ) -> tuple[Any, Any, Any]:
        """ray_samples, weights_list and ray_samples_list, as a host gets them whose density_fns are
        of this density, or that of the scene."""
        return self.ask(sampler, ray_bundle(rays.copied()), density or scene.density)

    def ask(self, sampler: Any, rays: Any, density: Any = SLAB.density) -> tuple[Any, Any, Any]:
        """The same of a bundle of rays."""
        answer = sampler(rays, density_fns=[density] * LEVELS)
        require(
            isinstance(answer, (tuple, list)) and len(answer) == 3,
            f"the call returned {type(answer).__name__} instead of ray_samples, weights_list and "
            "ray_samples_list",
        )
        return answer[0], answer[1], answer[2]

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
        return colours + (1.0 - weights.sum(dim=-2)) * colours.new_tensor(kit.BACKGROUND)


def no_density(*_: Any, **__: Any) -> None:
    """Stands for the proposal networks of a guided host. Always raises `Broken`."""
    raise Broken("density_fns are called, and a guided host has no proposal networks to answer")


def ray_bundle(rays: Rays) -> Any:
    """Rays as nerfstudio hands them to a sampler, each of a camera and at a time of its own."""
    from nerfstudio.cameras.rays import RayBundle

    numbers = torch.arange(len(rays.t_min), device=rays.t_min.device)[:, None]
    return RayBundle(
        origins=rays.origins,
        directions=rays.directions,
        pixel_area=torch.full_like(rays.t_min, 1e-6)[:, None],
        nears=rays.t_min[:, None],
        fars=rays.t_max[:, None],
        camera_indices=numbers,
        times=numbers.to(rays.t_min),
        metadata={"numbers": numbers},
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


NEARBY = 0.25
"""World units beyond what is kept where a sample may lie: a histogram is as fine as its cells."""
CHORD = 0.8
"""World units that a ray spends in the slab at least, for what is asked of its samples."""
INSIDE = 0.9
"""Share of a ray's samples that must lie in or near what is kept."""
UNREACHED = 0.1
"""Share of a ray, in the host's spacing, that may be left out at either end."""
UNEVEN = 1.5
"""In units of their mean, how far places may be from evenly spaced when everything is kept."""


@checks("signature", "proposal")
def signature(case: ProposalCase) -> None:
    sampler = case.shared(SLAB)
    samplers.check_module(sampler, "set_anneal", "step_cb")
    density = no_density if case.needs_occupancy else None
    ray_samples, weights, candidates = case.answer(sampler, kit.crossing(), density=density)
    found = type(ray_samples).__name__
    require(hasattr(ray_samples, "frustums"), f"the first of three is {found}, not RaySamples")
    for name, found in (("weights_list", weights), ("ray_samples_list", candidates)):
        require(isinstance(found, list), f"{name} is {type(found).__name__}; hosts append to it")


@checks("shapes-types-devices", "proposal")
def shapes_types_devices(case: ProposalCase) -> None:
    for device, count in itertools.product(samplers.devices(), kit.COUNTS):
        sampler, rays = case.shared(SLAB).to(device), kit.crossing(count).to(device)
        given = rays.copied()
        ray_samples, weights, candidates = case.ask(sampler, ray_bundle(given))
        samplers.check_rays(given, rays)
        require(
            len(weights) == len(candidates) == LEVELS,
            f"{LEVELS} density_fns got {len(weights)} weights and {len(candidates)} samples",
        )
        starts, ends = _edges(ray_samples)
        require(isinstance(ray_samples.deltas, Tensor), "ray_samples have no deltas")
        _check_tensors("ray_samples", rays, starts, ends, ray_samples.deltas)
        apart = float((ray_samples.deltas - (ends - starts)).abs().max())
        require(
            apart <= kit.ROUNDING, f"deltas differ from the samples' lengths by up to {apart:.2g}"
        )
        _check_described(ray_samples, ray_bundle(rays))
        for level in range(LEVELS):
            starts, ends = _edges(candidates[level])
            _check_tensors(f"level {level}", rays, starts, ends, weights[level])
            require(bool((weights[level] >= 0.0).all()), f"level {level} has weights below 0")
        sampler.to("cpu")


def _check_described(ray_samples: Any, rays: Any) -> None:
    """Raises unless samples carry what a field may ask of their rays."""
    metadata, numbers = ray_samples.metadata or {}, rays.metadata["numbers"]
    for name, found, given in (
        ("camera_indices", ray_samples.camera_indices, rays.camera_indices),
        ("times", ray_samples.times, rays.times),
        ("metadata", metadata.get("numbers"), numbers),
    ):
        require(found is not None, f"the rays have {name}, and their samples have none")
        wanted = given[:, None].expand_as(ray_samples.frustums.starts)
        equal = found is not None and torch.equal(found, wanted)
        require(equal, f"{name} of samples are not those of their rays")


def _edges(ray_samples: Any) -> tuple[Tensor, Tensor]:
    return ray_samples.frustums.starts, ray_samples.frustums.ends


def _check_tensors(where: str, rays: Rays, *tensors: Tensor) -> None:
    shapes = [list(tensor.shape) for tensor in tensors]
    n_samples = shapes[0][1] if len(shapes[0]) == 3 else 0
    expected = [len(rays.origins), n_samples, 1]
    require(
        n_samples > 0 and all(shape == expected for shape in shapes),
        f"{where}: shapes {shapes}, expected [{len(rays.origins)}, n_samples, 1]",
    )
    for tensor in tensors:
        samplers.check_tensor(f"{where}: a tensor", tensor, rays.origins)


@checks("sorted-disjoint-inside", "proposal")
def sorted_disjoint_inside(case: ProposalCase) -> None:
    rays = kit.cut_short()
    ray_samples, _, candidates = case.answer(case.shared(SLAB), rays)
    for samples in (packed(ray_samples), *map(packed, candidates)):
        kit.check_intervals(rays, samples)
        beyond = samples[2] > rays.t_max[samples[0]] + kit.ROUNDING
        require(
            not bool(beyond.any()),
            f"{counted(int(beyond.sum()), 'sample ends', 'samples end')} beyond a ray's far end",
        )
    kit.check_order(packed(case.answer(case.shared(SLAB).train(), rays)[0]))


@checks("skips-only-what-it-may", "proposal")
def skips_only_what_it_may(case: ProposalCase) -> None:
    for training in (False, True):
        _check_gathered(case, case.shared(SLAB).train(training), kit.crossing())
        if case.needs_occupancy:
            around = case.shared(kit.AROUND).train(training)
            _check_gathered(case, around, kit.leaving(), kit.AROUND)
    _check_gathered(case, case.shared(SLAB), kit.within())
    if case.needs_occupancy:
        try:
            moved = case.build(SLAB.occupancy(case.gate_encoding, kit.MOVED), frame=kit.MOVED)
        except TypeError as error:
            raise Broken(f"no host in other coordinates can have it (frame=): {error}") from error
        _check_gathered(case, moved.eval(), kit.crossing())


def _check_gathered(case: ProposalCase, sampler: Any, rays: Rays, scene: Slab = SLAB) -> None:
    enters, leaves = chords(rays, scene)
    long = leaves - enters >= CHORD
    ray_indices, t_starts, t_ends = case.sample(sampler, rays)
    middles = (t_starts + t_ends) / 2.0
    depths = scene.depth(rays.at(ray_indices, middles)).view(len(rays.origins), -1)[long]
    middles = middles.view(len(rays.origins), -1)[long]
    inside = depths > 0.0
    without = int((~inside.any(dim=1)).sum())
    require(
        without == 0, f"{counted(without, 'ray has', 'rays have')} no sample in what is occupied"
    )
    if not case.needs_occupancy:
        return
    least = float((depths > -NEARBY).float().mean(dim=1).min())
    require(least >= INSIDE, f"a ray has {least:.0%} of its samples in or near what is kept")
    halfway = ((enters + leaves) / 2.0)[long, None]
    for half, there in (("near", middles < halfway), ("far", middles > halfway)):
        bare = int((~(inside & there).any(dim=1)).sum())
        some = counted(bare, "ray has", "rays have")
        require(bare == 0, f"{some} no sample in the {half} half of what is kept")


@functools.lru_cache(maxsize=32)
def chords(rays: Rays, scene: Slab = SLAB) -> tuple[Tensor, Tensor]:
    """Where each ray enters and leaves the slab, [n_rays] each, to a hundredth; 0 if never. One
    without end is left at `FAR_AWAY`."""
    t = torch.arange(0.0, kit.FAR_AWAY if scene.unbounded else 8.0, 0.01)
    positions = rays.origins[:, None] + rays.directions[:, None] * t[:, None]
    inside = scene.depth(positions) >= 0.0
    first, last = inside.int().argmax(dim=1), len(t) - 1 - inside.flip(1).int().argmax(dim=1)
    met = inside.any(dim=1)
    return t[first] * met, t[last] * met


@checks("all-kept-equals-dense", "proposal")
def all_kept_equals_dense(case: ProposalCase) -> None:
    rays = kit.cut_short()  # which lie within the box: outside it nothing is occupied
    ray_samples, _, _ = case.answer(case.shared(kit.EVERYTHING), rays, kit.EVERYTHING)
    starts, ends = ray_samples.spacing_starts, ray_samples.spacing_ends
    require(starts is not None and ends is not None, "ray_samples have no spacing_starts and ends")
    reaches = float(starts.amin(dim=1).max()), float(ends.amax(dim=1).min())
    require(
        reaches[0] <= UNREACHED and reaches[1] >= 1.0 - UNREACHED,
        f"a ray is sampled from {reaches[0]:.0%} to {reaches[1]:.0%} of it only",
    )
    if not case.needs_occupancy:
        return  # weights of a density depend on what lies in front
    places = ((starts + ends) / 2.0).view(len(rays.origins), -1)
    n_samples = places.shape[1]
    even = (torch.arange(n_samples) + 0.5) / n_samples
    farthest = float((places - even).abs().max()) * n_samples
    require(
        farthest <= UNEVEN,
        f"a sample is {farthest:.1f} places away from where even spacing would have it",
    )


@checks("zero-samples-well-formed", "proposal")
def zero_samples_well_formed(case: ProposalCase) -> None:
    sampler, without = case.shared(SLAB), kit.without_samples()
    for training in (False, True):
        sampler.train(training)
        for why in ("no rays", "rays that miss the box"):
            rays, field = without[why], Field()
            ray_samples, weights, candidates = case.answer(sampler, rays)
            starts, ends = _edges(ray_samples)
            _check_tensors(why, rays, starts, ends)
            for level_weights, level in zip(weights, candidates, strict=True):
                _check_tensors(why, rays, *_edges(level), level_weights)
            if len(rays.origins):
                kit.check_intervals(rays, packed(ray_samples))
            case.colours(sampler, rays, field).sum().backward()
            samplers.check_gradients(field, why)


@checks("update-while-frozen-is-harmless", "proposal")
def update_while_frozen_is_harmless(case: ProposalCase) -> None:
    sampler, rays = case.shared(SLAB), kit.crossing()
    before = case.sample(sampler, rays)
    sampler.train()
    for step, anneal in ((0, 0.0), (100, 0.3), (2000, 1.0)):
        sampler.set_anneal(anneal)
        sampler.step_cb(step)
        case.sample(sampler, rays)
    after = case.sample(sampler.eval(), rays)
    if case.needs_occupancy:
        require(kit.same(before, after), "set_anneal and step_cb changed what is sampled")
