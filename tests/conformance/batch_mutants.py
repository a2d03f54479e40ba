"""Estimators that are broken only in large batches, in training, between slabs, or for some rays
and calls.
"""

from __future__ import annotations

import copy
from typing import Any

import torch
from conformance.estimator_mutants import SKIPS, Answers, Sound
from torch import Tensor

from leco_plugin.conformance.scene import DISTANCE, box
from leco_plugin.samplers.marching import Samples
from leco_plugin.samplers.registry import SamplerSpec


class ReversedOnce(Answers):
    """One interval on one ray in 10,000 ends before it begins."""

    def change(self, ray_indices: Tensor, t_starts: Tensor, t_ends: Tensor) -> Samples:
        last = (ray_indices % 10_000 == 9_999).nonzero()[:1, 0]
        starts, ends = t_starts.clone(), t_ends.clone()
        starts[last], ends[last] = t_ends[last], t_starts[last]
        return ray_indices, starts, ends


class WithoutNearPlaneInTraining(Sound):
    """The shift begins at t_min again."""

    def sampling(self, rays_o: Tensor, rays_d: Tensor, *args: Any, **options: Any) -> Samples:
        near = options.pop("near_plane", 0.0) * (not options.get("stratified", False))
        return super().sampling(rays_o, rays_d, *args, near_plane=near, **options)


class WithoutFarPlaneInTraining(Sound):
    def sampling(self, rays_o: Tensor, rays_d: Tensor, *args: Any, **options: Any) -> Samples:
        far = 1e10 if options.get("stratified", False) else options.pop("far_plane", 1e10)
        return super().sampling(rays_o, rays_d, *args, **(options | {"far_plane": far}))


class OffsetForgotten(Answers):
    """Takes 1,000 rays at a time, and each piece counts them from 0."""

    def change(self, ray_indices: Tensor, t_starts: Tensor, t_ends: Tensor) -> Samples:
        return ray_indices % 1_000, t_starts, t_ends


class PiecesOfTheFirst(Sound):
    """Takes 1,000 rays at a time: each piece is sampled where the first one is."""

    def sampling(self, rays_o: Tensor, rays_d: Tensor, *args: Any, **options: Any) -> Samples:
        of_first = torch.arange(len(rays_o)) % 1_000
        limits = {name: options[name][of_first] for name in ("t_min", "t_max")}
        rays = rays_o[of_first], rays_d[of_first]
        return super().sampling(*rays, *args, **(options | limits))


class ShortRunsDropped(Answers):
    """What is kept for fewer than three steps is taken for noise."""

    def change(self, ray_indices: Tensor, t_starts: Tensor, t_ends: Tensor) -> Samples:
        begins = torch.ones_like(ray_indices, dtype=torch.bool)
        begins[1:] = ray_indices[1:] != ray_indices[:-1]
        begins[1:] |= t_starts[1:] > t_ends[:-1] + 1e-4
        runs = begins.cumsum(0) - 1
        kept = runs.bincount()[runs] >= 3
        return ray_indices[kept], t_starts[kept], t_ends[kept]


class FirstRunOnly(Answers):
    """A ray ends with the first thing that it meets."""

    def change(self, ray_indices: Tensor, t_starts: Tensor, t_ends: Tensor) -> Samples:
        gaps = torch.zeros_like(ray_indices)
        follows = ray_indices[1:] == ray_indices[:-1]
        gaps[1:] = (follows & (t_starts[1:] > t_ends[:-1] + 1e-4)).long()
        before = gaps.cumsum(0)
        first = torch.searchsorted(ray_indices, ray_indices)
        kept = before == before[first]
        return ray_indices[kept], t_starts[kept], t_ends[kept]


class Jittered(Sound):
    """Shifts rays by shares of a step, [n_rays], of its own."""

    def sampling(self, rays_o: Tensor, rays_d: Tensor, *args: Any, **options: Any) -> Samples:
        if options.get("stratified", False):
            options["stratified"] = False
            shift = options["render_step_size"] * self.shares(len(rays_o))
            near = torch.full_like(shift, options.get("near_plane", 0.0))
            begins = near if options["t_min"] is None else options["t_min"].maximum(near)
            options["t_min"] = begins + shift
        return super().sampling(rays_o, rays_d, *args, **options)

    def shares(self, n_rays: int) -> Tensor:
        raise NotImplementedError


class OneJitter(Jittered):
    """All rays are shifted alike."""

    def shares(self, n_rays: int) -> Tensor:
        return torch.rand(()).expand(n_rays)


class SharedByTwo(Jittered):
    """Every other ray is shifted as the one before it."""

    def shares(self, n_rays: int) -> Tensor:
        return torch.rand((n_rays + 1) // 2).repeat_interleave(2)[:n_rays]


class HalfAStep(Jittered):
    """What lies in the second half of a step is never where a sample begins."""

    def shares(self, n_rays: int) -> Tensor:
        return 0.5 * torch.rand(n_rays)


class NearerByPreference(Jittered):
    """Shifts are more often small than large."""

    def shares(self, n_rays: int) -> Tensor:
        return torch.rand(n_rays) ** 1.2


class OfSomeRays(Sound):
    """Rays that are no `usable` ones are taken to miss the box."""

    def sampling(self, rays_o: Tensor, rays_d: Tensor, *args: Any, **options: Any) -> Samples:
        ray_indices, t_starts, t_ends = super().sampling(rays_o, rays_d, *args, **options)
        kept = self.usable(rays_o, rays_d)[ray_indices]
        return ray_indices[kept], t_starts[kept], t_ends[kept]

    def usable(self, origins: Tensor, directions: Tensor) -> Tensor:
        raise NotImplementedError


class FromOutsideOnly(OfSomeRays):
    def usable(self, origins: Tensor, directions: Tensor) -> Tensor:
        low, high = box().view(2, 3)
        return ((origins < low) | (origins > high)).any(dim=-1)


class NotAlongAxes(OfSomeRays):
    """Divides by the directions."""

    def usable(self, origins: Tensor, directions: Tensor) -> Tensor:
        return (directions != 0.0).all(dim=-1)


class SetsTheSeed(Sound):
    """Draws the same numbers for each test image, and for each training step after one."""

    def sampling(self, rays_o: Tensor, rays_d: Tensor, *args: Any, **options: Any) -> Samples:
        if not options.get("stratified", False):
            torch.manual_seed(0)
        return super().sampling(rays_o, rays_d, *args, **options)


class AtMostAThousand(Answers):
    """Has room for so many samples of a ray."""

    def change(self, ray_indices: Tensor, t_starts: Tensor, t_ends: Tensor) -> Samples:
        places = torch.arange(len(ray_indices)) - torch.searchsorted(ray_indices, ray_indices)
        kept = places < 1_024
        return ray_indices[kept], t_starts[kept], t_ends[kept]


class Squeezes(Sound):
    """Takes a batch of one ray for a ray."""

    def sampling(self, rays_o: Tensor, rays_d: Tensor, *args: Any, **options: Any) -> Samples:
        return super().sampling(rays_o.squeeze(0), rays_d, *args, **options)


class InTheBoxInTraining(Answers):
    """Takes an unbounded scene to end where its contraction begins, while it learns."""

    def change(self, ray_indices: Tensor, t_starts: Tensor, t_ends: Tensor) -> Samples:
        kept = (t_starts < 2.0 * DISTANCE) | (not self.training)
        return ray_indices[kept], t_starts[kept], t_ends[kept]


class StandInWhereNothingIsKept(Sound):
    """One sample for rays that meet the box, when there is none."""

    def sampling(self, rays_o: Tensor, rays_d: Tensor, *args: Any, **options: Any) -> Samples:
        samples = super().sampling(rays_o, rays_d, *args, **options)
        met = self.occupancy.space.map(rays_o + DISTANCE * rays_d).abs().amax(dim=-1) < 1.0
        if len(samples[0]) or not bool((met & (options["t_min"] < options["t_max"])).any()):
            return samples
        return torch.zeros(1, dtype=torch.int64), rays_o.new_zeros(1), rays_o.new_ones(1)


class KeepsAllWithoutLimits(Sound):
    """Skips nothing where rays have no limits of their own, as those of Instant-NGP."""

    unlimited = False

    def sampling(self, rays_o: Tensor, rays_d: Tensor, *args: Any, **options: Any) -> Samples:
        self.unlimited = options["t_min"] is None
        return super().sampling(rays_o, rays_d, *args, **options)

    def occupied(self, positions: Tensor) -> Tensor:
        return super().occupied(positions) | self.unlimited


class ShakenUnasked(Sound):
    """Shifts rays in training, though a host wants them where they are."""

    def sampling(self, rays_o: Tensor, rays_d: Tensor, *args: Any, **options: Any) -> Samples:
        options["stratified"] = self.training
        return super().sampling(rays_o, rays_d, *args, **options)


class AsFirstAsked(Sound):
    """Goes on deciding by what it held when it was first asked."""

    def occupied(self, positions: Tensor) -> Tensor:
        if "first" not in self.__dict__:
            self.__dict__["first"] = copy.deepcopy(self.occupancy)
        decided: Tensor = self.__dict__["first"].occupied(positions)
        return decided


MUTANTS: dict[str, tuple[type, ...]] = {
    "shapes-types-devices": (Squeezes,),
    "zero-samples-well-formed": (StandInWhereNothingIsKept,),
    "sorted-disjoint-inside": (
        ReversedOnce,
        WithoutNearPlaneInTraining,
        WithoutFarPlaneInTraining,
        KeepsAllWithoutLimits,
    ),
    "packing-consistent": (OffsetForgotten,),
    "deterministic-in-eval": (SetsTheSeed,),
    "all-kept-equals-dense": (AtMostAThousand, ShakenUnasked),
    "state-dict-round-trip": (AsFirstAsked,),
    "stratified-in-training": (OneJitter, SharedByTwo, HalfAStep, NearerByPreference),
    SKIPS: (
        PiecesOfTheFirst,
        ShortRunsDropped,
        FirstRunOnly,
        FromOutsideOnly,
        NotAlongAxes,
        InTheBoxInTraining,
    ),
}
"""By the rule that must fail."""

ALSO: dict[type, set[str]] = {
    ReversedOnce: {SKIPS},
    OffsetForgotten: {SKIPS, "sorted-disjoint-inside"},
    PiecesOfTheFirst: {"sorted-disjoint-inside"},
}
"""What else cannot hold for a mutant."""


def __getattr__(name: str) -> SamplerSpec:
    """Entry points name a class in lower case: its specification."""
    for mutant in (mutant for family in MUTANTS.values() for mutant in family):
        if mutant.__name__.lower() == name:
            return SamplerSpec(mutant.__name__, estimator=mutant, needs_occupancy=True)
    raise AttributeError(name)
