"""Occupancy grids of growing resolution from a field's density, each refined from the one before.

A cell is asked only where the coarser grid, or a neighbour of its cell, has not ruled it out; so
512^3 cells take as long as their surface asks for.
"""

from __future__ import annotations

import os
from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import max_pool3d

from leco_plugin.evaluation.inspection import ViewBox
from leco_plugin.samplers.grid import cells_of

FEWEST_PROBES, PROBES_ALONG = 8, 2048
"""Densities asked in each cell, at random places; the largest is the cell's score. More in coarse
cells, of which a surface may fill a corner."""
CELLS_AT_ONCE = 1 << 18
BYTES_A_CELL = 16
"""Of memory while a grid is filled, about."""


def filled(
    density: Callable[[Tensor], Tensor],
    box: ViewBox,
    resolution: int,
    coarser: Tensor | None = None,
    floor: float = 0.0,
    seed: int = 0,
    known: tuple[Tensor, Tensor] | None = None,
) -> Tensor:
    """Scores of the cells of a grid: [n, n, n].

    Args:
        density: mapped positions [N, 3] to [N].
        box: in mapped coordinates.
        resolution: n, twice that of `coarser`.
        coarser: [n/2, n/2, n/2] scores; without it every cell is asked.
        floor: score of the coarser grid below which a cell and all around it are taken for empty.
        known: mapped positions [M, 3] and densities [M] that count beside those that are asked:
            a surface that fills a thousandth of a cell is missed by hundreds of random places.
    """
    device = box.low.device
    if coarser is None:
        asked = torch.ones([resolution] * 3, dtype=torch.bool, device=device)
    else:
        near = max_pool3d(coarser[None, None], 3, stride=1, padding=1)[0, 0] >= floor
        asked = near.repeat_interleave(2, 0).repeat_interleave(2, 1).repeat_interleave(2, 2)
    scores = torch.zeros([resolution] * 3, device=device)
    generator = torch.Generator(device).manual_seed(seed)
    for cells in asked.nonzero().split(CELLS_AT_ONCE):
        best = torch.zeros(len(cells), device=device)
        for _ in range(max(FEWEST_PROBES, PROBES_ALONG // resolution)):
            units = cells + torch.rand(len(cells), 3, device=device, generator=generator)
            places = torch.lerp(box.low, box.high, units / resolution)
            best = torch.maximum(best, density(places).float())
        scores[tuple(cells.T)] = best
    if known is not None:
        index, inside = _cells(scores, box, known[0])
        scores.view(-1).scatter_reduce_(0, index.long(), known[1].float() * inside, "amax")
    return scores


def looked_up(scores: Tensor, box: ViewBox, mapped: Tensor) -> Tensor:
    """Scores of the cells that hold mapped positions [N, 3]; zero outside: [N]."""
    index, inside = _cells(scores, box, mapped)
    return scores.view(-1).index_select(0, index) * inside


def _cells(scores: Tensor, box: ViewBox, mapped: Tensor) -> tuple[Tensor, Tensor]:
    return cells_of((1, *scores.shape), torch.cat([box.low, box.high]), mapped)


def fits_memory(resolution: int) -> bool:
    """Whether a grid can be filled in half of the memory that is free."""
    free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return BYTES_A_CELL * resolution**3 < free / 2
