"""Judges cells by a frozen gate: from its logits at their corners, centres and points inside.

A cell is empty or occupied if all its logits lie on one side of the threshold, by a margin that is
proportional to their spread. Fine cells close to the threshold are probed at more points. A fine
cell that is neither gets a plane.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import interpolate, max_pool3d, pad

from leco_plugin.samplers.cells.cache import BRICK, EMPTY, FARTHEST, MIXED, OCCUPIED, OccupancyLike

LEAST_O = 1e-7
"""Of o and of 1 - o, where they are taken to logits."""
POINTS_AT_ONCE = 1 << 17
"""Positions that the gate is asked about in one call."""
TRIALS = 24
"""Random points of a cell to which its plane is fitted and at which its error is measured."""
LEAST_MARGIN = 0.1
"""Distance from the threshold that a cell's logits must keep, in units of their spread."""
PLAIN_MARGIN = 0.5
"""Margin of cells that a finer look does not ask about again."""
CLOSE = 0.5
"""Margin below which an empty or occupied fine cell is also checked at random points."""


class Look(NamedTuple):
    """Logits of the whole cube, and where a finer look has to ask the gate again."""

    corners: Tensor
    """Logits above the threshold's at the points of a lattice, [m + 1]^3."""
    open: Tensor
    """Which of n^3 cells are not plainly on one side, or lie beside one of those: bool."""


def look(occupancy: OccupancyLike, resolution: int) -> tuple[Tensor, Look]:
    """States of coarse cells at the smallest margin, and what finer looks may interpolate."""
    states, corners = judge_coarse(occupancy, resolution, LEAST_MARGIN)
    low, high = _extremes(corners)
    unsure = (_judge(low, high, PLAIN_MARGIN) == MIXED).float()[None, None]
    return states, Look(corners, max_pool3d(unsure, 3, stride=1, padding=1)[0, 0] > 0.0)


def judge_coarse(
    occupancy: OccupancyLike, resolution: int, margin: float, seen: Look | None = None
) -> tuple[Tensor, Tensor]:
    """States of the coarse cells [n, n, n], and logits at the corners of the fine ones, [4n + 1]^3.

    A coarse cell is judged by the 5^3 corners of its fine ones.

    Args:
        seen: a coarser look; outside its open cells its logits are interpolated. None asks the gate
            everywhere.
    """
    size, device = BRICK * resolution + 1, occupancy.space.center.device
    if seen is None:
        corners = logits_above(occupancy, _lattice(size - 1, device)).view(size, size, size)
    else:
        whole = seen.corners[None, None]
        corners = interpolate(whole, (size,) * 3, mode="trilinear", align_corners=True)[0, 0]
        # a lattice point between two cells lies in the upper one; open cells have a margin
        cell = (torch.arange(size, device=device) * len(seen.open) // (size - 1)).clamp(
            max=len(seen.open) - 1
        )
        asked = seen.open[cell][:, cell][:, :, cell].nonzero()
        corners[tuple(asked.T)] = logits_above(occupancy, asked.float() * (2.0 / (size - 1)) - 1.0)
    return _judge(*_extremes(corners), margin), corners


def _extremes(corners: Tensor) -> tuple[Tensor, Tensor]:
    """Lowest and highest value in each coarse cell [n, n, n] of a lattice of corners [4n + 1]^3."""
    whole = corners[None, None]
    high = max_pool3d(whole, BRICK + 1, BRICK)[0, 0]
    return -max_pool3d(-whole, BRICK + 1, BRICK)[0, 0], high


def _lattice(intervals: int, device: torch.device) -> Tensor:
    """Points of a lattice over the mapped cube, [(intervals + 1)^3, 3]."""
    axis = torch.linspace(-1.0, 1.0, intervals + 1, dtype=torch.float32, device=device)
    return torch.cartesian_prod(axis, axis, axis)


def logits_above(occupancy: OccupancyLike, mapped: Tensor) -> Tensor:
    """How far the logit of o lies above that of the threshold at mapped positions [N, 3]; [N].

    Finite: float32 says o = 1 from a logit of 17 on.
    """
    threshold = mapped.new_tensor(occupancy.threshold).logit(eps=LEAST_O)
    values = [
        occupancy.query(occupancy.space.unmap(part)).float().logit(eps=LEAST_O) - threshold
        for part in mapped.split(POINTS_AT_ONCE)
    ]
    return torch.cat(values)


def _judge(low: Tensor, high: Tensor, margin: float) -> Tensor:
    """States of cells from the lowest and highest logit seen in each; uint8, of their shape."""
    room = (high - low) * margin
    states = torch.full_like(high, MIXED, dtype=torch.uint8)
    states[high + room < 0.0] = EMPTY
    states[low - room >= 0.0] = OCCUPIED
    return states


def judge_fine(
    occupancy: OccupancyLike, corners: Tensor, cells: Tensor, margin: float
) -> tuple[Tensor, Tensor, Tensor]:
    """The fine cells of some mixed coarse cells [n, 3], judged at their corners and centres.

    Returns:
        their states [n, 64]; of the mixed ones, the logits at the nine points [m, 9] and the
        mapped positions of the lowest corners [m, 3].
    """
    n, device = len(cells), corners.device
    size = 2.0 / (len(corners) - 1)
    steps = torch.arange(BRICK, device=device)
    lowest = cells[:, None, :] * BRICK + torch.cartesian_prod(steps, steps, steps)
    places = lowest.float() * size - 1.0
    centres = logits_above(occupancy, (places + 0.5 * size).reshape(-1, 3)).view(n, BRICK**3, 1)
    eight = corners.unfold(0, 2, 1).unfold(1, 2, 1).unfold(2, 2, 1)
    x, y, z = lowest.unbind(-1)
    values = torch.cat([eight[x, y, z].flatten(2), centres], dim=-1)
    low, high = values.amin(dim=-1), values.amax(dim=-1)
    states = _judge(low, high, margin)
    close = (states != MIXED) & (_judge(low, high, max(margin, CLOSE)) == MIXED)
    within = logits_above(occupancy, _random_points(places[close], size)[0])
    differs = (within.view(-1, TRIALS) >= 0.0) != (states[close] == OCCUPIED)[:, None]
    states[close] = states[close].masked_fill(differs.any(dim=1), MIXED)
    mixed = states == MIXED
    return states, values[mixed], places[mixed]


def _random_points(places: Tensor, size: float) -> tuple[Tensor, Tensor]:
    """Random points of cells with these lowest corners [m, 3], the same ones for the same m.

    Returns:
        mapped positions [m TRIALS, 3], and where in their cells they lie, in [0, 1), of that shape
        but for [m, TRIALS, 3].
    """
    generator = torch.Generator(places.device).manual_seed(len(places))
    random = torch.rand(
        len(places), TRIALS, 3, dtype=places.dtype, device=places.device, generator=generator
    )
    return (places[:, None, :] + random * size).view(-1, 3), random


def fit_planes(
    occupancy: OccupancyLike, values: Tensor, places: Tensor, size: float
) -> tuple[Tensor, Tensor]:
    """Planes through the logits of fine cells, and how high above them they may err.

    Args:
        values: logits at the corners and the centre of each cell, [m, 9].
        places: mapped positions of the lowest corners, [m, 3].
        size: width of a cell in the mapped cube.

    Returns:
        planes (a, b) in units of which the largest is 127, [m, 4], and doubts in these units [m]:
        the largest residual in the cell, where those far from the threshold count for less.
    """
    mapped, random = _random_points(places, size)
    values = torch.cat([values, logits_above(occupancy, mapped).view(len(values), TRIALS)], dim=1)
    nine = torch.cat([_lattice(1, values.device), values.new_zeros(1, 3)])
    units = torch.cat([nine.expand(len(values), 9, 3), random * 2.0 - 1.0], dim=1)
    design = pad(units, (1, 0), value=1.0)  # [m, points, 4]

    # Only where the plane is zero matters: points far from the threshold count for less.
    scale = (values.amax(dim=1) - values.amin(dim=1)).clamp(min=1e-6) / 4.0
    weights = 1.0 / (1.0 + (values / scale[:, None]).square())
    weighted = (weights[:, :, None] * design).mT
    system = weighted @ design + 1e-6 * torch.eye(4, dtype=values.dtype, device=values.device)
    planes = torch.linalg.solve(system, weighted @ values[:, :, None])[..., 0]
    unit = planes.abs().amax(dim=1, keepdim=True).clamp(min=1e-6) / 127.0
    planes = (planes / unit).round()

    residuals = (design @ planes[:, :, None])[..., 0] - values / unit
    doubts = (weights * residuals.abs()).amax(dim=1)
    # where space ends or is unseen o falls to 0 at once: a plane that never decides
    threshold = values.new_tensor(occupancy.threshold).logit(eps=LEAST_O)
    falls = values.amin(dim=1) <= values.new_tensor(0.0).logit(eps=LEAST_O) - threshold
    return planes.masked_fill(falls[:, None], 0.0), doubts.masked_fill(falls, 0.0)


def clearance_of(states: Tensor, mixed: Tensor, fine_states: Tensor) -> Tensor:
    """The clearance table, from the states of coarse [n, n, n] and fine [n_mixed, 64] cells."""
    half = BRICK // 2
    taken = interpolate((states != EMPTY).float()[None, None], scale_factor=2)[0, 0]
    bricks = (fine_states != EMPTY).float().view(-1, 1, BRICK, BRICK, BRICK)
    inner = max_pool3d(bricks, half)[:, 0] if len(bricks) else bricks[:, 0]
    for x, y, z in ((x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)):
        at = mixed * 2 + torch.tensor([x, y, z], device=mixed.device)
        taken[at[:, 0], at[:, 1], at[:, 2]] = inner[:, x, y, z]
    reach, clearance = taken[None, None], torch.zeros_like(taken)
    for _ in range(FARTHEST):
        clearance += 1.0 - reach[0, 0]
        # Beyond the cube only the gate knows: it counts as occupied.
        reach = max_pool3d(pad(reach, [1] * 6, value=1.0), 3, stride=1)
    pairs = clearance.to(torch.uint8).view(-1, 2)
    return pairs[:, 0] | pairs[:, 1] << 4
