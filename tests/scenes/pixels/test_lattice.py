"""The lattice of held-out pixels: as thin as it can be, and every pixel of it in one share."""

from __future__ import annotations

import pytest
import torch

from leco_plugin.scenes.pixels.held_out_pixels import PERIODS, WANTED, Lattice, lattice_for


def pixels_of(height: int, width: int) -> torch.Tensor:
    return torch.cartesian_prod(torch.zeros(1).long(), torch.arange(height), torch.arange(width))


@pytest.mark.parametrize("period", PERIODS)
def test_one_pixel_in_a_period_squared_is_held_out_and_a_quarter_of_them_checks(period) -> None:
    lattice = Lattice(period)
    pixels = pixels_of(40 * period, 40 * period)
    held_out = pixels[lattice.holds_out(pixels)]
    assert len(held_out) == 40 * 40
    assert int(lattice.is_of(held_out, "recheck").sum()) == 400
    assert bool((lattice.is_of(held_out, "recheck") ^ lattice.is_of(held_out, "calibration")).all())
    assert bool(lattice.is_of(held_out, "all").all())


@pytest.mark.parametrize("period", PERIODS)
@pytest.mark.parametrize("size", [(48, 64), (7, 30), (11, 12)])
def test_what_is_drawn_is_all_that_is_held_out(period: int, size: tuple[int, int]) -> None:
    lattice = Lattice(period)
    drawn = lattice.draw(torch.tensor([size]), 10_000, torch.Generator().manual_seed(0))
    pixels = pixels_of(*size)
    expected = pixels[lattice.holds_out(pixels)]
    assert torch.equal(drawn.unique(dim=0), expected) and len(drawn) == len(expected)
    assert lattice.counts(torch.tensor([size])).prod() == len(expected)


def test_many_pictures_are_thinly_held_out_and_few_small_ones_densely() -> None:
    assert lattice_for([(480, 270)] * 50) == Lattice(11)
    assert lattice_for([(48, 64)] * 48) == Lattice(5)
    assert lattice_for([(4, 4)]) == Lattice(5)
    periods = [lattice_for([(100, 100)] * count).period for count in (40, 70, 110, 150)]
    assert periods == [5, 7, 9, 11]


@pytest.mark.parametrize("pictures", [50, 70, 110, 160])
def test_as_many_as_are_wanted_are_held_out_where_that_is_possible(pictures: int) -> None:
    sizes = torch.tensor([(100, 100)] * pictures)
    lattice = lattice_for(sizes)
    thinner = [period for period in PERIODS if period > lattice.period]
    assert int(lattice.counts(sizes).prod(dim=-1).sum()) >= WANTED
    assert all(int(Lattice(p).counts(sizes).prod(dim=-1).sum()) < WANTED for p in thinner)
