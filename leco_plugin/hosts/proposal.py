"""The frozen gate in the place of proposal networks: a fixed number of samples on every ray.

A host calls it as it calls nerfstudio's `ProposalNetworkSampler`. Candidates are laid along each
ray as the host lays them, the cells of the cache and the gate say what each is worth, and samples
are drawn from that distribution. There is no proposal network to train.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from nerfstudio.cameras.rays import RayBundle, RaySamples
from nerfstudio.model_components.ray_samplers import (
    PDFSampler,
    Sampler,
    UniformLinDispPiecewiseSampler,
)
from torch import Tensor, nn

from leco_plugin.samplers.cells.cache import OccupancyLike
from leco_plugin.samplers.estimator import LearnedOccupancyEstimator
from leco_plugin.scenes.frames import moved

Answer = tuple[RaySamples, list[Tensor], list[RaySamples]]
"""The samples, and for each level of proposals the weights of candidates and the candidates."""


class _ProposalSampler(nn.Module):
    """What a host of nerfstudio calls in place of its `ProposalNetworkSampler`, with sizes by name.
    ValueError where one is no positive whole number."""

    def __init__(self, initial_sampler: Sampler | None, single_jitter: bool, **sizes: int) -> None:
        super().__init__()
        for name, size in sizes.items():
            if size < 1 or size != int(size):
                wanted = "a ray needs a positive whole number of samples"
                raise ValueError(f"{wanted}, got {name} {size}")
            setattr(self, name, int(size))  # numbers of a command line may be floats
        self.initial_sampler = initial_sampler or UniformLinDispPiecewiseSampler(
            single_jitter=single_jitter
        )

    def generate_ray_samples(
        self,
        ray_bundle: RayBundle | None = None,
        density_fns: list[Callable[..., Any]] | None = None,
    ) -> Answer:
        """The samples [n_rays, n_samples], sorted and between near and far; and for each level the
        weights of the candidates [n_rays, n_candidates, 1], and the candidates.

        The host's proposal densities are not called; their number tells how many levels of weights
        its losses and depth outputs expect. ValueError if there are no rays, or none with nears and
        fars.
        """
        samples, weights, candidates = self._draw(_clamp_ends(ray_bundle))
        levels = 1 if density_fns is None else len(density_fns)
        return samples, [weights] * levels, [candidates] * levels

    def forward(self, *rays: Any, **options: Any) -> Answer:
        """As `generate_ray_samples`, by which nerfstudio's samplers are changed."""
        return self.generate_ray_samples(*rays, **options)

    def set_anneal(self, anneal: float) -> None:
        """Called by hosts for proposal networks; nothing is annealed here."""

    def step_cb(self, step: int) -> None:
        """Called by hosts after a training step; nothing is scheduled here."""

    def _draw(self, ray_bundle: RayBundle) -> tuple[RaySamples, Tensor, RaySamples]:
        """Samples, weights of candidates, and candidates."""
        raise NotImplementedError


def _clamp_ends(ray_bundle: RayBundle | None) -> RayBundle:
    """The rays with nears and fars between which samples can be laid. ValueError if there are none.

    A ray that ends before it begins, or at no number, has samples without length, all where it
    begins; that is its origin if it is no finite number. A ray without end is followed as far as a
    spacing in disparity, 1 - 1/(2t), can be told from 1: 4 million units in float32, 512 in half.
    """
    if ray_bundle is None or ray_bundle.nears is None or ray_bundle.fars is None:
        raise ValueError("samples need a ray bundle with nears and fars (set by a collider)")
    farthest = 0.5 / torch.finfo(ray_bundle.nears.dtype).eps
    nears = ray_bundle.nears.where(ray_bundle.nears.isfinite(), 0.0).clamp(max=farthest)
    fars = ray_bundle.fars.fmax(nears).clamp(max=farthest)
    return replace(ray_bundle, nears=nears, fars=fars)


class LearnedOccupancySampler(_ProposalSampler):
    """Draws samples from the gate's distribution along each ray.

    The weights of candidates sum to 1 on a ray that meets something occupied, and to 0 on others.
    A sample whose middle lies in space that no training ray crosses has a delta of 0, and with it
    no rendering weight, whatever density a host gives it.

    Args:
        occupancy: the frozen gate with its space and threshold.
        num_samples: samples of each ray.
        num_candidates: places along a ray where the gate is asked, in the spacing of
            `initial_sampler`.
        initial_sampler: lays the candidates; None is nerfstudio's default for proposal hosts.
        single_jitter: shift all samples of a ray by the same random share.
        cache_bytes: budget of the cell cache; 0 asks the gate about every candidate.
        frame: takes positions of the host to those of the occupancy, [3, 4]; None where they are
            the same.

    Raises:
        ValueError: samples or candidates are no positive whole number; the frame is not [3, 4].
    """

    frame: Tensor | None
    num_samples: int
    num_candidates: int

    def __init__(
        self,
        occupancy: OccupancyLike,
        num_samples: int = 48,
        num_candidates: int = 256,
        initial_sampler: Sampler | None = None,
        single_jitter: bool = False,
        cache_bytes: int = 1 << 20,
        frame: Tensor | None = None,
    ) -> None:
        super().__init__(
            initial_sampler, single_jitter, num_samples=num_samples, num_candidates=num_candidates
        )
        if frame is not None and frame.shape != (3, 4):
            raise ValueError(f"frame must be [3, 4], got {list(frame.shape)}")
        held = None if frame is None else frame.detach().float()
        self.register_buffer("frame", held, persistent=False)
        self.estimator = LearnedOccupancyEstimator(occupancy, cache_bytes=cache_bytes)
        # No padding: it would spend samples on empty space. A ray without any weight gets equal
        # ones, which is uniform sampling.
        self.pdf_sampler = PDFSampler(
            include_original=False, single_jitter=single_jitter, histogram_padding=0.0
        )

    def _draw(self, ray_bundle: RayBundle) -> tuple[RaySamples, Tensor, RaySamples]:
        candidates = self.initial_sampler(ray_bundle, num_samples=self.num_candidates)
        worth = self.worth(candidates.frustums.get_positions())
        weights = worth / worth.sum(dim=-2, keepdim=True).clamp(min=1e-12)
        samples = self.pdf_sampler(ray_bundle, candidates, weights, num_samples=self.num_samples)
        samples.deltas = samples.deltas.masked_fill(self._unseen(samples), 0.0)
        return samples, weights, candidates

    def _unseen(self, samples: RaySamples) -> Tensor:
        """Which samples [n_rays, n_samples, 1] have their middle where no training ray crosses
        the scene; none where an occupancy does not know."""
        middles = samples.frustums.get_positions()
        answer = getattr(self.estimator.occupancy, "unseen", None)
        if answer is None:
            return torch.zeros_like(middles[..., :1], dtype=torch.bool)
        found: Tensor = answer(self._in_its_frame(middles))
        return found.view(*middles.shape[:-1], 1)

    def _in_its_frame(self, positions: Tensor) -> Tensor:
        """Positions [..., 3] of a host in the occupancy's coordinates: [N, 3] float32."""
        flat = positions.reshape(-1, 3).float()  # a host may be in half or double precision
        return flat if self.frame is None else moved(flat, self.frame.float())

    @torch.no_grad()
    def worth(self, positions: Tensor) -> Tensor:
        """o at occupied positions [..., 3], 0 elsewhere: [..., 1]. The cache decides first, so that
        the gate is asked only where it lets something through."""
        flat = self._in_its_frame(positions)
        kept = self.estimator.occupied(flat).nonzero()[:, 0]
        worth = positions.new_zeros(len(flat))
        if kept.numel():
            values = self.estimator.occupancy.query(flat.index_select(0, kept))
            worth.index_put_((kept,), values.to(worth.dtype))
        return worth.view(*positions.shape[:-1], 1)


class DenseSampler(_ProposalSampler):
    """So many `samples`, at least one, laid along every ray as the host lays its first ones. What
    else a host gives is as of `LearnedOccupancySampler`; its `num_samples`, an occupancy and a
    frame are not used."""

    samples: int

    def __init__(
        self,
        num_samples: int = 48,
        samples: int = 256,
        initial_sampler: Sampler | None = None,
        single_jitter: bool = False,
        occupancy: OccupancyLike | None = None,
        frame: Tensor | None = None,
    ) -> None:
        super().__init__(initial_sampler, single_jitter, samples=samples)

    def _draw(self, ray_bundle: RayBundle) -> tuple[RaySamples, Tensor, RaySamples]:
        candidates = self.initial_sampler(ray_bundle, num_samples=self.samples)
        starts = candidates.frustums.starts
        return candidates, torch.full_like(starts, 1.0 / self.samples), candidates
