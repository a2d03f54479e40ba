"""What an occupancy says along rays: something is kept, all is skipped, or unseen."""

from __future__ import annotations

import torch
from torch import Tensor

from leco_plugin.evaluation.inspection import whole_box
from leco_plugin.models.region import cut_rays, marching_rule, within_crop
from leco_plugin.occupancy import Occupancy
from leco_plugin.samplers import marching

SKIPPED, KEPT, UNSEEN = 0, 1, 2
CANDIDATES = 192
"""Of a ray that crosses the scene."""
NEAREST, FARTHEST = 0.02, 100.0
"""Where rays begin and end, half extents of the space."""


@torch.no_grad()
def ray_states(
    occupancy: Occupancy,
    origins: Tensor,
    directions: Tensor,
    crop: tuple[Tensor | None, Tensor | None] = (None, None),
) -> Tensor:
    """The state of each ray: `KEPT` where any candidate is kept; else `UNSEEN` where any lies in
    space that no training ray crosses; else `SKIPPED`.

    Args:
        origins, directions: [R, 3] in the occupancy's coordinates, unit vectors.
        crop: nears and fars of the rays, [R] or [R, 1], scene units; None is no crop.
    Returns:
        [R] int64.
    """
    of_ray, starts, ends = candidates(occupancy, origins, directions, crop)
    middles = (0.5 * (starts + ends))[:, None]
    positions = torch.addcmul(origins[of_ray], directions[of_ray], middles)
    states = torch.full((len(origins),), SKIPPED, device=origins.device)
    states[of_ray[occupancy.unseen(positions)]] = UNSEEN
    states[of_ray[occupancy.query(positions) >= occupancy.threshold_value]] = KEPT
    return states


def candidates(
    occupancy: Occupancy,
    origins: Tensor,
    directions: Tensor,
    crop: tuple[Tensor | None, Tensor | None] = (None, None),
    most: int = CANDIDATES,
) -> tuple[Tensor, Tensor, Tensor]:
    """Intervals in whose middles an occupancy is asked along rays, the nearest of each ray first.

    Args:
        origins, directions, crop: as of `ray_states`.
        most: on a ray that crosses the scene.
    Returns:
        The ray [M] int64 of each; starts and ends [M], scene units.
    """
    space, half = occupancy.space, float(occupancy.space.half_extent)
    near, far = NEAREST * half, FARTHEST * half
    box = occupancy.walls
    if space.kind == "box":
        inner = whole_box(occupancy)
        box = torch.cat([inner.low, inner.high]).to(box)
    rays = within_crop(
        cut_rays(origins, directions, box, box.new_tensor(near), box.new_tensor(far)), *crop
    )
    rule = marching.March(*marching_rule(space.kind, near, far, most, 2.0 * half))
    return marching.march(marching.Rays(*rays[:4]), rule)
