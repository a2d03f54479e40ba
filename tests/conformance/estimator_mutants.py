"""Estimators that are broken in one way each, and the rule that must say so.

They stand in a distribution of their own (`mutant_plugin.py`), so that processes of the two-process
rule find them as they find anybody's.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from leco_plugin.conformance.scene import STEP
from leco_plugin.occupancy import Occupancy
from leco_plugin.samplers.estimator import LearnedOccupancyEstimator
from leco_plugin.samplers.marching import Samples
from leco_plugin.samplers.registry import SamplerSpec


class Sound(LearnedOccupancyEstimator):
    """What all others are but for one thing: no cell cache, so that building takes no time."""

    def __init__(self, aabb: Tensor, occupancy: Occupancy) -> None:
        super().__init__(occupancy, cache_bytes=0)


class RaysInAnotherOrder(Sound):
    """Directions before origins: right for whoever names its arguments."""

    def sampling(self, rays_d: Tensor, rays_o: Tensor, **options: Any) -> Samples:
        return super().sampling(rays_o, rays_d, **options)


class AnotherDefault(Sound):
    """A host that leaves the far plane out gets other samples than it had."""

    def sampling(
        self,
        rays_o: Tensor,
        rays_d: Tensor,
        sigma_fn: Any = None,
        alpha_fn: Any = None,
        near_plane: float = 0.0,
        far_plane: float = 1.0,
        **options: Any,
    ) -> Samples:
        options["far_plane"] = 1e10 if far_plane == 1.0 else far_plane
        return super().sampling(rays_o, rays_d, sigma_fn, alpha_fn, near_plane, **options)


class NoTorchModule:
    """Has both verbs, but no host can move it, save it or switch it to evaluation."""

    def __init__(self, aabb: Tensor, occupancy: Occupancy) -> None:
        self.inner = Sound(aabb, occupancy)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.inner, name)

    def train(self, mode: bool = True) -> NoTorchModule:
        self.inner.train(mode)
        return self

    def eval(self) -> NoTorchModule:
        return self.train(False)

    def to(self, device: Any) -> NoTorchModule:
        self.inner.to(device)
        return self


class Answers(Sound):
    """Changes what is returned, unless densities were asked for or nothing was found."""

    def sampling(self, rays_o: Tensor, rays_d: Tensor, *args: Any, **options: Any) -> Samples:
        samples = super().sampling(rays_o, rays_d, *args, **options)
        asked = options.get("sigma_fn") is not None or options.get("alpha_fn") is not None
        return samples if asked or len(samples[0]) == 0 else self.change(*samples)

    def change(self, ray_indices: Tensor, t_starts: Tensor, t_ends: Tensor) -> Samples:
        raise NotImplementedError


class DoubleStarts(Answers):
    def change(self, ray_indices: Tensor, t_starts: Tensor, t_ends: Tensor) -> Samples:
        return ray_indices, t_starts.double(), t_ends


class WritesIntoRays(Sound):
    """Which a host goes on using, to place its backdrop for instance."""

    def sampling(self, rays_o: Tensor, rays_d: Tensor, *args: Any, **options: Any) -> Samples:
        samples = super().sampling(rays_o, rays_d, *args, **options)
        if options.get("t_max") is not None:
            options["t_max"].mul_(0.5)
        return samples


class FarFirst(Answers):
    def change(self, ray_indices: Tensor, t_starts: Tensor, t_ends: Tensor) -> Samples:
        order = (ray_indices * 1e3 - t_starts).argsort()
        return ray_indices[order], t_starts[order], t_ends[order]


class Overlapping(Answers):
    """Each interval is as long as two steps."""

    def change(self, ray_indices: Tensor, t_starts: Tensor, t_ends: Tensor) -> Samples:
        return ray_indices, t_starts, 2.0 * t_ends - t_starts


class ShortIndices(Answers):
    def change(self, ray_indices: Tensor, t_starts: Tensor, t_ends: Tensor) -> Samples:
        return ray_indices.int(), t_starts, t_ends


class RaysInPieces(Answers):
    """The second half of the rays comes first."""

    def change(self, ray_indices: Tensor, t_starts: Tensor, t_ends: Tensor) -> Samples:
        later = (ray_indices >= 24).nonzero()[:, 0]
        order = torch.cat([later, (ray_indices < 24).nonzero()[:, 0]])
        return ray_indices[order], t_starts[order], t_ends[order]


class AlwaysShaking(Answers):
    """By less than can matter, which is how such a thing goes unnoticed."""

    def change(self, ray_indices: Tensor, t_starts: Tensor, t_ends: Tensor) -> Samples:
        shift = 1e-5 * torch.rand(()) * (not self.training)
        return ray_indices, t_starts + shift, t_ends + shift


class ShakenOutOfBounds(Sound):
    """A shift that comes after the ends of the rays were looked at."""

    def sampling(self, rays_o: Tensor, rays_d: Tensor, *args: Any, **options: Any) -> Samples:
        shift = torch.rand(()) * options.get("stratified", False)
        options["stratified"] = False
        ray_indices, t_starts, t_ends = super().sampling(rays_o, rays_d, *args, **options)
        return ray_indices, t_starts + shift, t_ends + shift


class KeepsAll(Sound):
    def occupied(self, positions: Tensor) -> Tensor:
        return torch.ones(len(positions), dtype=torch.bool)


class KeepsTooLittle(Sound):
    """Asks for more than the calibrated threshold."""

    def occupied(self, positions: Tensor) -> Tensor:
        return self.occupancy.query(positions) >= 0.995


class KeepsAllInTraining(Sound):
    """And shows in evaluation, where a user looks, what it should have done."""

    def occupied(self, positions: Tensor) -> Tensor:
        decided = super().occupied(positions)
        return decided | self.training


class Normalises(Sound):
    """Takes directions for unit vectors, which those of a host in other units are not."""

    def sampling(self, rays_o: Tensor, rays_d: Tensor, *args: Any, **options: Any) -> Samples:
        directions = torch.nn.functional.normalize(rays_d, dim=-1)
        return super().sampling(rays_o, directions, *args, **options)


class DropsTheFirst(Answers):
    """A cell that a ray is just entering is forgotten."""

    def change(self, ray_indices: Tensor, t_starts: Tensor, t_ends: Tensor) -> Samples:
        kept = torch.ones_like(ray_indices, dtype=torch.bool)
        kept[1:] = ray_indices[1:] == ray_indices[:-1]
        return ray_indices[kept], t_starts[kept], t_ends[kept]


class GateThaws(Sound):
    def __init__(self, aabb: Tensor, occupancy: Occupancy) -> None:
        super().__init__(aabb, occupancy)
        occupancy.gate.requires_grad_(True)


class GradientsSwitchedOff(Sound):
    def sampling(self, rays_o: Tensor, rays_d: Tensor, *args: Any, **options: Any) -> Samples:
        samples = super().sampling(rays_o, rays_d, *args, **options)
        if self.training and len(samples[0]):
            torch.set_grad_enabled(False)
        return samples


class CarriesAGraph(Sound):
    """Distances are computed from origins outside of torch.no_grad."""

    def sampling(self, rays_o: Tensor, rays_d: Tensor, *args: Any, **options: Any) -> Samples:
        ray_indices, t_starts, t_ends = super().sampling(rays_o, rays_d, *args, **options)
        nothing = 0.0 * rays_o[ray_indices].sum(dim=-1)
        return ray_indices, t_starts + nothing, t_ends + nothing


class StandInSample(Sound):
    """One sample when there is none, as nerfstudio's VolumetricSampler has it."""

    def sampling(self, rays_o: Tensor, rays_d: Tensor, *args: Any, **options: Any) -> Samples:
        samples = super().sampling(rays_o, rays_d, *args, **options)
        if len(samples[0]):
            return samples
        return torch.zeros(1).long(), torch.ones(1), torch.ones(1)


class FloatWhenEmpty(Sound):
    def sampling(self, rays_o: Tensor, rays_d: Tensor, *args: Any, **options: Any) -> Samples:
        samples = super().sampling(rays_o, rays_d, *args, **options)
        return samples if len(samples[0]) else (torch.zeros(0),) * 3


class StopsEarly(Sound):
    """Gives up a ray when a third of the light is left, whatever the host says."""

    def sampling(self, rays_o: Tensor, rays_d: Tensor, *args: Any, **options: Any) -> Samples:
        if options.get("early_stop_eps", 0.0) > 0.0:
            options["early_stop_eps"] = 0.3
        return super().sampling(rays_o, rays_d, *args, **options)


class UpdatesByNameOnly(Sound):
    def update_every_n_steps(self, step: int, occ_eval_fn: Any) -> None:
        pass


class Learns(Sound):
    """Goes on learning what it was told is settled."""

    def __init__(self, aabb: Tensor, occupancy: Occupancy) -> None:
        super().__init__(aabb, occupancy)
        self.register_buffer("seen", torch.ones(()))

    def update_every_n_steps(self, step: int, occ_eval_fn: Any, **thresholds: Any) -> None:
        self.seen *= occ_eval_fn(torch.zeros(1, 3)).max()

    def occupied(self, positions: Tensor) -> Tensor:
        return super().occupied(positions) & (self.seen > 0.0)


class OutsideTheStateDict(Sound):
    """Holds its occupancy where no checkpoint looks."""

    def __init__(self, aabb: Tensor, occupancy: Occupancy) -> None:
        super().__init__(aabb, occupancy)
        del self.occupancy
        self.__dict__["occupancy"] = occupancy


class DecidesByRank(Answers):
    """As what is done on the first rank alone would leave the others behind."""

    def change(self, ray_indices: Tensor, t_starts: Tensor, t_ends: Tensor) -> Samples:
        return ray_indices, t_starts + 1e-5 * rank(), t_ends + 1e-5 * rank()


def rank() -> int:
    """Of this process; 0 when it is alone."""
    return torch.distributed.get_rank() if torch.distributed.is_initialized() else 0


class ShortBuffer(Sound):
    """Works everywhere but in data-parallel training, which cannot send it."""

    def __init__(self, aabb: Tensor, occupancy: Occupancy) -> None:
        super().__init__(aabb, occupancy)
        self.register_buffer("cells", torch.zeros(8, dtype=torch.int16))


class NeedsLimits(Sound):
    """Reads t_min, which a host like Instant-NGP does not give."""

    def sampling(self, rays_o: Tensor, rays_d: Tensor, *args: Any, **options: Any) -> Samples:
        options["t_min"] = options["t_min"].clamp(min=options.get("near_plane", 0.0))
        return super().sampling(rays_o, rays_d, *args, **options)


class NearPlaneWithLimitsOnly(Sound):
    """Rays without limits of their own begin at their origins."""

    def sampling(self, rays_o: Tensor, rays_d: Tensor, *args: Any, **options: Any) -> Samples:
        if options["t_min"] is None:
            options["near_plane"] = 0.0
        return super().sampling(rays_o, rays_d, *args, **options)


class EndsTooSoonWithoutLimits(Sound):
    """Rays without limits of their own lack their last samples before the far plane."""

    def sampling(self, rays_o: Tensor, rays_d: Tensor, *args: Any, **options: Any) -> Samples:
        ray_indices, t_starts, t_ends = super().sampling(rays_o, rays_d, *args, **options)
        if options["t_max"] is not None:
            return ray_indices, t_starts, t_ends
        kept = t_ends < options["far_plane"] - 4 * STEP
        return ray_indices[kept], t_starts[kept], t_ends[kept]


class ClippedToTheBox(LearnedOccupancyEstimator):
    """Takes the box of the host's grid for the end of the scene."""

    def __init__(self, aabb: Tensor, occupancy: Occupancy) -> None:
        super().__init__(occupancy, aabb, cache_bytes=0)


def deaf_to(name: str, **always: Any) -> type[Sound]:
    """A mutant that has options of its own, whatever the host says."""

    def sampling(
        self: Sound, rays_o: Tensor, rays_d: Tensor, *args: Any, **options: Any
    ) -> Samples:
        return super(made, self).sampling(rays_o, rays_d, *args, **(options | always))

    made = type(name, (Sound,), {"sampling": sampling})
    return made


FarPlaneIgnored = deaf_to("FarPlaneIgnored", far_plane=1e10)
NeverStratified = deaf_to("NeverStratified", stratified=False)
StepsOfOneLength = deaf_to("StepsOfOneLength", cone_angle=0.0)
ShadesTheFaint = deaf_to("ShadesTheFaint", alpha_thre=0.0)
DeafToDensities = deaf_to("DeafToDensities", sigma_fn=None, alpha_fn=None)


class BeyondItsBox(Sound):
    """Goes on for a step in training, nearer to the box than skipping is looked at."""

    def bounds(self) -> Tensor | None:
        box, wider = super().bounds(), torch.tensor([-STEP] * 3 + [STEP] * 3)
        return box if box is None or not self.training else box + wider.to(box)

    def occupied(self, positions: Tensor) -> Tensor:
        box = super().bounds()
        inside = positions if box is None else positions.clamp(*box.view(2, 3))
        return super().occupied(inside)


MUTANTS: dict[str, tuple[type, ...]] = {
    "signature": (RaysInAnotherOrder, AnotherDefault, NoTorchModule),
    "shapes-types-devices": (DoubleStarts, WritesIntoRays),
    "sorted-disjoint-inside": (
        FarFirst,
        Overlapping,
        FarPlaneIgnored,
        NeedsLimits,
        NearPlaneWithLimitsOnly,
        EndsTooSoonWithoutLimits,
    ),
    "packing-consistent": (ShortIndices, RaysInPieces),
    "deterministic-in-eval": (AlwaysShaking,),
    "stratified-in-training": (NeverStratified, ShakenOutOfBounds),
    "skips-only-what-it-may": (
        KeepsAll,
        KeepsTooLittle,
        KeepsAllInTraining,
        Normalises,
        ClippedToTheBox,
    ),
    "all-kept-equals-dense": (DropsTheFirst, StepsOfOneLength, BeyondItsBox),
    "no-gradient-to-the-gate": (GateThaws, GradientsSwitchedOff, CarriesAGraph),
    "zero-samples-well-formed": (StandInSample, FloatWhenEmpty),
    "visibility-pruning": (StopsEarly, ShadesTheFaint, DeafToDensities),
    "update-while-frozen-is-harmless": (UpdatesByNameOnly, Learns),
    "state-dict-round-trip": (OutsideTheStateDict,),
    "two-processes": (DecidesByRank, ShortBuffer),
}
"""By the rule that must fail."""

SKIPS = "skips-only-what-it-may"
ALSO: dict[type, set[str]] = {
    Overlapping: {SKIPS, "all-kept-equals-dense", "stratified-in-training", "visibility-pruning"},
    ShakenOutOfBounds: {SKIPS, "sorted-disjoint-inside"},
    DropsTheFirst: {SKIPS, "visibility-pruning"},
    KeepsAll: {"zero-samples-well-formed"},
    KeepsAllInTraining: {"zero-samples-well-formed"},
}
"""What else cannot hold for a mutant."""


def __getattr__(name: str) -> SamplerSpec:
    """Entry points name a class in lower case: its specification."""
    for mutant in (Sound, *(mutant for family in MUTANTS.values() for mutant in family)):
        if mutant.__name__.lower() == name:
            return SamplerSpec(mutant.__name__, estimator=mutant, needs_occupancy=True)
    raise AttributeError(name)
