"""What the gate does with a batch, as the figures that the log carries."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from leco_plugin.models.gate import occupancy_from_logits
from leco_plugin.models.losses import expert_shares
from leco_plugin.models.rendering import Intervals, Rays, Shaded, backdrop_of
from leco_plugin.samplers.edges import candidate_counts

KEPT_ABOVE = 0.1
"""o(x) from which a sample counts as kept before there is a calibrated threshold."""

PRICES = ("lost_mass", "lost_surface_mass", "image_price_db")
"""What skipping costs, as a report has it."""


@torch.no_grad()
def gate_statistics(shaded: Shaded, scene_experts: int) -> dict[str, Tensor]:
    """Samples per ray, and for each expert its share of them and their mean density.

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
    figures = {"samples_per_ray": shaded.packed_info[:, 1].float().mean()}
    for expert in range(1 + scene_experts):
        figures[f"share_expert_{expert}"] = shares[expert]
        figures[f"density_expert_{expert}"] = density[expert]
    return figures


@torch.no_grad()
def kept_fraction(
    shaded: Shaded,
    intervals: Intervals,
    rays: Rays,
    above: float,
    step_size: float,
    cone_angle: float,
) -> Tensor:
    """Share of all candidates of a batch that the gate keeps, those that were skipped included.

    A backdrop counts as kept, as it does in `Measured.empty_fraction`.

    Args:
        shaded, intervals: what is left of the candidates; none is missing that has o(x) >= above.
        above: o(x) from which a candidate is kept.
        step_size, cone_angle: of the march.
    Returns:
        Float scalar in [0, 1].
    """
    kept = (occupancy_from_logits(shaded.logits) >= above) | backdrop_of(intervals, rays)
    candidates = candidate_counts(rays.t_mins, rays.t_maxs, step_size, cone_angle).sum()
    return (kept.sum() / candidates.clamp(min=1.0)).clamp(max=1.0)


def prices(report: dict[str, Any]) -> dict[str, Tensor]:
    """What skipping costs as it was last measured: float scalars.

    Args:
        report: of a frozen gate; of an older release it may lack some, and those of a gate that
            was shrunk without a field are None.
    """
    known = {name: report.get(name) for name in PRICES}
    return {name: torch.tensor(float(x)) for name, x in known.items() if x is not None}
