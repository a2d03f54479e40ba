"""The cell cache decides as the gate does, within its budget, and is conservative."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from ball_occupancy import CENTRE, HALF, ball
from samplers.analytic_occupancy import Balls, camera_rays

from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.gate import Gate, GateConfig
from leco_plugin.occupancy import Occupancy
from leco_plugin.samplers.cells.build import _check, build_cache
from leco_plugin.samplers.cells.cache import (
    BRICK,
    COARSE_OCCUPIED,
    FINE_EMPTY,
    FINE_OCCUPIED,
    CellCache,
)
from leco_plugin.samplers.estimator import LearnedOccupancyEstimator
from leco_plugin.samplers.marching import March, Rays, march
from leco_plugin.space import Space

BUDGET = 1 << 17


@pytest.fixture(scope="module", params=["box", "contraction"])
def balls(request):
    return Balls(request.param, half_extent=1.3)


@pytest.fixture(scope="module")
def cache(balls) -> CellCache:
    return build_cache(balls, budget=BUDGET, check_points=1 << 18)


def decide(cache, balls, positions):
    decided, left_open = cache.decide(positions)
    decided[left_open] = balls.occupied(positions[left_open])
    return decided


def test_decisions_are_the_gates_but_for_the_tolerance(cache, balls):
    mapped = torch.rand(1 << 18, 3, generator=torch.Generator().manual_seed(7)) * 2.0 - 1.0
    positions = balls.space.unmap(mapped)
    differing = (decide(cache, balls, positions) != balls.occupied(positions)).float().mean()
    assert differing <= 1e-4


def test_the_report_says_what_is_held_and_what_was_measured(cache):
    report = cache.report
    assert cache.tables().bytes == report.bytes <= BUDGET
    assert report.differing <= report.differing_bound <= 1e-4
    assert report.checked == 1 << 18


@pytest.mark.parametrize("differing", [0, 9])
def test_the_bound_is_two_deviations_above_what_differs_and_never_nothing(cache, differing):
    positions = torch.zeros(1000, 3)
    decided, left_open = cache.decide(positions)
    assert not left_open.numel()
    decided[:differing] = ~decided[:differing]
    report = _check(cache, positions, decided)
    assert report.differing == differing / 1000
    assert report.differing_bound == pytest.approx((differing + 2.0 * differing**0.5 + 2.0) / 1000)


def test_its_tables_move_with_a_module_and_are_sent_to_nobody(cache):
    host = torch.nn.ModuleDict({"cache": copy.deepcopy(cache)})
    assert not list(host.buffers()) and not host.state_dict()
    host.to("meta")
    assert {table.device.type for table in host["cache"].tables()} == {"meta"}
    assert host["cache"].frame.is_meta and not cache.frame.is_meta


def test_few_positions_are_left_to_the_gate(cache, balls):
    assert cache.report.asked < 0.05
    balls.asked = 0
    decide(cache, balls, balls.space.unmap(torch.rand(10_000, 3) * 2.0 - 1.0))
    assert balls.asked < 200


def test_a_larger_budget_buys_finer_cells(balls):
    small = build_cache(balls, budget=1 << 15, check_points=1 << 16)
    assert small.report.bytes <= 1 << 15
    assert small.report.asked > build_cache(balls, budget=BUDGET, check_points=1 << 16).report.asked


def test_positions_outside_a_box_or_nowhere_are_empty(balls, cache):
    positions = torch.tensor([[50.0, 0.0, 0.0], [0.0, -9.0, 0.0], [torch.nan, 0.0, 0.0]])
    decided, left_open = cache.decide(positions)
    assert not decided.any()
    if balls.space.kind == "box":
        assert left_open.numel() == 0
    assert cache.near(positions, torch.zeros(3)).shape == (3,)


def test_where_a_threshold_of_0_keeps_all_nothing_outside_a_box_is_called_empty():
    balls = Balls("box")
    balls.threshold = 0.0
    cache = build_cache(balls, budget=BUDGET, check_points=1 << 16)
    positions = torch.tensor([[50.0, 0.0, 0.0], [0.0, -9.0, 0.0], [0.3, -0.2, 0.1]])
    assert decide(cache, balls, positions).all()


def slow_decide(cache: CellCache, space: Space, position: torch.Tensor) -> bool | None:
    """What the tables say of one position, a cell within a cell; None leaves it to the gate."""
    coarse, fine, first_plane, planes, _ = cache.tables()
    mapped = space.map(position[None].double())[0]
    cells = (mapped + 1.0) * (cache.resolution / 2.0) + 1.0
    cell = [min(max(math.floor(c), 0), cache.resolution + 1) for c in cells.tolist()]
    width = cache.resolution + 2
    brick = int(coarse.view(width, width, width)[tuple(cell)])
    if brick < 0:
        return brick == COARSE_OCCUPIED
    parts = [(c - k) * BRICK for c, k in zip(cells.tolist(), cell, strict=True)]
    part = [min(max(math.floor(p), 0), BRICK - 1) for p in parts]
    known = int(fine[brick].view(BRICK, BRICK, BRICK)[tuple(part)])
    if known >= FINE_EMPTY:
        return known == FINE_OCCUPIED
    offset, *slopes, error = planes[:, int(first_plane[brick]) + known].tolist()
    u = [2.0 * (p - k) - 1.0 for p, k in zip(parts, part, strict=True)]
    height = offset + sum(slope * along for slope, along in zip(slopes, u, strict=True))
    return None if abs(height) <= error else height > 0.0


def test_the_tables_are_read_as_they_are_described(cache, balls):
    generator = torch.Generator().manual_seed(5)
    around = torch.nn.functional.normalize(torch.randn(600, 3, generator=generator), dim=-1)
    near_a_surface = balls.centers[0] + around * (0.2 + 0.15 * torch.rand(600, 1))
    anywhere = balls.space.unmap(torch.rand(400, 3, generator=generator) * 2.2 - 1.1)
    positions = torch.cat([near_a_surface, anywhere])
    decided, left_open = cache.decide(positions)
    answers: list[bool | None] = decided.tolist()
    for index in left_open.tolist():
        answers[index] = None
    expected = [slow_decide(cache, balls.space, position) for position in positions]
    different = sum(one != other for one, other in zip(answers, expected, strict=True))
    assert different <= 2  # a rounding from the next cell
    assert {True, False, None} <= set(answers)


@pytest.mark.parametrize("half_cells", [0.0, 0.1, 0.5, 0.9, 1.5, 4.0])
def test_nothing_is_occupied_in_a_cube_that_is_called_clear(cache, balls, half_cells):
    generator = torch.Generator().manual_seed(3)
    radius = half_cells * float(balls.space.half_extent) / cache.resolution
    outwards = torch.nn.functional.normalize(torch.randn(4000, 3, generator=generator), dim=-1)
    heights = 0.25 + torch.rand(4000, 1, generator=generator) * (3.0 * radius + 0.2)
    centers = balls.centers[0] + outwards * heights
    near = cache.near(centers, torch.full((4000,), radius))
    offsets = torch.rand(4000, 30, 3, generator=generator) * 2.0 - 1.0
    offsets = torch.cat([offsets, offsets[:, :15].sign()], dim=1)
    around = centers[:, None] + offsets * radius
    occupied = balls.occupied(around.reshape(-1, 3)).view(4000, 45).any(dim=-1)
    assert near[occupied].all()


def test_cubes_far_from_everything_are_clear(cache, balls):
    centers = torch.rand(4000, 3, generator=torch.Generator().manual_seed(3)) * 2.0 - 1.0
    near = cache.near(centers, torch.full((4000,), 0.05))
    assert near.float().mean() < 0.3


@pytest.mark.parametrize("step_size", [0.004, 0.01, 0.03])
def test_asking_for_clear_runs_first_drops_no_sample(cache, balls, step_size):
    origins, directions = camera_rays(400)
    rays = Rays(origins, directions, torch.zeros(400), torch.full((400,), 4.0))

    def occupied(positions):
        return decide(cache, balls, positions)

    one = march(rays, March(step_size), occupied)
    other = march(rays, March(step_size), occupied, cache.near)
    assert all(a.equal(b) for a, b in zip(one, other, strict=True))


def test_the_stretch_bounds_the_mapping_everywhere(cache, balls):
    generator = torch.Generator().manual_seed(4)
    positions = torch.randn(20_000, 3, generator=generator) * 4.0
    radii = torch.rand(20_000, generator=generator) * 2.0
    offsets = torch.nn.functional.normalize(torch.randn(20_000, 3, generator=generator), dim=-1)
    offsets[::2] = offsets[::2].sign()  # to the corners of the cubes
    moved = balls.space.map(positions + offsets * radii[:, None]) - balls.space.map(positions)
    cells = moved.abs().amax(dim=-1) * cache.resolution / 2.0
    bound = cache._stretch(positions, radii) * radii
    assert (cells <= bound * (1.0 + 1e-4) + 1e-4).all()


def test_the_stretch_bounds_the_mapping_where_it_is_steepest(cache, balls):
    """Beside an edge of the cubes around the centre, outward along one axis and inward along the
    other: there the bound is nearly reached, and it grows to 3/2 half extents."""
    away, half = torch.linspace(1.0, 3.0, 200), float(balls.space.half_extent)
    along = torch.stack([away, away * (1.0 - 1e-4), 0.0 * away], dim=-1) * half
    positions, radii = balls.space.center + along, torch.full((200,), 0.04 * half)
    offset = radii[:, None] * torch.tensor([1.0, -1.0, 0.0])
    moved = balls.space.map(positions + offset) - balls.space.map(positions)
    cells = moved.abs().amax(dim=-1) * cache.resolution / 2.0
    bound = cache._stretch(positions, radii) * radii
    assert (cells <= bound * (1.0 + 1e-4)).all() and float((cells / bound).max()) > 0.95


@pytest.mark.parametrize("constant", [0.0, 1.0])
def test_a_constant_gate_needs_no_bricks(constant):
    balls = Balls()
    balls.query = lambda positions: torch.full((len(positions),), constant)
    cache = build_cache(balls, budget=BUDGET, check_points=1 << 14, tolerance=1e-2)
    decided, left_open = cache.decide(torch.rand(1000, 3) - 0.5)
    assert len(cache.tables().fine) == len(left_open) == 0
    assert decided.float().mean() == constant


@pytest.mark.parametrize("kind", ["hash", "vm", "k-planes", "grid"])
def test_a_gate_on_any_features_can_be_held(kind):
    occupancy = ball(kind)
    cache = build_cache(occupancy, budget=BUDGET, check_points=1 << 17, tolerance=2e-4)
    assert cache.report.bytes <= BUDGET
    assert cache.report.asked < 0.02
    generator = torch.Generator().manual_seed(7)
    mapped = torch.rand(1 << 17, 3, generator=generator) * 2.0 - 1.0
    positions = mapped * HALF + torch.tensor(CENTRE)
    assert cache.report.differing <= cache.report.differing_bound <= 2e-4
    differing = decide(cache, occupancy, positions) != occupancy.occupied(positions)
    assert float(differing.float().mean()) <= 2e-4


@pytest.mark.parametrize("kind", ["hash", "vm", "k-planes", "grid"])
def test_an_untaught_gate_on_any_features_is_asked_without_a_cache(kind, caplog):
    torch.manual_seed(0)
    gate = Gate(GateConfig(EncodingConfig(kind, plane_cells=64), width=8, layers=1))
    for table in gate.encoding.parameters():
        torch.nn.init.normal_(table)
    positions = torch.rand(2000, 3) * 2.0 - 1.0
    occupancy = Occupancy(gate, Space(), 0.5)
    occupancy.threshold_value.copy_(occupancy.query(positions).median())
    estimator = LearnedOccupancyEstimator(occupancy)
    assert estimator.cache is None
    (record,) = caplog.records
    assert "no cell cache" in record.message and "\n" not in record.message
    assert torch.equal(estimator.occupied(positions), occupancy.occupied(positions))


def test_a_gate_that_no_cells_can_hold_is_refused():
    balls = Balls()
    # The decision flips a thousand times across the cube.
    balls.query = lambda positions: (positions[:, 0] * 3000.0).sin() * 0.5 + 0.5
    with pytest.raises(ValueError, match="too rough to be held in cells"):
        build_cache(balls, budget=BUDGET, check_points=1 << 14)
    # Specks smaller than any cell, which no lattice meets.
    balls.query = lambda positions: ((positions * 997.0).sin().prod(dim=-1) > 0.99).float()
    with pytest.raises(ValueError, match="of the decisions differ"):
        build_cache(balls, budget=BUDGET, check_points=1 << 16)
    with pytest.raises(ValueError, match="fits 100 bytes"):
        build_cache(Balls(), budget=100, check_points=1 << 14)
