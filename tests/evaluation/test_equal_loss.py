"""Claims about occupancies where all lose equally much, and beside the exact city."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from ball_occupancy import ball
from hypothesis import given, settings
from hypothesis import strategies as st
from nerfstudio.cameras.cameras import Cameras
from small_learner import SMALLEST, small_mixture
from torch import Tensor

from leco_plugin.evaluation import equal_loss
from leco_plugin.evaluation.equal_loss import (
    CELLS,
    at_equal_loss,
    compare_with_truth,
    free_points,
    is_reached,
    kept_shares,
    rays_of_photographs,
    threshold_losing,
)
from leco_plugin.learning.calibration import CalibrationConfig
from leco_plugin.learning.dense import Reference
from leco_plugin.models.mixture import Mixture
from leco_plugin.models.rendering import Intervals, Rays
from leco_plugin.occupancy import Occupancy
from leco_plugin.scenes.bounds import SceneBounds
from leco_plugin.scenes.city.city import CityConfig
from leco_plugin.scenes.city.folder import CaptureConfig, CityTruth, write_city


def slow_threshold(weights: Tensor, scores: Tensor, lost: float) -> float:
    """The largest of the scores that is a threshold within the loss."""
    allowed = lost * float(weights.double().sum())
    return max(
        float(score)
        for score in scores
        if float(weights.double()[scores < score].sum()) <= allowed + 1e-12
    )


@settings(deadline=None)
@given(st.integers(0, 10_000), st.sampled_from([0.0, 1e-3, 0.1, 0.5]), st.integers(1, 8))
def test_the_threshold_is_the_largest_within_the_loss(seed: int, lost: float, levels: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    weights = torch.rand(40, generator=generator)
    scores = torch.randint(levels, (40,), generator=generator).float()  # with ties
    expected = slow_threshold(weights, scores, lost)
    assert threshold_losing(weights, scores, lost) == expected


@given(st.integers(0, 10_000), st.sampled_from([0.0, 1e-2, 0.3]))
def test_shares_are_counted_one_by_one_at_that_threshold(seed: int, lost: float) -> None:
    generator = torch.Generator().manual_seed(seed)
    weights = torch.rand(30, generator=generator)
    scores = torch.randint(6, (30,), generator=generator).float()
    of_volume = torch.randint(6, (50,), generator=generator).float()
    threshold = slow_threshold(weights, scores, lost)
    expected = tuple(
        sum(float(score) >= threshold for score in some) / len(some) for some in (of_volume, scores)
    )
    assert kept_shares(weights, scores, of_volume, lost) == pytest.approx(expected)


BOUNDS = SceneBounds(
    "box", torch.zeros(3), 1.0, 0.1, 4.0, torch.tensor([-0.5, -0.5, -0.25, 0.5, 0.5, 0.25]), "test"
)


@pytest.fixture
def mixture(monkeypatch: pytest.MonkeyPatch) -> Mixture:
    """A mixture whose field is dense, and whose gate says so, where x > 0 and nowhere else."""
    monkeypatch.setattr(equal_loss, "CALIBRATION", CalibrationConfig(rays_at_once=32))
    made = small_mixture()
    made.set_bounds(BOUNDS, 1.0)

    def gate(mapped: Tensor) -> Tensor:
        occupied = 20.0 * (mapped[:, 0] > 0.0)
        return torch.stack([10.0 - occupied, torch.zeros_like(occupied), occupied - 10.0], dim=-1)

    def density(mapped: Tensor, *_: Tensor) -> tuple[Tensor, Tensor]:
        features = torch.zeros(len(mapped), SMALLEST.field.experts.width)
        return 30.0 * (mapped[:, 0] > 0.0), features

    monkeypatch.setattr(made.gate, "forward", gate)
    monkeypatch.setattr(made.field, "density", density)
    made.report = {"aabb": BOUNDS.aabb.tolist()}
    rays = rays_along_x(50)
    monkeypatch.setattr(equal_loss, "held_out_rays", lambda *_: (rays, torch.zeros(50, 3)))
    monkeypatch.setattr(equal_loss, "rays_of_photographs", lambda *_: None)
    taught = torch.rand(200_000, 3, generator=torch.Generator().manual_seed(1))
    box = BOUNDS.aabb.view(2, 3)
    monkeypatch.setattr(equal_loss, "candidates_of", lambda *_: torch.lerp(box[0], box[1], taught))
    return made


def rays_along_x(count: int) -> Rays:
    """From the empty half of the box into the dense one."""
    origins = torch.tensor([[-2.0, 0.0, 0.0]]).expand(count, 3)
    generator = torch.Generator().manual_seed(2)
    sideways = 0.05 * torch.randn(count, 2, generator=generator)
    aims = torch.cat([torch.full((count, 1), 2.0), sideways], dim=-1)
    directions = torch.nn.functional.normalize(aims, dim=-1)
    near, far = torch.full((count,), 1.5), torch.full((count,), 2.5)
    return Rays(origins, directions, near, far, None)


def test_a_perfect_gate_keeps_the_occupied_half_of_the_box(mixture: Mixture) -> None:
    found = at_equal_loss(mixture.train(), None)
    assert found["lost_surface_mass"] == 1e-3 and found["grids"] == []
    assert found["kept_reached_volume"] == pytest.approx(0.5, abs=0.01)
    assert 0.3 < found["kept_candidates"] < 0.6
    assert found["reached_volume"] > 0.9
    assert mixture.training


def test_grids_are_measured_like_the_gate(mixture: Mixture) -> None:
    even, odd = at_equal_loss(mixture, None, grids=(4, 5))["grids"]
    assert (even["resolution"], even["bytes"]) == (4, 8)
    assert (odd["resolution"], odd["bytes"]) == (5, 16)
    assert even["kept_reached_volume"] == pytest.approx(0.5, abs=0.01)
    # the cells in the middle hold both, and a surface in them
    assert odd["kept_reached_volume"] == pytest.approx(0.6, abs=0.01)
    assert even["update_seconds"] > 0.0


def test_a_coarse_grid_keeps_a_thin_film(mixture: Mixture, monkeypatch: pytest.MonkeyPatch) -> None:
    def film(mapped: Tensor, *_: Tensor) -> tuple[Tensor, Tensor]:
        on_film = (mapped[:, 0] - 0.2).abs() < 1e-4
        return 1e5 * on_film, torch.zeros(len(mapped), 4)

    places = torch.tensor([0.2, 0.0, 0.0]).repeat(64, 1)
    places[:, 1:] = torch.cartesian_prod(*[torch.linspace(-0.45, 0.45, 8)] * 2)
    everywhere = equal_loss.candidates_of(mixture, None)
    monkeypatch.setattr(mixture.field, "density", film)
    monkeypatch.setattr(equal_loss, "candidates_of", lambda *_: torch.cat([places, everywhere]))
    held_out = torch.tensor([[0.2, 0.07, 0.07], [-0.3, 0.1, 0.1]])
    weights = torch.tensor([1.0, 0.0])
    monkeypatch.setattr(
        equal_loss, "_measured", lambda *_: (held_out, weights, torch.tensor([0.9, 0.1]))
    )
    (row,) = at_equal_loss(mixture, None, grids=(8,))["grids"]
    assert row["kept_reached_volume"] < 0.2  # a slab of one cell, not the whole box


def test_a_tenth_of_the_loss_may_lie_in_what_finer_grids_leave_out(
    mixture: Mixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of four layers of cells the first three hold 5e-5, 5e-4 and the rest of the weight."""
    floors = []

    def grids(density: object, box: object, known: object, sizes: object, floor_of: Any, _: float):
        floors.append(floor_of(torch.arange(1.0, 5.0).repeat_interleave(16).view(4, 4, 4)))
        return [(None, 0.0)]

    places = torch.tensor([[-0.4, 0.0, 0.0], [-0.1, 0.0, 0.0], [0.1, 0.0, 0.0]])
    weights = torch.tensor([5e-5, 5e-4, 1.0])
    monkeypatch.setattr(equal_loss, "_measured", lambda *_: (places, weights, torch.ones(3)))
    monkeypatch.setattr(equal_loss.field_grids, "fill_grids", grids)
    at_equal_loss(mixture, None, grids=(4,))
    assert floors == [2.0]


def test_unreached_space_is_not_counted(mixture: Mixture, monkeypatch: pytest.MonkeyPatch) -> None:
    everywhere = equal_loss.candidates_of(mixture, None)
    middles = (everywhere[:, 0] > -6 / 32) & (everywhere[:, 0] < 3 / 32)  # nine layers of cells
    seen = everywhere[middles]
    monkeypatch.setattr(equal_loss, "candidates_of", lambda *_: seen)
    found = at_equal_loss(mixture, None, grids=(4,))
    assert found["reached_volume"] == pytest.approx(9 / 32, abs=0.01)
    # a third of what is reached is dense, of the box half is
    assert found["kept_reached_volume"] == pytest.approx(1 / 3, abs=0.01)
    assert found["grids"][0]["kept_reached_volume"] == pytest.approx(1 / 3, abs=0.01)


def test_weights_of_surfaces_are_measured(
    mixture: Mixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    intervals = Intervals(torch.zeros(3).long(), torch.arange(3.0), torch.arange(1.0, 4.0))
    near, backdrop = torch.tensor([False, True, True]), torch.tensor([False, False, True])
    weights, occupancies = torch.tensor([0.2, 0.3, 0.5]), torch.tensor([0.1, 0.6, 0.9])
    planted = Reference(intervals, weights, occupancies, near, torch.zeros(1, 3), backdrop)
    monkeypatch.setattr(equal_loss, "dense_reference", lambda *_: planted)
    monkeypatch.setattr(equal_loss, "CALIBRATION", CalibrationConfig())  # all rays at once
    places, *found = equal_loss._measured(mixture, None)
    assert len(places) == 2
    torch.testing.assert_close(found, [torch.tensor([0.0, 0.3]), torch.tensor([0.1, 0.6])])


def test_rays_without_a_surface_are_refused(
    mixture: Mixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    nothing = torch.zeros(0, 3), torch.zeros(0), torch.zeros(0)
    monkeypatch.setattr(equal_loss, "_measured", lambda *_: nothing)
    with pytest.raises(ValueError, match="no surface"):
        at_equal_loss(mixture, None)


def test_a_grid_that_does_not_fit_the_memory_is_left_out(mixture: Mixture) -> None:
    found = at_equal_loss(mixture, None, grids=(4, 1 << 15))
    assert [row["resolution"] for row in found["grids"]] == [4]
    assert found["left_out"] == [1 << 15]


def test_training_draws_the_same_random_numbers_afterwards(mixture: Mixture) -> None:
    state = torch.random.get_rng_state()
    at_equal_loss(mixture, None, grids=(4,))
    assert torch.equal(torch.random.get_rng_state(), state)


SCALE, STEP, HIGHEST = 0.02, 0.01, 1.2
NO_WALLS = torch.tensor([-1e6] * 3 + [1e6] * 3)


@pytest.fixture(autouse=True)
def few_points(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(equal_loss, "AIR_POINTS", 4000)
    monkeypatch.setattr(equal_loss, "MOST_SURFACE_POINTS", 4000)


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> CityTruth:
    folder = tmp_path_factory.mktemp("truth") / "city"
    write_city(CityConfig(blocks=1), folder, CaptureConfig(48, 36))
    transform = torch.eye(4)[:3]
    outputs = SimpleNamespace(dataparser_transform=transform, dataparser_scale=SCALE)
    return CityTruth.from_dataparser(folder, outputs)


class Rule:
    """Keeps what a rule says, as an occupancy would."""

    threshold_value = torch.tensor(0.5)

    def __init__(self, rule) -> None:  # type: ignore[no-untyped-def]
        self.occupied = rule


def test_only_keeping_just_what_is_near_a_surface_is_perfect(truth: CityTruth) -> None:
    for rule, recall, skipped in (
        (lambda positions: truth.distance(positions) * truth.scale <= STEP, 1.0, 1.0),
        (lambda positions: torch.ones(len(positions), dtype=torch.bool), 1.0, 0.0),
        (lambda positions: torch.zeros(len(positions), dtype=torch.bool), 0.0, 1.0),
    ):
        found = compare_with_truth(Rule(rule), truth, NO_WALLS, STEP, HIGHEST)  # type: ignore
        assert found == {"kept_surface_recall": recall, "free_space_skipped": skipped}


def test_free_points_are_in_the_air_inside_the_walls(truth: CityTruth) -> None:
    walls = torch.tensor([-0.3, -0.2, -1.0, 0.15, 0.25, 0.9])
    surface = truth.visible_surface("test")
    points = free_points(truth, surface, walls, STEP, HIGHEST)
    assert len(points) > 1000 and not bool(truth.occupied(points).any())
    ends = torch.stack([points.amin(dim=0), points.amax(dim=0)])
    between = torch.stack([torch.cat([walls[:2], surface[:, 2].amin()[None]]), walls[3:]])
    assert bool((ends[0] >= between[0]).all() and (ends[1] <= between[1]).all())
    ends[0, 2] = between[0, 2]  # on the ground there is no air
    torch.testing.assert_close(ends, between, rtol=0.0, atol=0.02)
    higher = free_points(truth, surface, NO_WALLS, STEP, HIGHEST)
    assert float(higher[:, 2].max()) == pytest.approx(HIGHEST, abs=0.01)
    sides = torch.stack([surface[:, :2].amin(dim=0), surface[:, :2].amax(dim=0)])
    ends = torch.stack([higher[:, :2].amin(dim=0), higher[:, :2].amax(dim=0)])
    torch.testing.assert_close(ends, sides, rtol=0.0, atol=0.01)
    roofs = float(surface[:, 2].max())
    lower = free_points(truth, surface, NO_WALLS, STEP, roofs / 2)
    assert float(lower[:, 2].max()) == pytest.approx(roofs, abs=0.01)
    assert float((truth.distance(points) * truth.scale).min()) > STEP


def slow_reached(taught: Tensor, mapped: Tensor) -> list[bool]:
    """Place by place: whether any taught one lies in the same cell of the cube."""

    def cell(place: Tensor) -> tuple[int, ...]:
        return tuple(min(int((float(x) + 1.0) / 2.0 * CELLS), CELLS - 1) for x in place)

    known = {cell(place) for place in taught}
    return [cell(place) in known for place in mapped]


@pytest.mark.parametrize("seed", range(3))
def test_a_place_is_reached_where_a_taught_one_shares_its_cell(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    taught = 0.1 * torch.rand(300, 3, generator=generator)
    mapped = 0.1 * torch.rand(500, 3, generator=generator)
    found = is_reached(taught, mapped)
    assert found.tolist() == slow_reached(taught, mapped)
    assert 0 < int(found.sum()) < 500


def test_faces_of_the_cube_belong_to_it() -> None:
    corners = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
    assert is_reached(corners, corners).all()
    assert not is_reached(corners[:1], corners[1:]).any()
    assert is_reached(corners[:1], corners[:1] + 1.0 / CELLS).all()


def photographs() -> SimpleNamespace:
    """A data manager with two cameras of different sizes at different places, both looking down."""
    poses = torch.eye(4)[None, :3].repeat(2, 1, 1)
    poses[1, 0, 3] = 5.0
    cameras = Cameras(
        poses,
        fx=torch.tensor([[20.0], [20.0]]),
        fy=torch.tensor([[20.0], [20.0]]),
        cx=torch.tensor([[20.0], [5.0]]),
        cy=torch.tensor([[10.0], [5.0]]),
        width=torch.tensor([[40], [10]]),
        height=torch.tensor([[20], [10]]),
    )
    return SimpleNamespace(train_dataset=SimpleNamespace(cameras=cameras))


def test_rays_fill_the_photographs_and_stay_inside_them() -> None:
    rays = rays_of_photographs(photographs(), 4000)
    second = rays.origins[:, 0] > 1.0
    assert 0.4 < float(second.float().mean()) < 0.6
    slopes = rays.directions[:, :2] / -rays.directions[:, 2:]
    for chosen, width, height in ((~second, 1.0, 0.5), (second, 0.25, 0.25)):
        ends = torch.tensor([width, height])
        assert bool((slopes[chosen].abs() <= ends + 1e-4).all())
        assert bool((slopes[chosen].amax(dim=0) > 0.95 * ends).all())
        assert bool((slopes[chosen].amin(dim=0) < -0.95 * ends).all())


def test_candidates_of_rays_are_mapped_middles_without_backdrops(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(equal_loss, "CALIBRATION", CalibrationConfig(rays_at_once=3))
    made, bundle = small_mixture(), rays_of_photographs(photographs(), 7)
    made.region.space.set("contraction", torch.tensor([0.5, -1.0, 0.25]), 2.0)
    rays = made.rays(bundle.origins, bundle.directions, None)
    intervals = made.with_backdrops(rays, made.candidates(rays))
    middles = (intervals.t_starts + intervals.t_ends) / 2
    of_ray = intervals.ray_indices
    last = intervals.t_ends >= rays.t_maxs[of_ray]
    places = rays.origins[of_ray] + middles[:, None] * rays.directions[of_ray]
    expected = made.region.space.map(places[~last])
    assert int(last.sum()) > 0 and len(expected) > 7 * 16
    torch.testing.assert_close(equal_loss.candidates_of(made, bundle), expected)


def test_reached_volume_is_drawn_in_the_box_and_mapped(monkeypatch: pytest.MonkeyPatch) -> None:
    made = small_mixture()
    low, high = torch.tensor([-0.5, -0.25, 1.0]), torch.tensor([2.5, 0.75, 1.5])
    middle, walls = torch.tensor([1.0, 0.5, 1.0]), torch.cat([low, high])
    made.set_bounds(SceneBounds("box", middle, 2.0, 0.1, 4.0, walls, "test"), 1.0)
    made.report = {"aabb": walls.tolist()}
    everywhere = torch.cartesian_prod(*[(torch.arange(CELLS) + 0.5) / CELLS * 2.0 - 1.0] * 3)
    found = equal_loss.reached_volume(made, everywhere, 2000)
    ends = torch.tensor([[-0.75, -0.375, 0.0], [0.75, 0.125, 0.25]])
    drawn = torch.stack([found.amin(dim=0), found.amax(dim=0)])
    torch.testing.assert_close(drawn, ends, atol=5e-3, rtol=0.0)
    box = equal_loss.mapped_box(made)
    torch.testing.assert_close(torch.stack([box.low, box.high]), ends)
    lower = everywhere[everywhere[:, 2] < 0.125]  # half of the box
    assert len(equal_loss.reached_volume(made, lower, 2000)) == pytest.approx(1000, abs=70)


def test_the_score_of_a_place_is_how_near_the_closest_point_is() -> None:
    score = equal_loss.near_points(torch.tensor([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]]))
    places = torch.tensor([[1.0, 0.0, 0.0], [3.0, 4.0, 0.0], [2.5, 0.0, 0.0]])
    assert score(places).tolist() == [-1.0, -4.0, -0.5]


def test_an_occupancy_is_held_beside_the_city_under_its_highest_camera(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, scene, out = (tmp_path / name for name in ("run", "scene", "out"))
    for folder in (run, scene, out):
        folder.mkdir()
    poses = torch.eye(4)[None, :3].repeat(3, 1, 1)
    poses[:, :, 3] = torch.tensor([[9.0, 8.0, 0.5], [7.0, 6.0, 1.5], [5.0, 4.0, 1.0]])
    cameras = SimpleNamespace(camera_to_worlds=poses)
    manager = SimpleNamespace(
        train_dataset=SimpleNamespace(cameras=cameras), train_dataparser_outputs="outputs"
    )
    pipeline = SimpleNamespace(device="cpu", datamanager=manager)
    trainer = SimpleNamespace(base_dir=run, pipeline=pipeline)
    assert equal_loss.take_occupancy(trainer, scene, out) is None
    known = ball()
    report = {name: 0.1 * i for i, name in enumerate(equal_loss.FROM_REPORT)}
    report |= {"aabb": [1.0, 2.0, 3.0, 4.0, 5.0, 6.0], "step_size": 0.07, "recoveries": 3}
    Occupancy(known.gate, known.space, 0.5, report=report).save(run / "occupancy.safetensors")
    taken = equal_loss.take_occupancy(trainer, scene, out)
    assert taken is not None and taken[2] is None  # no city
    size = (out / "occupancy.safetensors").stat().st_size
    expected = {name: report[name] for name in (*equal_loss.FROM_REPORT, "recoveries")}
    expected |= {"kept_surface_recall": None, "free_space_skipped": None, "bytes": size}
    assert expected.items() <= taken[1].items() and taken[1]["params"] == known.num_params
    (scene / equal_loss.DESCRIPTION).touch()
    asked = []
    monkeypatch.setattr(CityTruth, "from_dataparser", lambda *given: given)
    monkeypatch.setattr(
        equal_loss, "compare_with_truth", lambda _, *rest: asked.append(rest) or {"recall": 1.0}
    )
    taken = equal_loss.take_occupancy(trainer, scene, out)
    assert taken is not None and taken[1]["recall"] == 1.0
    ((truth, box, step, highest),) = asked
    assert truth == taken[2] == (scene, "outputs") and box.tolist() == report["aabb"]
    assert (step, highest) == (0.07, 1.5)


def test_rays_are_the_same_each_time_and_use_no_random_numbers_of_training() -> None:
    state = torch.random.get_rng_state()
    first, again = (rays_of_photographs(photographs(), 50) for _ in range(2))
    torch.testing.assert_close(first.directions, again.directions)
    assert torch.equal(torch.random.get_rng_state(), state)
