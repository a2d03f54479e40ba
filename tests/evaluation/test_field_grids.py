"""Claims about grids that are refined from coarser ones."""

from __future__ import annotations

import itertools
from functools import partial

import pytest
import torch
from torch import Tensor

from leco_plugin.evaluation import clock, field_grids
from leco_plugin.evaluation.field_grids import (
    cells_to_ask,
    fill_cells,
    fill_grids,
    fits_memory,
    look_up_scores,
    octree_bytes,
)
from leco_plugin.evaluation.inspection import ViewBox

BOX = ViewBox(torch.tensor([-1.0, -0.6, -0.7]), torch.tensor([0.8, 1.0, 0.5]))
CUBE, FINE = 16, 32


def ball(mapped: Tensor) -> Tensor:
    return (mapped.norm(dim=-1) < 0.4).float()


def test_a_cell_has_the_density_of_the_place() -> None:
    scores = fill_cells(ball, BOX, cells_to_ask(CUBE))
    mapped = torch.lerp(BOX.low, BOX.high, torch.rand(5000, 3))
    found = look_up_scores(scores, BOX, mapped)
    distances = mapped.norm(dim=-1)
    diagonal = ((BOX.high - BOX.low) / 16).norm()
    assert bool((found[distances < 0.4 - diagonal] == 1.0).all())
    assert bool((found[distances > 0.4 + diagonal] == 0.0).all())


def test_outside_the_box_there_is_nothing() -> None:
    places = torch.tensor([[0.0, 0.0, 0.6], [0.0, 0.0, 0.4]])
    assert look_up_scores(torch.ones(4, 4, 4), BOX, places).tolist() == [0, 1]


def test_refining_finds_what_asking_every_cell_finds_with_fewer_questions() -> None:
    asked = [0]

    def counted(mapped: Tensor) -> Tensor:
        asked[0] += len(mapped)
        return ball(mapped)

    coarse = fill_cells(ball, BOX, cells_to_ask(CUBE))
    refined = fill_cells(counted, BOX, cells_to_ask(FINE, coarse, floor=0.5))
    whole = fill_cells(ball, BOX, cells_to_ask(FINE))
    assert float((refined == whole).float().mean()) > 0.98  # other places in the cells were asked
    middles = torch.stack(
        torch.meshgrid(*[(torch.arange(32) + 0.5) / 32] * 3, indexing="ij"), dim=-1
    )
    inside = ball(torch.lerp(BOX.low, BOX.high, middles).view(-1, 3)).view(32, 32, 32) > 0
    assert float(refined[inside].mean()) > 0.97
    assert asked[0] < 0.5 * 64 * 32**3


def test_a_known_surface_is_never_missed_by_a_coarse_cell() -> None:
    def film(mapped: Tensor) -> Tensor:
        return ((mapped[:, 2] - 0.061).abs() < 1e-6).float()

    seen = torch.tensor([[0.3, 0.1, 0.061], [0.3, 0.1, 0.7]])  # the second lies outside
    known = seen, torch.tensor([1.0, 5.0])
    scores = fill_cells(film, BOX, cells_to_ask(8), known=known)
    assert float(look_up_scores(scores, BOX, seen[:1])) == 1.0
    assert float(scores.sum()) == 1.0
    assert float(fill_cells(film, BOX, cells_to_ask(8)).sum()) == 0.0


def test_memory_is_looked_at_before_a_grid_is_filled(monkeypatch: pytest.MonkeyPatch) -> None:
    assert fits_memory(8**3) and not fits_memory(1 << 45)
    for free, fits in ((None, True), (2 * field_grids.BYTES_A_CELL * 1000, False), (1 << 40, True)):
        monkeypatch.setattr(field_grids, "free_memory", lambda free=free: free)
        assert fits_memory(1000) is fits


def slow_refined(coarse: Tensor, floor: float, density: Tensor) -> Tensor:
    """Cell by cell: the density of a fine cell if its coarse one or a neighbour may hold some."""
    found = torch.zeros_like(density)
    for cell in itertools.product(*(range(n) for n in density.shape)):
        parent = [i // 2 for i in cell]
        around = [range(max(0, i - 1), min(n, i + 2)) for i, n in zip(parent, coarse.shape)]
        if any(float(coarse[near]) >= floor for near in itertools.product(*around)):
            found[cell] = density[cell]
    return found


@pytest.mark.parametrize("seed", range(3))
def test_a_cell_is_asked_where_the_coarser_grid_has_not_ruled_it_out(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    cells = torch.rand(12, 12, 12, generator=generator)  # the same density anywhere in a cell
    coarse = torch.rand(6, 6, 6, generator=generator)
    floor = float(coarse.flatten().sort().values[-5])  # a cell at it is not below it
    found = fill_cells(
        partial(look_up_scores, cells, BOX), BOX, cells_to_ask(12, coarse, floor=floor)
    )
    expected = slow_refined(coarse, floor, cells)
    assert 0 < int((found > 0).sum()) < found.numel()
    assert torch.equal(found > 0, expected > 0)
    assert float((found == expected).float().mean()) > 0.99  # a place may be rounded next door


def test_known_places_count_like_a_loop_over_them() -> None:
    generator = torch.Generator().manual_seed(4)
    places = torch.rand(200, 3, generator=generator) * 2.4 - 1.2
    densities = torch.rand(200, generator=generator)
    nobody = torch.zeros(4, 3, 2, dtype=torch.bool)
    found = fill_cells(ball, BOX, nobody, known=(places, densities))
    expected = torch.zeros(4, 3, 2)
    for place, density in zip(places, densities):
        shares = (place - BOX.low) / (BOX.high - BOX.low)
        if bool(((shares >= 0.0) & (shares <= 1.0)).all()):
            cell = tuple((shares * torch.tensor([4, 3, 2])).long().tolist())
            expected[cell] = max(float(expected[cell]), float(density))
    torch.testing.assert_close(found, expected)


def test_a_grid_serves_the_next_one_only_if_that_is_twice_as_fine() -> None:
    asked: list[int] = []

    def counted(mapped: Tensor) -> Tensor:
        asked.append(len(mapped))
        return ball(mapped)

    def questions(*resolutions: int) -> int:
        before, grids = [sum(asked)], []
        for grid in fill_grids(counted, BOX, None, resolutions, lambda scores: 0.5):
            before.append(sum(asked))
            grids.append(grid)
        scores, seconds = grids[-1]
        assert scores is not None and scores.shape == resolutions[-1:] * 3 and seconds > 0.0
        return before[-1] - before[-2]

    assert questions(16, 32) < questions(32) == questions(12, 32)


def test_the_time_of_a_grid_is_that_of_the_coarser_ones_too(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A question takes a second; a grid of n cells a side asks 2048 / n times, 8 times at least."""
    asked = [0.0]

    def density(mapped: Tensor) -> Tensor:
        asked[0] += 1.0
        return torch.zeros(len(mapped))

    monkeypatch.setattr(clock, "seconds_now", lambda: asked[0])
    grids = fill_grids(density, BOX, None, (16, 32, 12), lambda scores: 0.0)
    assert [seconds for _, seconds in grids] == [128.0, 128.0 + 64.0, 170.0]
    assert [field_grids.probes_in_a_cell(n) for n in (128, 256, 300, 512)] == [16, 8, 8, 8]


def test_a_grid_that_asks_more_than_it_may_is_filled_only_from_a_coarser_one() -> None:
    most = 32**3 * 64 - 1
    for resolutions, are_filled in (((FINE,), [False]), ((CUBE, FINE), [True, True])):
        grids = fill_grids(ball, BOX, None, resolutions, lambda scores: 0.5, most)
        assert [scores is not None for scores, _ in grids] == are_filled


def node_bytes(kept: Tensor) -> int:
    """What a node of kept cells and all below it take, one after another."""
    if len(kept) == 1 or kept.all() or not kept.any():
        return 0
    half = len(kept) // 2
    if half == 1:
        return 1
    sides = (slice(0, half), slice(half, None))
    return 2 + sum(node_bytes(kept[x, y, z]) for x, y, z in itertools.product(sides, repeat=3))


@pytest.mark.parametrize("share", [0.0, 0.001, 0.1, 0.9, 1.0])
def test_an_octree_takes_what_its_nodes_take_one_after_another(share: float) -> None:
    coarse = torch.rand(4, 4, 4) < share  # whole nodes are full
    kept = coarse.repeat_interleave(4, 0).repeat_interleave(4, 1).repeat_interleave(4, 2)
    kept |= torch.rand(16, 16, 16) < share / 10.0
    assert octree_bytes(kept) == node_bytes(kept)
    few, padded = torch.rand(5, 5, 5) < 0.3, torch.zeros(8, 8, 8, dtype=torch.bool)
    padded[:5, :5, :5] = few  # as of the next power of two
    assert octree_bytes(few) == octree_bytes(padded) == node_bytes(padded) > 0
