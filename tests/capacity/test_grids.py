"""Claims about grids that are refined from coarser ones."""

from __future__ import annotations

import torch
from torch import Tensor

from leco_plugin.capacity.grids import filled, fits_memory, looked_up
from leco_plugin.evaluation.inspection import ViewBox

BOX = ViewBox(torch.tensor([-1.0, -1.0, -0.5]), torch.tensor([1.0, 1.0, 0.5]))


def ball(mapped: Tensor) -> Tensor:
    return (mapped.norm(dim=-1) < 0.4).float()


def test_a_cell_has_the_density_of_the_place() -> None:
    scores = filled(ball, BOX, 16)
    mapped = torch.lerp(BOX.low, BOX.high, torch.rand(5000, 3))
    found = looked_up(scores, BOX, mapped)
    distances = mapped.norm(dim=-1)
    diagonal = ((BOX.high - BOX.low) / 16).norm()
    assert bool((found[distances < 0.4 - diagonal] == 1.0).all())
    assert bool((found[distances > 0.4 + diagonal] == 0.0).all())


def test_outside_the_box_there_is_nothing() -> None:
    scores = torch.ones(4, 4, 4)
    assert looked_up(scores, BOX, torch.tensor([[0.0, 0.0, 0.6], [0.0, 0.0, 0.4]])).tolist() == [
        0,
        1,
    ]


def test_refining_finds_what_asking_every_cell_finds_with_fewer_questions() -> None:
    asked = [0]

    def counted(mapped: Tensor) -> Tensor:
        asked[0] += len(mapped)
        return ball(mapped)

    coarse = filled(ball, BOX, 16)
    refined = filled(counted, BOX, 32, coarse, floor=0.5)
    whole = filled(ball, BOX, 32)
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

    seen = torch.tensor([[0.3, 0.3, 0.061], [0.3, 0.3, 0.7]])  # the second lies outside
    known = seen, torch.tensor([1.0, 5.0])
    scores = filled(film, BOX, 8, known=known)
    assert float(looked_up(scores, BOX, seen[:1])) == 1.0
    assert float(scores.sum()) == 1.0
    assert float(filled(film, BOX, 8).sum()) == 0.0


def test_memory_is_looked_at_before_a_grid_is_filled() -> None:
    assert fits_memory(8) and not fits_memory(1 << 15)
