"""Building a cell cache: the finest cells that fit a budget, checked against the gate.

The cache is compared with the gate at random positions: half of them anywhere in the mapped cube,
half where it is not empty, because rays look at surfaces. While too many decisions differ, planes
decide more cautiously, and then cells are judged with a larger margin (`judging.py`).
"""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Iterator

import torch
from torch import Tensor
from torch.nn.functional import pad

from leco_plugin.samplers.cells.cache import (
    BRICK,
    COARSE_EMPTY,
    COARSE_OCCUPIED,
    EMPTY,
    FINE_EMPTY,
    FINE_OCCUPIED,
    MIXED,
    OCCUPIED,
    CacheReport,
    CellCache,
    OccupancyLike,
    Tables,
)
from leco_plugin.samplers.cells.judging import (
    LEAST_MARGIN,
    POINTS_AT_ONCE,
    Look,
    clearance_of,
    fit_planes,
    judge_coarse,
    judge_fine,
    look,
)

RESOLUTIONS = range(8, 65)
"""Coarse cells along the cube that are considered."""
PROBE = 16
"""Coarse cells along the cube at which the gate is looked at first."""
SCOUT = 24
"""Coarse cells along the cube from which the size of finer tables is predicted."""
AIM = 0.95
"""Share of the budget that predicted tables may take: judging cells too fine costs a second."""
MARGINS = (LEAST_MARGIN, 0.5, 2.0)
CAUTIONS = (*(0.6 * 1.1**step for step in range(20)), 5.0, math.inf)
"""Margins and cautions in the order in which they are tried; see `CacheReport`."""
ROUGH = 0.6
"""Share of the probe's cells that the gate's boundary may cross; a rougher gate has no cache."""
ASKED = 0.003
"""Share of decisions that may be left to the gate; still finer cells are not worth their time."""
MOST_POINTS = 1 << 20
"""Decisions that are compared with the gate's, unless the caller says otherwise."""
BRICKS_AT_ONCE = 128


@torch.no_grad()
def build_cache(
    occupancy: OccupancyLike,
    *,
    budget: int = 1 << 20,
    tolerance: float = 1e-4,
    check_points: int | None = None,
) -> CellCache:
    """The finest cache of a frozen occupancy that fits a budget and keeps its decisions.

    It asks the gate about 5 million positions for the default budget, most near its boundary.

    Args:
        occupancy: the frozen gate with its space and threshold.
        budget: most bytes of its tables.
        tolerance: largest share of decisions that may differ from the gate's, at two standard
            deviations above the measured share.
        check_points: number of decisions that are compared. The default is one for each byte of
            the budget; at least so many that three may differ, and at most 1,048,576.

    Returns:
        The cache, on the occupancy's device, with its report.

    Raises:
        ValueError: no cache fits the budget, or none keeps the tolerance (the gate then varies
            within the smallest cells; ask it without a cache).
    """
    if check_points is None:
        fewest = math.ceil(10.0 / max(tolerance, 1e-5))  # of three that differ, the bound is 8.5
        check_points = min(max(budget, fewest), MOST_POINTS)
    device = occupancy.space.center.device
    if device.type == "mps":  # lacks some of what judging takes, none of what looking up takes
        cpu = copy.deepcopy(occupancy).to("cpu")  # type: ignore[attr-defined]
        cache = build_cache(cpu, budget=budget, tolerance=tolerance, check_points=check_points)
        return cache.to(device)
    probe, seen = look(occupancy, PROBE)
    enough = _finest_of_use(probe)
    compared = _decisions(occupancy, probe != EMPTY, check_points)
    report = None
    for margin in MARGINS:
        # after a failure the gate is asked everywhere: the probe may have missed something
        look_of_probe = seen if margin == LEAST_MARGIN else None
        finest = _largest_tables(occupancy, budget, enough, margin, look_of_probe)
        if finest is None:
            break
        for cache in _more_and_more_cautious(occupancy, *finest, margin):
            report = cache.report = _check(cache, *compared)
            if report.differing_bound <= tolerance:
                return cache
    if report is None:
        raise ValueError(f"no cache of this gate fits {budget} bytes")
    raise ValueError(
        f"the gate varies within cells of 1/{report.resolution * BRICK} of the cube, the finest "
        f"that fit {budget} bytes: {report.differing:.2g} of the decisions differ, "
        f"{tolerance:g} may"
    )


def _finest_of_use(probe: Tensor) -> float:
    """The resolution beyond which cells are not worth their time, from the states of a probe.
    ValueError if the gate's boundary crosses too many of its cells."""
    mixed = int((probe == MIXED).sum())
    if mixed > ROUGH * PROBE**3:
        raise ValueError(
            f"the gate's boundary crosses {mixed / PROBE**3:.0%} of the cells of 1/{PROBE} of the "
            "cube: it is too rough to be held in cells"
        )
    surface = mixed / PROBE**2
    # A plane leaves open a share of its cell proportional to its size, 0.2 at resolution 32.
    weight = 0.5 + 0.5 / max(1e-3, float((probe != EMPTY).float().mean()))
    return math.sqrt(0.2 * 32 / BRICK * surface * weight / ASKED)


def _more_and_more_cautious(
    occupancy: OccupancyLike, resolution: int, tables: Tables, doubts: Tensor, margin: float
) -> Iterator[CellCache]:
    """Caches of these tables, whose planes decide less and less; unchecked. Each ends the last."""
    for caution in CAUTIONS:
        heights = (caution * doubts.clamp(min=1e-6)).ceil().clamp(max=127.0)
        tables.planes[4, : len(doubts)] = heights
        if math.isinf(caution):
            tables.planes[:4] = 0  # planes that never decide
        report = CacheReport(resolution, tables.bytes, 1.0, 1.0, 0, 1.0, margin, caution)
        yield CellCache(tables, occupancy.space, report)


def _largest_tables(
    occupancy: OccupancyLike, budget: int, enough: float, margin: float, seen: Look | None
) -> tuple[int, Tables, Tensor] | None:
    """The finest tables within the budget that are of use.

    Args:
        enough: resolution beyond which cells are not worth their time.
        seen: as for `judge_coarse`.

    Returns:
        the resolution, the tables, and the doubts about the planes.
    """
    states, corners = judge_coarse(occupancy, SCOUT, margin, seen)
    mixed, planes = _counts(occupancy, states, corners, margin)
    for resolution in reversed(RESOLUTIONS):
        finer = (resolution / SCOUT) ** 2  # the boundary is a surface
        too_large = _bytes(resolution, finer * mixed, finer * planes) > AIM * budget
        if resolution > RESOLUTIONS[0] and (too_large or resolution - RESOLUTIONS.step >= enough):
            continue
        states, corners = judge_coarse(occupancy, resolution, margin, seen)
        if _bytes(resolution, *_counts(occupancy, states, corners, margin)) > budget:
            continue
        tables, doubts = _tables(occupancy, states, corners, margin)
        if tables.bytes <= budget:
            return resolution, tables, doubts
    return None


def _counts(
    occupancy: OccupancyLike, states: Tensor, corners: Tensor, margin: float
) -> tuple[int, float]:
    """Number of mixed coarse cells, and an estimate of mixed fine ones from some bricks."""
    mixed = (states == MIXED).nonzero()
    sample = mixed[:: max(1, len(mixed) // BRICKS_AT_ONCE)]
    planes = int((judge_fine(occupancy, corners, sample, margin)[0] == MIXED).sum())
    return len(mixed), planes * len(mixed) / max(1, len(sample))


def _bytes(resolution: int, bricks: float, planes: float) -> float:
    return (
        (resolution + 2) ** 3 * (2 if bricks < 2**15 else 4)
        + bricks * (BRICK**3 + 4)
        + planes * 5
        + 4 * resolution**3
    )


def _tables(
    occupancy: OccupancyLike, states: Tensor, corners: Tensor, margin: float
) -> tuple[Tables, Tensor]:
    """All tables from `judge_coarse`'s cells, and the planes' doubts [m].

    The heights up to which planes do not decide are left at 0.
    """
    device = states.device
    mixed = (states == MIXED).nonzero()
    dtype = torch.int16 if len(mixed) < 2**15 else torch.int32
    coarse = torch.full_like(states, COARSE_EMPTY, dtype=dtype)
    coarse[states == OCCUPIED] = COARSE_OCCUPIED
    coarse[states == MIXED] = torch.arange(len(mixed), device=device, dtype=dtype)
    fine_states = torch.empty(len(mixed), BRICK**3, dtype=torch.uint8, device=device)
    planes, doubts = [torch.zeros(0, 5, dtype=torch.int8, device=device)], [corners[0, 0, :0]]
    for first in range(0, len(mixed), BRICKS_AT_ONCE):
        part = slice(first, first + BRICKS_AT_ONCE)
        fine_states[part], values, places = judge_fine(occupancy, corners, mixed[part], margin)
        plane, doubt = fit_planes(occupancy, values, places, 2.0 / (BRICK * len(states)))
        planes.append(pad(plane.to(torch.int8), (0, 1)))
        doubts.append(doubt)
    holds_plane = fine_states == MIXED
    number = holds_plane.cumsum(dim=1) - 1
    fine = torch.full_like(fine_states, FINE_EMPTY)
    fine[fine_states == OCCUPIED] = FINE_OCCUPIED
    fine[holds_plane] = number[holds_plane].to(torch.uint8)
    counts = holds_plane.sum(dim=1)
    tables = Tables(
        coarse=pad(coarse, [1] * 6, value=COARSE_EMPTY),
        fine=fine,
        first_plane=(counts.cumsum(0) - counts).to(torch.int32),
        planes=torch.cat(planes).T.contiguous(),
        clearance=clearance_of(states, mixed, fine_states),
    )
    if occupancy.space.kind != "box" or occupancy.threshold <= 0.0:
        tables = _with_open_border(tables)
    return tables._replace(coarse=tables.coarse.view(-1)), torch.cat(doubts)


def _with_open_border(tables: Tables) -> Tables:
    """The tables with everything outside the cube left to the gate.

    (A bounded occupancy with a threshold above 0 is empty there and needs no such border.)
    """
    border = torch.ones_like(tables.coarse, dtype=torch.bool)
    border[1:-1, 1:-1, 1:-1] = False
    # One more brick, all of whose cells hold one more plane, which is 0 and never decides.
    coarse = tables.coarse.masked_fill(border, len(tables.fine))
    planes = tables.planes.shape[1]
    return tables._replace(
        coarse=coarse,
        fine=pad(tables.fine, (0, 0, 0, 1)),
        first_plane=pad(tables.first_plane, (0, 1), value=planes),
        planes=pad(tables.planes, (0, 1)),
    )


def _decisions(occupancy: OccupancyLike, filled: Tensor, points: int) -> tuple[Tensor, Tensor]:
    """Random positions, always the same, half in filled cells, and what the gate decides there.

    Args:
        filled: which cells of the mapped cube are not empty, bool [n, n, n].

    Returns:
        positions in world units [points, 3] and bool [points].
    """
    device = filled.device
    generator = torch.Generator(device).manual_seed(0)
    mapped = torch.rand(points, 3, dtype=torch.float32, device=device, generator=generator)
    cells = filled.nonzero()
    if len(cells):
        chosen = torch.randint(len(cells), (points // 2,), device=device, generator=generator)
        mapped[: points // 2] = (mapped[: points // 2] + cells[chosen]) / len(filled)
    positions = occupancy.space.unmap(mapped * 2.0 - 1.0)
    decided = [occupancy.occupied(part) for part in positions.split(POINTS_AT_ONCE)]
    return positions, torch.cat(decided)


def _check(cache: CellCache, positions: Tensor, by_gate: Tensor) -> CacheReport:
    """The cache's report with its decisions about positions compared with the gate's."""
    differing = asked = 0
    for part, answers in zip(
        positions.split(POINTS_AT_ONCE), by_gate.split(POINTS_AT_ONCE), strict=True
    ):
        decided, left_open = cache.decide(part)
        decided[left_open] = answers[left_open]
        differing += int((decided != answers).sum())
        asked += len(left_open)
    points = len(positions)
    return dataclasses.replace(
        cache.report,
        differing=differing / points,
        differing_bound=(differing + 2.0 * math.sqrt(differing) + 2.0) / points,
        checked=points,
        asked=asked / points,
    )
