"""Judging cells by the frozen gate, conservatively, and checking the judgement by measurement.

A cell is called empty or occupied when the gate's logit at all its lattice points lies on one side
of the threshold by a margin proportional to their spread; the others get a plane fitted to those
points, and do not decide within a multiple of its error. Fresh random decisions are then compared
with the gate's own; while too many differ, margin and multiple grow.
"""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import Tensor
from torch.nn.functional import max_pool3d, pad

from leco_plugin.samplers.cache import (
    BRICK,
    COARSE_EMPTY,
    COARSE_OCCUPIED,
    COARSE_OUTSIDE,
    EMPTY,
    FARTHEST,
    FINE_EMPTY,
    FINE_OCCUPIED,
    MIXED,
    OCCUPIED,
    CacheReport,
    CellCache,
    OccupancyLike,
    Tables,
)

POINTS_AT_ONCE = 1 << 17
RESOLUTIONS = range(8, 65, 2)
"""Coarse cells along the cube that are considered."""
CAUTION = ((0.1, 1.0), (0.1, 1.5), (0.25, 2.5), (0.5, 4.0), (1.0, 8.0))
"""(margin, caution) in the order in which they are tried; see `CacheReport`."""
TRIALS = 48
"""Random points that show where the plane of a cell errs."""
ALLOWANCE = 0.5
"""Share of the tolerance that uniform positions may use: rays look at surfaces, and so meet the
gate's boundary more often than uniform positions do."""


@torch.no_grad()
def build_cache(
    occupancy: OccupancyLike,
    *,
    budget: int = 1 << 20,
    tolerance: float = 1e-4,
    check_points: int = 1 << 20,
    seed: int = 0,
) -> CellCache:
    """The finest cache of a frozen occupancy that fits a budget and keeps its decisions.

    Args:
        occupancy: the frozen gate with its space and threshold.
        budget: most bytes of its tables.
        tolerance: largest share of decisions that may differ from the gate's. Positions uniform in
            the mapped cube may use half of it, at two standard deviations above the measured share.
        check_points: decisions that are compared.
        seed: of the check.

    Returns:
        The cache, on the occupancy's device, with its report.

    Raises:
        ValueError: no cache fits the budget, or none keeps the tolerance (the gate then varies
            within the smallest cells; ask it without a cache).
    """
    report = None
    for margin, caution in CAUTION:
        built = _largest_tables(occupancy, budget, margin, caution)
        if built is None:
            break
        resolution, tables = built
        report = CacheReport(resolution, tables.bytes, 1.0, 1.0, 0, 1.0, margin, caution)
        cache = CellCache(tables, occupancy.space, report).to(occupancy.space.center.device)
        report = cache.report = _check(cache, occupancy, check_points, seed)
        if report.differing_bound <= ALLOWANCE * tolerance:
            return cache
    if report is None:
        raise ValueError(f"no cache of this gate fits {budget} bytes")
    raise ValueError(
        f"the gate varies within cells of 1/{report.resolution * BRICK} of the cube, the finest "
        f"that fit {budget} bytes: {report.differing:.2g} of the decisions differ, "
        f"{tolerance:g} may"
    )


def _largest_tables(
    occupancy: OccupancyLike, budget: int, margin: float, caution: float
) -> tuple[int, Tables] | None:
    """The finest tables within the budget, and their resolution."""
    probe = RESOLUTIONS[len(RESOLUTIONS) // 8]
    mixed_share = (_coarse_states(occupancy, probe, margin) == MIXED).sum().item() / probe**2
    for resolution in reversed(RESOLUTIONS):
        # The gate's boundary is a surface: four times the resolution, sixteen times the cells.
        mixed = mixed_share * resolution**2
        if _bytes(resolution, mixed, mixed * BRICK**2) > 1.1 * budget:
            continue
        states = _coarse_states(occupancy, resolution, margin)
        mixed = int((states == MIXED).sum())
        if _bytes(resolution, mixed, mixed * BRICK**2 / 2) > budget:
            continue
        tables = _tables(occupancy, states, margin, caution)
        if tables.bytes <= budget:
            return resolution, tables
    return None


def _bytes(resolution: int, bricks: float, planes: float) -> float:
    return (
        (resolution + 2) ** 3 * (2 if bricks < 2**15 else 4)
        + bricks * (BRICK**3 + 4)
        + planes * 5
        + 4 * resolution**3
    )


def _coarse_states(occupancy: OccupancyLike, resolution: int, margin: float) -> Tensor:
    """States of the coarse cells, judged at their corners, edges and centres; [n, n, n]."""
    points = _lattice(2 * resolution, occupancy.space.center.device)
    logits = _logits(occupancy, points).view(1, 1, *[2 * resolution + 1] * 3)
    return _judge(logits, 2, margin)[0, 0]


def _lattice(intervals: int, device: torch.device) -> Tensor:
    """Points of a lattice over the mapped cube, [(intervals + 1)^3, 3]."""
    axis = torch.linspace(-1.0, 1.0, intervals + 1, device=device)
    return torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).view(-1, 3)


def _logits(occupancy: OccupancyLike, mapped: Tensor) -> Tensor:
    """How far the logit of o lies above that of the threshold at mapped positions [N, 3]; [N].

    Finite: float32 says o = 1 from a logit of 17 on.
    """
    threshold = torch.tensor(occupancy.threshold, device=mapped.device).logit(eps=1e-7)
    values = [
        occupancy.query(occupancy.space.unmap(part)).float().logit(eps=1e-7) - threshold
        for part in mapped.split(POINTS_AT_ONCE)
    ]
    return torch.cat(values)


def _judge(logits: Tensor, stride: int, margin: float) -> Tensor:
    """States of the cells that span `stride` intervals of a lattice.

    Args:
        logits: [B, 1, n, n, n] at lattice points, n = stride * cells + 1.

    Returns:
        uint8 [B, 1, cells, cells, cells].
    """
    high = max_pool3d(logits, stride + 1, stride)
    low = -max_pool3d(-logits, stride + 1, stride)
    room = (high - low) * margin
    states = torch.full_like(high, MIXED, dtype=torch.uint8)
    states[high + room < 0.0] = EMPTY
    states[low - room >= 0.0] = OCCUPIED
    return states


def _tables(occupancy: OccupancyLike, states: Tensor, margin: float, caution: float) -> Tables:
    """All tables, from the states of the coarse cells [n, n, n]."""
    resolution, device = states.shape[0], states.device
    mixed = (states == MIXED).nonzero()
    dtype = torch.int16 if len(mixed) < 2**15 else torch.int32
    coarse = torch.full_like(states, COARSE_EMPTY, dtype=dtype)
    coarse[states == OCCUPIED] = COARSE_OCCUPIED
    coarse[states == MIXED] = torch.arange(len(mixed), device=device, dtype=dtype)
    bricks = [_bricks(occupancy, part, resolution, margin, caution) for part in mixed.split(128)]
    fine_states = torch.cat(
        [torch.zeros(0, BRICK**3, dtype=torch.uint8, device=device)] + [b[0] for b in bricks]
    )
    planes = torch.cat(
        [torch.zeros(5, 0, dtype=torch.int8, device=device)] + [b[1] for b in bricks], dim=1
    )
    holds_plane = fine_states == MIXED
    number = holds_plane.cumsum(dim=1) - 1
    fine = torch.full_like(fine_states, FINE_EMPTY)
    fine[fine_states == OCCUPIED] = FINE_OCCUPIED
    fine[holds_plane] = number[holds_plane].to(torch.uint8)
    counts = holds_plane.sum(dim=1)
    return Tables(
        coarse=pad(coarse, [1] * 6, value=COARSE_OUTSIDE).view(-1),
        fine=fine,
        first_plane=(counts.cumsum(0) - counts).to(torch.int32),
        planes=planes.contiguous(),
        clearance=_clearance(states, mixed, fine_states),
    )


def _bricks(
    occupancy: OccupancyLike, cells: Tensor, resolution: int, margin: float, caution: float
) -> tuple[Tensor, Tensor]:
    """States [n, 64] of the fine cells of some mixed coarse cells [n, 3], and planes [5, m]."""
    points = (_lattice(2 * BRICK, cells.device) + 1.0) / 2.0
    mapped = (cells[:, None, :] + points) * (2.0 / resolution) - 1.0
    logits = _logits(occupancy, mapped.reshape(-1, 3)).view(-1, 1, *[2 * BRICK + 1] * 3)
    states = _judge(logits, 2, margin).view(len(cells), -1)
    # The 27 lattice points of each fine cell.
    windows = logits[:, 0].unfold(1, 3, 2).unfold(2, 3, 2).unfold(3, 3, 2).flatten(4).flatten(1, 3)
    owner, fine = (states == MIXED).nonzero().unbind(-1)
    corner = torch.stack([fine // BRICK**2, fine // BRICK % BRICK, fine % BRICK], dim=-1) / BRICK
    corner = (cells[owner] + corner) * (2.0 / resolution) - 1.0
    return states, _planes(
        occupancy, windows[owner, fine], corner, 2.0 / resolution / BRICK, caution
    )


def _planes(
    occupancy: OccupancyLike, values: Tensor, corners: Tensor, size: float, caution: float
) -> Tensor:
    """Planes through the logits of fine cells; int8 [5, m].

    A plane's error is what random points of its cell show where it errs, and half the spread of
    its residuals: few cells bend sharply, and only there the error is much larger than that.

    Args:
        values: logits at the lattice points of each cell, [m, 27].
        corners: mapped corners of the cells, [m, 3].
        size: width of a cell in the mapped cube.
    """
    design = torch.cat([values.new_ones(27, 1), _lattice(2, values.device)], dim=1)
    # Only where the plane is zero matters: points far from the threshold count for less.
    scale = (values.amax(dim=1) - values.amin(dim=1)).clamp(min=1e-6) / 4.0
    weights = 1.0 / (1.0 + (values / scale[:, None]).square())
    weighted = weights[:, :, None] * design
    system = weighted.mT @ design + 1e-6 * torch.eye(4, device=values.device)
    planes = torch.linalg.solve(system, (weighted.mT @ values[:, :, None]))[..., 0]
    unit = planes.abs().amax(dim=1, keepdim=True).clamp(min=1e-6) / 127.0
    planes = (planes / unit).round()
    spread = (planes @ design.T - values / unit).square().mean(dim=1).sqrt()

    generator = torch.Generator(values.device).manual_seed(len(values))
    units = torch.rand(len(values), TRIALS, 3, device=values.device, generator=generator)
    mapped = corners[:, None, :] + units * size
    truth = _logits(occupancy, mapped.reshape(-1, 3)).view(len(values), TRIALS) >= 0.0
    heights = torch.einsum("mtc,mc->mt", units * 2.0 - 1.0, planes[:, 1:]) + planes[:, :1]
    errs = (heights.abs() * ((heights > 0.0) != truth)).amax(dim=1)
    error = (caution * (errs + 0.5 * spread)).ceil().clamp(max=127.0)
    return torch.cat([planes, error[:, None]], dim=1).T.to(torch.int8)


def _clearance(states: Tensor, mixed: Tensor, fine_states: Tensor) -> Tensor:
    """The clearance table, from the states of coarse [n, n, n] and fine [n_mixed, 64] cells."""
    half = BRICK // 2
    taken = (states != EMPTY).repeat_interleave(2, 0).repeat_interleave(2, 1)
    taken = taken.repeat_interleave(2, 2).float()
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


def _check(cache: CellCache, occupancy: OccupancyLike, points: int, seed: int) -> CacheReport:
    """Compare fresh random decisions, uniform in the mapped cube, with the gate's own."""
    device = cache.coarse.device
    generator = torch.Generator(device).manual_seed(seed)
    differing = asked = 0
    for done in range(0, points, POINTS_AT_ONCE):
        n = min(POINTS_AT_ONCE, points - done)
        mapped = torch.rand(n, 3, device=device, generator=generator) * 2.0 - 1.0
        positions = occupancy.space.unmap(mapped)
        decided, left_open = cache.decide(positions)
        by_gate = occupancy.occupied(positions)
        decided[left_open] = by_gate[left_open]
        differing += int((decided != by_gate).sum())
        asked += len(left_open)
    return dataclasses.replace(
        cache.report,
        differing=differing / points,
        differing_bound=(differing + 2.0 * math.sqrt(differing) + 2.0) / points,
        checked=points,
        asked=asked / points,
    )
