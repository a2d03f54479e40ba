"""How cells are judged, against loops over cells written from the definitions."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from samplers.analytic_occupancy import Balls
from torch import Tensor

from leco_plugin.samplers.cells import judging
from leco_plugin.samplers.cells.cache import BRICK, EMPTY, FARTHEST, MIXED, OCCUPIED
from leco_plugin.samplers.cells.judging import (
    CLOSE,
    LEAST_MARGIN,
    PLAIN_MARGIN,
    TRIALS,
    clearance_of,
    fit_planes,
    judge_coarse,
    judge_fine,
    logits_above,
    look,
)

N = 6


def logit(o: float) -> float:
    return math.log(o / (1.0 - o))


def slow_logit(balls: Balls, mapped: list[float]) -> float:
    """Of o above that of the threshold at one place of the cube."""
    position = balls.space.unmap(torch.tensor([mapped]))
    o = min(max(float(balls.query(position)), 1e-7), 1.0 - 1e-7)
    return logit(o) - logit(balls.threshold)


def slow_state(logits: Tensor, margin: float) -> int:
    low, high = float(logits.min()), float(logits.max())
    if high + margin * (high - low) < 0.0:
        return EMPTY
    return OCCUPIED if low - margin * (high - low) >= 0.0 else MIXED


def places_of(n: int, every: int = 1) -> list[tuple[int, ...]]:
    return list(itertools.product(range(n), repeat=3))[::every]


def unpacked(clearance: Tensor) -> Tensor:
    """The clearance of each half cell, two to a byte, the first in the low bits."""
    return torch.stack([clearance & 15, clearance >> 4], dim=-1).view(-1)


@pytest.fixture(scope="module", params=["box", "contraction"])
def balls(request):
    return Balls(request.param, half_extent=1.3, sharpness=12.0)


def test_logits_are_those_of_the_occupancy_and_finite(balls):
    mapped = torch.rand(50, 3) * 1.9 - 0.95
    expected = [slow_logit(balls, place) for place in mapped.tolist()]
    assert logits_above(balls, mapped).tolist() == pytest.approx(expected, abs=2e-2)
    sure = Balls(sharpness=1e4)
    assert logits_above(sure, mapped).isfinite().all()


@pytest.mark.parametrize(("kind", "half_extent"), [("box", 0.6), ("contraction", 0.3)])
def test_coarse_cells_are_judged_by_the_corners_of_their_fine_ones(kind, half_extent):
    balls = Balls(kind, half_extent, sharpness=12.0)
    for margin in (LEAST_MARGIN, PLAIN_MARGIN):
        states, corners = judge_coarse(balls, N, margin)
        assert corners.shape == (BRICK * N + 1,) * 3
        for x, y, z in places_of(N):
            of_cell = corners[
                BRICK * x : BRICK * (x + 1) + 1,
                BRICK * y : BRICK * (y + 1) + 1,
                BRICK * z : BRICK * (z + 1) + 1,
            ]
            assert int(states[x, y, z]) == slow_state(of_cell, margin)
        assert margin > LEAST_MARGIN or states.unique().tolist() == [EMPTY, OCCUPIED, MIXED]
    for place in places_of(BRICK * N + 1, 997):
        mapped = [2.0 * k / (BRICK * N) - 1.0 for k in place]
        if max(map(abs, mapped)) < 1.0:  # on a face of the cube rounding decides
            assert float(corners[place]) == pytest.approx(slow_logit(balls, mapped), abs=2e-2)


def test_a_look_leaves_open_what_is_beside_a_cell_that_is_not_plain(balls):
    states, seen = look(balls, N)
    assert states.equal(judge_coarse(balls, N, LEAST_MARGIN)[0])
    unsure = judge_coarse(balls, N, PLAIN_MARGIN)[0] == MIXED
    for x, y, z in places_of(N):
        beside = unsure[max(x - 1, 0) : x + 2, max(y - 1, 0) : y + 2, max(z - 1, 0) : z + 2]
        assert bool(seen.open[x, y, z]) == bool(beside.any())
    assert 0 < int(seen.open.sum()) < N**3


def test_a_finer_look_asks_only_in_open_cells_and_finds_the_same_cells(balls):
    _, seen = look(balls, N)
    everywhere, corners = judge_coarse(balls, 2 * N, LEAST_MARGIN)
    balls.asked = 0
    states, relied = judge_coarse(balls, 2 * N, LEAST_MARGIN, seen)
    assert balls.asked < corners.numel()
    assert states.equal(everywhere)
    for place in places_of(BRICK * 2 * N + 1, 101):
        cell = tuple(min(k // (2 * BRICK), N - 1) for k in place)
        if bool(seen.open[cell]) and min(place) > 0 and max(place) < BRICK * 2 * N:
            assert float(relied[place]) == pytest.approx(float(corners[place]), abs=1e-2)


def test_fine_cells_are_judged_by_corners_and_centres_and_close_ones_at_more_points(balls):
    coarse, corners = judge_coarse(balls, N, LEAST_MARGIN)
    cells = (coarse == MIXED).nonzero()[::9]
    states, values, places = judge_fine(balls, corners, cells, LEAST_MARGIN)
    mixed = 0
    for number, cell in enumerate(cells.tolist()):
        for number_within, within in enumerate(places_of(BRICK)):
            x, y, z = (BRICK * c + w for c, w in zip(cell, within, strict=True))
            eight = corners[x : x + 2, y : y + 2, z : z + 2].flatten()
            lowest = torch.tensor([x, y, z]) * (2.0 / (BRICK * N)) - 1.0
            center = logits_above(balls, lowest[None] + 1.0 / (BRICK * N))
            nine = torch.cat([eight, center])
            plainly, nearly = slow_state(nine, LEAST_MARGIN), slow_state(nine, CLOSE)
            state = int(states[number, number_within])
            if plainly == MIXED or nearly == plainly:
                assert state == plainly
            else:  # points that are tried may show more
                assert state in (plainly, MIXED)
            if state == MIXED:
                torch.testing.assert_close(values[mixed], nine, rtol=0.0, atol=2e-2)
                torch.testing.assert_close(places[mixed], lowest)
                mixed += 1
    assert mixed == len(values) == len(places) > 0


def test_what_corners_and_centres_miss_is_found_where_it_is_close(monkeypatch):
    answers = iter(
        [
            torch.full((BRICK**3,), -2.0),  # the centres
            # one of the points that are tried in each cell of an even number
            (torch.arange(BRICK**3 * TRIALS) % (2 * TRIALS) == 5) * 2.0 - 1.0,
        ]
    )
    monkeypatch.setattr(judging, "logits_above", lambda *_: next(answers))
    checkered = torch.arange(BRICK * N + 1)
    checkered = (checkered[:, None, None] + checkered[:, None] + checkered) % 2
    corners = -1.0 - 3.0 * checkered  # empty by a third of their spread
    states, _, _ = judge_fine(Balls(), corners, torch.tensor([[1, 2, 1]]), LEAST_MARGIN)
    assert states[0].tolist() == [MIXED, EMPTY] * (BRICK**3 // 2)


def test_planes_are_weighted_least_squares_and_doubts_their_largest_residual(balls, monkeypatch):
    coarse, corners = judge_coarse(balls, N, LEAST_MARGIN)
    cells = (coarse == MIXED).nonzero()[:3]
    _, values, places = judge_fine(balls, corners, cells, LEAST_MARGIN)
    size = 2.0 / (BRICK * N)
    tried: list[Tensor] = []

    def remembered(occupancy: Balls, mapped: Tensor) -> Tensor:
        tried.append(mapped)
        return logits_above(occupancy, mapped)

    monkeypatch.setattr(judging, "logits_above", remembered)
    planes, doubts = fit_planes(balls, values, places, size)
    assert planes.abs().amax(dim=1).equal(torch.full((len(values),), 127.0))
    (random,) = (place.view(-1, TRIALS, 3).double() for place in tried)
    nine = torch.tensor([*itertools.product((-1.0, 1.0), repeat=3), (0.0, 0.0, 0.0)]).double()
    for cell in range(len(values)):
        units = torch.cat([nine, (random[cell] - places[cell]) * (2.0 / size) - 1.0])
        design = torch.cat([torch.ones(len(units), 1).double(), units], dim=1)
        logits = torch.cat([values[cell], logits_above(balls, random[cell].float())]).double()
        weights = 1.0 / (1.0 + (4.0 * logits / (logits.max() - logits.min())) ** 2)
        root = weights.sqrt()[:, None]
        best = torch.linalg.lstsq(root * design, root * logits[:, None]).solution[:, 0]
        unit = best.abs().max() / 127.0
        torch.testing.assert_close(planes[cell].double(), best / unit, rtol=0.0, atol=0.51)
        residuals = weights * (design @ planes[cell].double() - logits / unit).abs()
        assert float(doubts[cell]) == pytest.approx(float(residuals.max()), rel=1e-2, abs=1e-2)


def test_a_plane_never_decides_in_a_cell_in_which_space_ends(balls):
    """There o is 0 at some of its points, and as it is beside them at the others."""
    coarse, corners = judge_coarse(balls, N, LEAST_MARGIN)
    cells = (coarse == MIXED).nonzero()[:3]
    _, values, places = judge_fine(balls, corners, cells, LEAST_MARGIN)
    size = 2.0 / (BRICK * N)
    planes, doubts = fit_planes(balls, values, places, size)
    assert planes.any(dim=1).all() and (doubts > 0.0).all()
    lowest, threshold = (torch.tensor(o).logit(eps=1e-7) for o in (0.0, balls.threshold))
    values[0, 3] = values[1, :8] = lowest - threshold
    values[2, 3] = lowest - threshold + 0.1
    planes, doubts = fit_planes(balls, values, places, size)
    assert planes.any(dim=1)[:3].tolist() == [False, False, True]
    assert (doubts > 0.0)[:3].tolist() == [False, False, True]


def test_clearance_is_the_distance_to_what_is_not_empty_or_not_in_the_cube():
    torch.manual_seed(0)
    n = 5
    states = torch.where(torch.rand(n, n, n) < 0.04, OCCUPIED, EMPTY).to(torch.uint8)
    states[torch.rand(n, n, n) < 0.03] = MIXED
    mixed = (states == MIXED).nonzero()
    fine = torch.where(torch.rand(len(mixed), BRICK**3) < 0.9, EMPTY, OCCUPIED).to(torch.uint8)
    fine[torch.rand(fine.shape) < 0.02] = MIXED
    fine[0] = EMPTY  # a mixed cell whose fine ones are all empty
    taken = []
    for half in places_of(2 * n):
        cell = [k // 2 for k in half]
        state = int(states[tuple(cell)])
        if state == MIXED:
            brick = fine[mixed.tolist().index(cell)].view(BRICK, BRICK, BRICK)
            x, y, z = (2 * (k % 2) for k in half)
            state = int(brick[x : x + 2, y : y + 2, z : z + 2].ne(EMPTY).any())
        if state != EMPTY:
            taken.append(half)
    expected = [
        min(
            FARTHEST,
            min(min(k + 1, 2 * n - k) for k in half),
            min(max(abs(a - b) for a, b in zip(half, other, strict=True)) for other in taken),
        )
        for half in places_of(2 * n)
    ]
    assert unpacked(clearance_of(states, mixed, fine)).tolist() == expected
    assert 0 in expected and max(expected) > 2


def test_clearance_ends_at_what_four_bits_hold():
    states = torch.zeros(20, 20, 20, dtype=torch.uint8)
    nothing = torch.zeros(0, 3, dtype=torch.int64), torch.zeros(0, BRICK**3, dtype=torch.uint8)
    clearance = unpacked(clearance_of(states, *nothing)).view(40, 40, 40)
    assert clearance[20, 20].tolist() == [min(FARTHEST, k + 1, 40 - k) for k in range(40)]
