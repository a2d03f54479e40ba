"""Held-out rays rendered with all their candidates: the reference for each price of skipping."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

import torch
from torch import Tensor, nn

from leco_plugin.learning.calibration import Reference, reference_of
from leco_plugin.models.mixture import Mixture
from leco_plugin.models.rendering import Intervals, Rays, mapped_middles


class DenseRendering(NamedTuple):
    """What `calibration.measure` and its kin take: see there."""

    references: list[Reference]
    truths: list[Tensor]
    render_kept: Callable[[int, Tensor], Tensor]


@contextmanager
def evaluating(model: nn.Module) -> Iterator[None]:
    """A module in evaluation mode for a while; then in the mode that it was in."""
    was_training = model.training
    model.eval()
    try:
        yield
    finally:
        model.train(was_training)


@torch.no_grad()
def dense_rendering(
    mixture: Mixture, rays: Rays, truth: Tensor, rays_at_once: int
) -> DenseRendering:
    """All candidates of given rays rendered, in chunks.

    Args:
        rays: cut to the mixture's region.
        truth: [R, 3] their true colours.
    """
    chunks = in_chunks(rays, rays_at_once)
    references = [dense_reference(mixture, chunk) for chunk in chunks]

    def render_kept(number: int, mask: Tensor) -> Tensor:
        kept = Intervals(*(part[mask] for part in references[number].intervals))
        return mixture.shade(chunks[number], kept).rgb

    return DenseRendering(references, list(truth.split(rays_at_once)), render_kept)


def dense_reference(mixture: Mixture, rays: Rays) -> Reference:
    """All candidates of some rays rendered, as the reference that skipping is measured against."""
    intervals = mixture.with_backdrops(rays, mixture.candidates(rays))
    reference = reference_of(mixture.shade(rays, intervals), intervals, rays)
    if mixture.small is None:
        return reference
    mapped = mapped_middles(mixture.region.space, rays, intervals)
    return reference._replace(occupancies=mixture.occupancies(mapped))


def in_chunks(rays: Rays, at_once: int) -> list[Rays]:
    """Rays, so many at a time."""
    return [
        Rays._make(None if part is None else part[first : first + at_once] for part in rays)
        for first in range(0, len(rays.origins), at_once)
    ]
