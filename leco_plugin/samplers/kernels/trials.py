"""What a kernel must get right on a device before it answers there: the same as its torch twin.

Each is tried once for a gate, a threshold and its cells, on places and rays drawn at random; that
waits for the device, so that a kernel that fails there fails here.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from leco_plugin.samplers.cells.cache import CellCache
from leco_plugin.samplers.kernels.gate_weights import GateWeights
from leco_plugin.samplers.marching import Samples, march, number

CHECKED = 4096
"""Positions that a gate's kernel is tried on."""
OTHERWISE = 0.02
"""How much of what the twin keeps a kernel may decide otherwise; a steep gate turns single
roundings into decisions."""
NEAR_THRESHOLD = {True: 0.02, False: 2e-4}
"""Distance of o(x) from the threshold within which a decision is not counted; by whether products
are bfloat16."""
RAYS, STEPS = 64, 128
"""Rays that the march is tried on, and the most candidates of each."""


def try_gate(occupancy: nn.Module, weights: GateWeights) -> None:
    """Compares the gate's kernel with `Occupancy.query`.

    Raises:
        ValueError: it decides otherwise.
    """
    from leco_plugin.samplers.kernels.gate_kernel import gate_decisions

    positions = _places(weights, CHECKED)
    kept = gate_decisions(weights, positions)
    o = occupancy.query(positions)  # type: ignore[operator]
    by_twin = o >= weights.facts[10]
    wrong = int((_far(o, weights) & (kept != by_twin)).sum())
    if wrong > _most_otherwise(int(by_twin.sum())):
        raise ValueError(f"it decides otherwise about {wrong} of {CHECKED} positions")


def try_march(occupancy: nn.Module, cache: CellCache, weights: GateWeights, coned: bool) -> None:
    """Compares the march's kernel with `marching.march` on rays of unequal lengths.

    Args:
        coned: whether the step grows with distance, which is another kernel.
    Raises:
        ValueError: it keeps other candidates, or in another order.
    """
    from leco_plugin.samplers.kernels.march_kernel import march_kept

    def occupied(positions: Tensor) -> Tensor:
        decided, left_open = cache.decide(positions)
        o = occupancy.query(positions.index_select(0, left_open))  # type: ignore[operator]
        return decided.index_put_((left_open,), o >= weights.facts[10])

    origins = _places(weights, RAYS)
    directions = torch.nn.functional.normalize(_places(weights, RAYS) - origins.flip(0), dim=-1)
    step_size = float(weights.facts[3]) / 48.0
    t_mins = torch.zeros_like(origins[:, 0])
    t_maxs = torch.linspace(
        0.0, STEPS * step_size, RAYS, dtype=origins.dtype, device=origins.device
    )
    rays, cone_angle = (origins, directions, t_mins, t_maxs), 1.0 / 64.0 if coned else 0.0
    ours = march_kept(cache, weights, number(*rays, step_size, cone_angle))
    theirs = march(
        *rays,
        step_size=step_size,
        cone_angle=cone_angle,
        occupied=occupied,
        near_occupied=cache.near,
    )
    if wrong := _kept_otherwise(occupancy, weights, origins, directions, step_size, ours, theirs):
        raise ValueError(f"it keeps otherwise {wrong} of {RAYS * STEPS} candidates")


def _kept_otherwise(
    occupancy: nn.Module,
    weights: GateWeights,
    origins: Tensor,
    directions: Tensor,
    step_size: float,
    ours: Samples,
    theirs: Samples,
) -> int:
    """How many candidates only one of the two keeps, away from the threshold; 0 for a few."""
    numbers, others = _numbers(ours, step_size), _numbers(theirs, step_size)
    if bool((numbers[1:] <= numbers[:-1]).any()):
        return len(numbers)
    single = [
        torch.stack(list(map(torch.Tensor.double, samples)))[:, ~torch.isin(those, these)]
        for samples, those, these in ((ours, numbers, others), (theirs, others, numbers))
    ]
    ray_indices, t_starts, t_ends = torch.cat(single, dim=1)
    which = ray_indices.long()
    middles = ((t_starts + t_ends) * 0.5).float()[:, None]
    o = occupancy.query(origins[which] + directions[which] * middles)  # type: ignore[operator]
    wrong = int(_far(o, weights).sum())
    return wrong if wrong > _most_otherwise(len(others)) else 0


def _most_otherwise(kept: int) -> int:
    """Decisions that may differ where the twin keeps so many."""
    return max(2, int(OTHERWISE * kept))


def _numbers(samples: Samples, step_size: float) -> Tensor:
    """One number for each sample, in the order of rays and distance; roundings leave it alone."""
    ray_indices, t_starts, t_ends = samples
    starts, ends = ((t * (16.0 / step_size)).round().long() for t in (t_starts, t_ends))
    return (ray_indices << 40) + (starts << 20) + ends


def _places(weights: GateWeights, count: int) -> Tensor:
    """Positions in the gate's cube and a little beyond, [count, 3]; always the same ones."""
    unit = torch.rand(count, 3, generator=torch.Generator().manual_seed(0)) * 2.4 - 1.2
    return weights.facts[:3] + weights.facts[3] * unit.to(weights.facts)


def _far(o: Tensor, weights: GateWeights) -> Tensor:
    return (o - weights.facts[10]).abs() > NEAR_THRESHOLD[weights.half]
