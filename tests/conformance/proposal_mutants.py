"""Samplers for proposal hosts that are broken in one way each, and the rule that must say so."""

from __future__ import annotations

from typing import Any

import torch
from conformance.estimator_mutants import rank
from torch import Tensor

from leco_plugin.conformance.scene import box
from leco_plugin.hosts.proposal import LearnedOccupancySampler
from leco_plugin.occupancy import Occupancy
from leco_plugin.samplers.registry import SamplerSpec


class SoundProposal(LearnedOccupancySampler):
    """What all others are but for one thing."""

    def __init__(self, occupancy: Occupancy, **options: Any) -> None:
        super().__init__(occupancy, cache_bytes=0, **options)


class NoCallbacks(SoundProposal):
    """A host's training callbacks find nothing to call."""

    @property
    def set_anneal(self) -> Any:
        raise AttributeError("set_anneal")


class TuplesForLists(SoundProposal):
    def generate_ray_samples(self, ray_bundle: Any = None, density_fns: Any = None) -> Any:
        samples, weights, candidates = super().generate_ray_samples(ray_bundle, density_fns)
        return samples, tuple(weights), tuple(candidates)


class AsksProposalNetworks(SoundProposal):
    """Which a guided host no longer has."""

    def generate_ray_samples(self, ray_bundle: Any = None, density_fns: Any = None) -> Any:
        density_fns[0](ray_bundle.origins)
        return super().generate_ray_samples(ray_bundle, density_fns)


class OneLevelOnly(SoundProposal):
    def generate_ray_samples(self, ray_bundle: Any = None, density_fns: Any = None) -> Any:
        return super().generate_ray_samples(ray_bundle, None)


class WritesIntoBundles(SoundProposal):
    """Which a host goes on using, to place its backdrop for instance."""

    def generate_ray_samples(self, ray_bundle: Any = None, density_fns: Any = None) -> Any:
        answer = super().generate_ray_samples(ray_bundle, density_fns)
        ray_bundle.fars.mul_(0.5)
        return answer


class FlatWeights(SoundProposal):
    def generate_ray_samples(self, ray_bundle: Any = None, density_fns: Any = None) -> Any:
        samples, weights, candidates = super().generate_ray_samples(ray_bundle, density_fns)
        return samples, [level[..., 0] for level in weights], candidates


class Rewritten(SoundProposal):
    """Changes the samples that are returned."""

    def generate_ray_samples(self, ray_bundle: Any = None, density_fns: Any = None) -> Any:
        samples, weights, candidates = super().generate_ray_samples(ray_bundle, density_fns)
        self.rewrite(samples)
        return samples, weights, candidates

    def rewrite(self, samples: Any) -> None:
        raise NotImplementedError


class TwiceAsLong(Rewritten):
    """Light is absorbed on twice the way."""

    def rewrite(self, samples: Any) -> None:
        samples.deltas = 2.0 * samples.deltas


class WithoutLength(Rewritten):
    """Nothing absorbs any light to speak of."""

    def rewrite(self, samples: Any) -> None:
        samples.deltas = 1e-3 * samples.deltas


class OfNoCamera(Rewritten):
    """A field finds no code for the photograph."""

    def rewrite(self, samples: Any) -> None:
        samples.camera_indices = None


class OfOneCamera(Rewritten):
    """All have the code of the first photograph."""

    def rewrite(self, samples: Any) -> None:
        samples.camera_indices = torch.zeros_like(samples.camera_indices)


class OfNoTime(Rewritten):
    def rewrite(self, samples: Any) -> None:
        samples.times = None


class WithoutMetadata(Rewritten):
    def rewrite(self, samples: Any) -> None:
        samples.metadata = None


class Shifted(SoundProposal):
    """Changes the samples' edges [n_rays, n, 1]."""

    def generate_ray_samples(self, ray_bundle: Any = None, density_fns: Any = None) -> Any:
        samples, weights, candidates = super().generate_ray_samples(ray_bundle, density_fns)
        starts, ends = samples.frustums.starts, samples.frustums.ends
        starts, ends = self.change(starts, ends)
        samples.frustums.starts, samples.frustums.ends = starts, ends
        samples.deltas = ends - starts
        return samples, weights, candidates

    def change(self, starts: Tensor, ends: Tensor) -> tuple[Tensor, Tensor]:
        raise NotImplementedError


class LastFirst(Shifted):
    def change(self, starts: Tensor, ends: Tensor) -> tuple[Tensor, Tensor]:
        return starts.flip(1), ends.flip(1)


class EndsBeyondTheRay(SoundProposal):
    """The last sample has its middle just before the far end, and ends as far behind it as it
    begins before it."""

    def generate_ray_samples(self, ray_bundle: Any = None, density_fns: Any = None) -> Any:
        samples, weights, candidates = super().generate_ray_samples(ray_bundle, density_fns)
        places = samples.frustums
        places.ends = places.ends.clone()
        places.ends[:, -1] = 2.0 * ray_bundle.fars - places.starts[:, -1] - 1e-3
        samples.deltas = places.ends - places.starts
        return samples, weights, candidates


class Shaking(Shifted):
    def change(self, starts: Tensor, ends: Tensor) -> tuple[Tensor, Tensor]:
        shift = 1e-5 * torch.rand(()) * (not self.training)
        return starts + shift, ends + shift


class NeverShaken(SoundProposal):
    def generate_ray_samples(self, ray_bundle: Any = None, density_fns: Any = None) -> Any:
        self.initial_sampler.train_stratified = self.pdf_sampler.train_stratified = False
        return super().generate_ray_samples(ray_bundle, density_fns)


class Uniform(SoundProposal):
    """Everything is worth the same."""

    def worth(self, positions: Tensor) -> Tensor:
        return torch.ones_like(positions[..., :1])


class UniformOnOneRay(SoundProposal):
    """Everything on the first ray of a batch is worth the same."""

    def worth(self, positions: Tensor) -> Tensor:
        first = torch.arange(len(positions)).view(-1, 1, 1) == 0
        return super().worth(positions).masked_fill(first, 1.0)


class FrontOnly(SoundProposal):
    """Only what a ray meets first is sampled."""

    def worth(self, positions: Tensor) -> Tensor:
        worth = super().worth(positions)
        if bool((worth > 0.0).float().mean() > 0.9):
            return worth
        return worth * (worth.cumsum(dim=-2) < 0.3 * worth.sum(dim=-2, keepdim=True))


class UniformInTraining(SoundProposal):
    def worth(self, positions: Tensor) -> Tensor:
        return torch.ones_like(positions[..., :1]) if self.training else super().worth(positions)


class InTheBoxOnly(SoundProposal):
    """Takes an unbounded scene to end where its contraction begins."""

    def worth(self, positions: Tensor) -> Tensor:
        space = self.estimator.occupancy.space
        offsets = (self._in_its_frame(positions) - space.center).abs().amax(dim=-1)
        inside = (offsets <= space.half_extent).view(*positions.shape[:-1], 1)
        return super().worth(positions) * inside


class InTheBoxInTrainingProposal(InTheBoxOnly):
    """Does so while it learns."""

    def worth(self, positions: Tensor) -> Tensor:
        return super().worth(positions) if self.training else SoundProposal.worth(self, positions)


class SqueezesBundles(SoundProposal):
    """Takes a bundle of one ray for a ray."""

    def generate_ray_samples(self, ray_bundle: Any = None, density_fns: Any = None) -> Any:
        samples, weights, candidates = super().generate_ray_samples(ray_bundle, density_fns)
        return samples, [level.squeeze(0) for level in weights], candidates


class FromOutsideOnlyProposal(SoundProposal):
    """Takes rays that begin in the box to miss it."""

    def worth(self, positions: Tensor) -> Tensor:
        low, high = box().view(2, 3)
        first = positions[..., :1, :]
        inside = ((first > low) & (first < high)).all(dim=-1, keepdim=True)
        return super().worth(positions).where(~inside, 1.0)


class ForgetsTheFrame(SoundProposal):
    """Asks where the host is, whatever coordinates the occupancy was learned in."""

    def __init__(self, occupancy: Occupancy, frame: Tensor | None = None, **options: Any) -> None:
        super().__init__(occupancy, **options)


class KnowsNoFrame(SoundProposal):
    """Cannot be built for a host in other coordinates."""

    def __init__(
        self, occupancy: Occupancy, num_samples: int, initial_sampler: Any, single_jitter: bool
    ) -> None:
        options = {"initial_sampler": initial_sampler, "single_jitter": single_jitter}
        super().__init__(occupancy, num_samples=num_samples, **options)


class PrefersTheFront(SoundProposal):
    """Worth falls with distance, also where everything is occupied."""

    def worth(self, positions: Tensor) -> Tensor:
        return super().worth(positions) * torch.linspace(2.0, 0.8, positions.shape[-2])[:, None]


class ProposalThaws(SoundProposal):
    def __init__(self, occupancy: Occupancy, **options: Any) -> None:
        super().__init__(occupancy, **options)
        occupancy.gate.requires_grad_(True)


class EdgesCarryAGraph(Rewritten):
    """Edges are computed from origins outside of torch.no_grad."""

    def rewrite(self, samples: Any) -> None:
        nothing = 0.0 * samples.frustums.origins.sum(dim=-1, keepdim=True)
        samples.frustums.starts = samples.frustums.starts + nothing
        samples.frustums.ends = samples.frustums.ends + nothing


class NothingPerNothing(SoundProposal):
    """Weights of a ray that meets nothing are 0/0."""

    def generate_ray_samples(self, ray_bundle: Any = None, density_fns: Any = None) -> Any:
        samples, weights, candidates = super().generate_ray_samples(ray_bundle, density_fns)
        return samples, [level / level.sum(dim=-2, keepdim=True) for level in weights], candidates


class Anneals(SoundProposal):
    """Blurs what is settled as if it were a proposal network that learns."""

    anneal = 0.5

    def set_anneal(self, anneal: float) -> None:
        self.anneal = anneal

    def worth(self, positions: Tensor) -> Tensor:
        return super().worth(positions) ** self.anneal


class ProposalOutsideTheStateDict(SoundProposal):
    def __init__(self, occupancy: Occupancy, **options: Any) -> None:
        super().__init__(occupancy, **options)
        estimator = self.estimator
        del self.estimator
        self.__dict__["estimator"] = estimator


class SamplesByRank(Shifted):
    def change(self, starts: Tensor, ends: Tensor) -> tuple[Tensor, Tensor]:
        return starts + 1e-5 * rank(), ends + 1e-5 * rank()


PROPOSAL_MUTANTS: dict[str, tuple[type, ...]] = {
    "signature": (NoCallbacks, TuplesForLists, AsksProposalNetworks),
    "shapes-types-devices": (
        OneLevelOnly,
        WritesIntoBundles,
        FlatWeights,
        TwiceAsLong,
        WithoutLength,
        OfNoCamera,
        OfOneCamera,
        OfNoTime,
        WithoutMetadata,
        SqueezesBundles,
    ),
    "sorted-disjoint-inside": (LastFirst, EndsBeyondTheRay),
    "deterministic-in-eval": (Shaking,),
    "stratified-in-training": (NeverShaken,),
    "skips-only-what-it-may": (
        Uniform,
        UniformOnOneRay,
        FrontOnly,
        UniformInTraining,
        FromOutsideOnlyProposal,
        ForgetsTheFrame,
        KnowsNoFrame,
        InTheBoxOnly,
        InTheBoxInTrainingProposal,
    ),
    "all-kept-equals-dense": (PrefersTheFront,),
    "no-gradient-to-the-gate": (ProposalThaws, EdgesCarryAGraph),
    "zero-samples-well-formed": (NothingPerNothing,),
    "update-while-frozen-is-harmless": (Anneals,),
    "state-dict-round-trip": (ProposalOutsideTheStateDict,),
    "two-processes": (SamplesByRank,),
}
"""By the rule that must fail."""

ALSO: dict[type, set[str]] = {
    NoCallbacks: {"update-while-frozen-is-harmless"},
    FlatWeights: {"zero-samples-well-formed"},
    LastFirst: {"zero-samples-well-formed"},
}
"""What else cannot hold for a mutant."""


def __getattr__(name: str) -> SamplerSpec:
    """Entry points name a class in lower case: its specification."""
    for mutant in (SoundProposal, *(m for family in PROPOSAL_MUTANTS.values() for m in family)):
        if mutant.__name__.lower() == name:
            return SamplerSpec(mutant.__name__, proposal=mutant, needs_occupancy=True)
    raise AttributeError(name)
