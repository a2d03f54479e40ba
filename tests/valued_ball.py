"""The ball as an original that is shrunk, and references that value places in its box."""

from __future__ import annotations

import torch
from ball_occupancy import ball

from leco_plugin.capacity.evidence import Evidence
from leco_plugin.capacity.references import Ground, Part, Reference
from leco_plugin.occupancy import Occupancy


def original() -> Occupancy:
    known = ball()
    return Occupancy(known.gate, known.space, known.threshold).eval()


def everywhere(occupancy: Occupancy, seed: int) -> Evidence:
    """Rays of two places of the ball's box, the second worth a hundredth of the first."""
    generator = torch.Generator().manual_seed(seed)
    positions = occupancy.space.unmap(2.0 * torch.rand(4000, 3, generator=generator) - 1.0)
    kept = occupancy.occupied(positions)
    worth = kept + 0.01 * ~kept
    return Evidence(positions, torch.arange(4000) // 2, kept, worth, worth, 2000)


def ground(*guided: bool) -> Ground:
    """References that value the same places, whether or not the original guides them."""
    known = original()
    searched, unseen = (everywhere(known, seed) for seed in (1, 2))
    sides = Part(searched), Part(unseen)
    references = [
        Reference("known", None, 1e-4 * each, 0.0, 0.0, *sides, guided=each) for each in guided
    ]
    return Ground(known, searched, references)
