"""What the gate does with a batch, as the figures that the log carries."""

from __future__ import annotations

import torch
from torch import Tensor

from leco_plugin.models.gate import occupancy_from_logits
from leco_plugin.models.losses import expert_shares
from leco_plugin.models.rendering import Shaded

KEPT_ABOVE = 0.1
"""o(x) from which a sample counts as kept before there is a calibrated threshold."""


@torch.no_grad()
def gate_statistics(shaded: Shaded, scene_experts: int) -> dict[str, Tensor]:
    """Kept fraction, samples per ray, and for each expert its share of points and mean density.

    Args:
        shaded: one batch.
        scene_experts: n; expert 0 is the empty-space expert.
    Returns:
        Float scalars; densities are per half extent of the scene.
    """
    num_samples = max(len(shaded.routes), 1)
    shares = expert_shares(shaded.routes, 1 + scene_experts)
    density = torch.zeros_like(shares).index_add_(0, shaded.routes, shaded.sigmas.float())
    density = density / (shares * num_samples).clamp(min=1.0)
    figures = {
        "kept_fraction": (occupancy_from_logits(shaded.logits) >= KEPT_ABOVE).float().mean()
        if len(shaded.routes)
        else shares.new_zeros(()),
        "samples_per_ray": shaded.packed_info[:, 1].float().mean(),
    }
    for expert in range(1 + scene_experts):
        figures[f"share_expert_{expert}"] = shares[expert]
        figures[f"density_expert_{expert}"] = density[expert]
    return figures
