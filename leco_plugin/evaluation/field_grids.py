"""Occupancy grids of a trained field, each refined from the one before if that is half as fine.

Densities are evaluated only in cells that the coarser grid, or a neighbour there, has not ruled
out. The time for 512^3 cells therefore depends on how much surface they hold.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor
from torch.nn.functional import max_pool3d, pad

from leco_plugin.evaluation.clock import Clock
from leco_plugin.evaluation.inspection import ViewBox
from leco_plugin.models.compute.device import free_memory
from leco_plugin.samplers.boxes import cells_of

FEWEST_PROBES, PROBES_ALONG = 8, 2048
"""Densities evaluated at random places of a cell; the largest is its score. More in coarse cells,
of which a surface may fill a corner."""
CELLS_AT_ONCE = 1 << 18
BYTES_A_CELL = 16
"""Of memory while a grid is filled, about."""

Density = Callable[[Tensor], Tensor]
"""Of mapped positions [N, 3]: [N]."""


def fill_grids(
    density: Density,
    box: ViewBox,
    known: tuple[Tensor, Tensor] | None,
    resolutions: Sequence[int],
    floor_of: Callable[[Tensor], float],
    most: float = math.inf,
) -> Iterator[tuple[Tensor | None, float]]:
    """Grids of one field in a box of mapped coordinates: for each of `resolutions`, cells along an
    axis, its scores [n, n, n] and the seconds that it took, those of the grids that it was refined
    from included. A grid is refined from the one before if that is half as fine; else all of its
    cells are asked.

    Args:
        known: mapped positions [M, 3] and densities [M] that count too: hundreds of random places
            miss a surface that fills a thousandth of a cell.
        floor_of: for the scores of a grid, the one below which a cell and its neighbours are empty
            in finer grids too.
        most: densities that may be evaluated for one grid. Of one that asks more, or does not fit
            the free memory, the scores are None.
    """
    scores, floor, clock = None, 0.0, Clock()
    for n in resolutions:
        if not fits_memory(n**3):
            yield None, 0.0
            continue
        if scores is not None and 2 * len(scores) != n:
            scores, clock = None, Clock()
        with clock.running():
            asked = cells_to_ask(n, scores, floor, box.low.device)
            may_ask = int(asked.sum()) * probes_in_a_cell(n) <= most
            if may_ask:
                scores = fill_cells(density, box, asked, known=known)
                floor = floor_of(scores)
        yield scores if may_ask else None, clock.seconds


def cells_to_ask(
    cells: int,
    coarser: Tensor | None = None,
    floor: float = 0.0,
    device: torch.device | str = "cpu",
) -> Tensor:
    """Cells whose density is to be asked: bool [n, n, n]. Without scores of a grid half as fine,
    that is every cell. Otherwise a cell is empty where those of it and all around are below
    `floor`."""
    if coarser is None:
        return torch.ones((cells,) * 3, dtype=torch.bool, device=device)
    near = dilate(coarser) >= floor
    return near.repeat_interleave(2, 0).repeat_interleave(2, 1).repeat_interleave(2, 2)


def probes_in_a_cell(cells: int) -> int:
    """Random places at which each cell is asked, of a grid with so many along an axis."""
    return max(FEWEST_PROBES, PROBES_ALONG // cells)


def fill_cells(
    density: Density, box: ViewBox, asked: Tensor, known: tuple[Tensor, Tensor] | None = None
) -> Tensor:
    """Scores [nx, ny, nz] of cells, zero where they are neither asked, bool [nx, ny, nz], nor
    known: mapped positions [M, 3] and densities [M]."""
    device = box.low.device
    scores = torch.zeros(asked.shape, device=device)
    counts = torch.tensor(asked.shape, device=device)
    generator = torch.Generator(device).manual_seed(0)
    for cells in asked.nonzero().split(CELLS_AT_ONCE):
        best = torch.zeros(len(cells), device=device)
        for _ in range(probes_in_a_cell(max(asked.shape))):
            units = cells + torch.rand(len(cells), 3, device=device, generator=generator)
            places = torch.lerp(box.low, box.high, units / counts)
            best = torch.maximum(best, density(places).float())
        scores[tuple(cells.T)] = best
    return scores if known is None else largest_in_cells(scores, box, *known)


def largest_in_cells(scores: Tensor, box: ViewBox, mapped: Tensor, values: Tensor) -> Tensor:
    """Raises the scores [nx, ny, nz] of cells to the largest value [M] of the mapped positions
    [M, 3] in them; returns them."""
    index, inside = _cells(scores, box, mapped)
    scores.view(-1).scatter_reduce_(0, index.long(), values.float() * inside, "amax")
    return scores


def dilate(scores: Tensor) -> Tensor:
    """Each cell with the score of its largest neighbour: [nx, ny, nz]. Random places in a small
    cell miss what is dense there, and a gate is taught a margin too."""
    return max_pool3d(scores[None, None], 3, stride=1, padding=1)[0, 0]


def look_up_scores(scores: Tensor, box: ViewBox, mapped: Tensor) -> Tensor:
    """Scores of the cells that hold mapped positions [N, 3]; zero outside: [N]."""
    index, inside = _cells(scores, box, mapped)
    return scores.view(-1).index_select(0, index) * inside


def _cells(scores: Tensor, box: ViewBox, mapped: Tensor) -> tuple[Tensor, Tensor]:
    return cells_of((1, *scores.shape), torch.cat([box.low, box.high]), mapped)


def octree_bytes(kept: Tensor) -> int:
    """Bytes of the octree that holds the kept cells, bool [n, n, n], without pointers.

    A node of which some cells are kept says which of its eight children keep any, and above the
    last level also which of them keep all: one byte on the last level, two above it.
    """
    side = 1 << (len(kept) - 1).bit_length()
    some = pad(kept.float(), (0, side - len(kept)) * 3)[None]
    every, total, of_node = some, 0, 1
    while some.shape[-1] > 1:
        some, every = max_pool3d(some, 2), -max_pool3d(-every, 2)
        total += of_node * int((some > every).sum())
        of_node = 2
    return total


def fits_memory(cells: int) -> bool:
    """Whether a grid of so many cells can be filled in half of the memory that is free."""
    free = free_memory()
    return free is None or BYTES_A_CELL * cells < free / 2
