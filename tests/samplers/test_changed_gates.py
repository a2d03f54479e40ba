"""An estimator decides by its occupancy as it is now, and keeps cells while it says the same."""

from __future__ import annotations

import copy

import pytest
import torch
from ball_occupancy import ball
from samplers.analytic_occupancy import Balls
from waits import Waits

from leco_plugin.conformance.scene import OTHER, SLAB, box, crossing
from leco_plugin.samplers import estimator as module
from leco_plugin.samplers.cells.build import build_cache as really_build_cache
from leco_plugin.samplers.estimator import LearnedOccupancyEstimator
from leco_plugin.space import Space

BUDGET = 1 << 16


def moved(by: float = 0.3):
    """An occupancy whose box and slab are not those of `SLAB`."""
    occupancy = OTHER.occupancy()
    occupancy.space.set("box", occupancy.space.center + by, 1.0)
    return occupancy


@pytest.fixture
def built(monkeypatch):
    """The caches that are built, in their order."""
    caches = []

    def build_cache(*args, **kwargs):
        caches.append(really_build_cache(*args, **kwargs))
        return caches[-1]

    monkeypatch.setattr(module, "build_cache", build_cache)
    return caches


def assert_decided_by(estimator, occupancy, aabb=None):
    """Samples and box are those of an estimator that was built from this occupancy."""
    own = LearnedOccupancyEstimator(occupancy, aabb, cache_bytes=BUDGET)
    rays = crossing()
    samples = own.sampling(*rays[:2], render_step_size=0.05)
    assert all(map(torch.equal, estimator.sampling(*rays[:2], render_step_size=0.05), samples))
    assert estimator.aabbs.equal(own.aabbs)


@pytest.mark.parametrize("aabb", [None, [-0.1, -1.0, -1.0, 1.0, 1.0, 1.0]])
def test_a_checkpoint_of_another_gate_decides_from_then_on(aabb):
    saved = LearnedOccupancyEstimator(SLAB.occupancy(), aabb, cache_bytes=BUDGET)
    grid = LearnedOccupancyEstimator(moved(), aabb, cache_bytes=BUDGET)
    host = torch.nn.ModuleDict({"grid": grid})
    host.load_state_dict({f"grid.{name}": value for name, value in saved.state_dict().items()})
    assert_decided_by(grid, SLAB.occupancy(), aabb)


CHANGES = {
    "loaded into it": lambda asked: asked.occupancy.load_state_dict(moved().state_dict()),
    "put in its place": lambda asked: setattr(asked, "occupancy", moved()),
    "its gate replaced": lambda asked: setattr(asked.occupancy, "gate", moved().gate),
    "its space moved": lambda asked: asked.occupancy.space.center.add_(0.1),
    "its threshold": lambda asked: asked.occupancy.threshold_value.fill_(0.7),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_gate_that_changes_decides_from_the_next_question_on(change, caplog):
    asked = LearnedOccupancyEstimator(SLAB.occupancy(), cache_bytes=BUDGET)
    positions = torch.rand(2000, 3) * 3.0 + box()[:3]
    before = asked.occupied(positions)
    caplog.set_level("INFO")
    CHANGES[change](asked)
    assert_decided_by(asked, asked.occupancy)
    now = LearnedOccupancyEstimator(asked.occupancy, cache_bytes=0).occupied(positions)
    assert (asked.occupied(positions) == now).float().mean() > 0.999
    assert not now.equal(before)
    assert "the occupancy has changed: box and cells are made anew" in caplog.text


class Plain:
    """An occupancy that is no module: half of space."""

    threshold = 0.5

    def __init__(self, towards: float) -> None:
        self.space, self.towards = Space("box"), towards

    def query(self, positions):
        inside = (positions.abs() <= 1.0).all(dim=-1)
        return torch.sigmoid(20.0 * self.towards * positions[:, 0]) * inside

    def occupied(self, positions):
        return self.query(positions) >= self.threshold


def test_what_is_no_module_is_followed_when_it_is_replaced(built):
    estimator = LearnedOccupancyEstimator(Plain(1.0), cache_bytes=BUDGET)
    positions = torch.rand(500, 3) * 1.8 - 0.9
    before = estimator.occupied(positions)
    estimator.occupancy = Plain(-1.0)
    assert estimator.occupied(positions).equal(~before) and len(built) == 2
    assert estimator.occupied(positions).equal(~before) and len(built) == 2


def test_cells_that_are_stopped_on_the_way_are_begun_anew(monkeypatch):
    estimator = LearnedOccupancyEstimator(SLAB.occupancy(), cache_bytes=BUDGET)
    estimator.occupancy = moved()
    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(module, "build_cache", lambda *_, **__: exec("raise KeyboardInterrupt"))
        estimator.occupied(torch.zeros(1, 3))
    assert_decided_by(estimator, moved())


def test_without_cells_a_gate_that_is_trained_is_followed_in_silence(caplog):
    asked = LearnedOccupancyEstimator(SLAB.occupancy(), cache_bytes=0)
    caplog.set_level("INFO")
    asked.occupancy.space.center.add_(0.1)
    assert_decided_by(asked, asked.occupancy)
    assert "anew" not in caplog.text


def test_cells_of_an_unbounded_space_are_no_part_of_the_occupancy():
    balls = Balls("contraction")
    estimator = LearnedOccupancyEstimator(balls, cache_bytes=BUDGET)
    estimator.occupancy = copy.deepcopy(balls)
    positions = torch.rand(2000, 3) * 4.0 - 2.0
    before = estimator.occupied(positions)
    balls.space.center.add_(1.0)
    assert estimator.occupied(positions).equal(before)


def test_an_occupancy_without_end_has_no_box_whatever_was_there_before():
    estimator = LearnedOccupancyEstimator(Balls(), cache_bytes=0)
    for kind in ("contraction", "box", "contraction"):
        estimator.occupancy = Balls(kind, half_extent=0.5)
        own = LearnedOccupancyEstimator(Balls(kind, half_extent=0.5), cache_bytes=0)
        assert estimator.aabbs.equal(own.aabbs)
        assert (estimator.bounds() is None) == (own.bounds() is None) == (kind == "contraction")


def test_estimators_that_share_an_occupancy_all_follow_it():
    occupancy, other = SLAB.occupancy(), LearnedOccupancyEstimator(moved(), cache_bytes=0)
    sharing = [LearnedOccupancyEstimator(occupancy, cache_bytes=0) for _ in range(2)]
    sharing[0].load_state_dict(other.state_dict())
    for estimator in sharing:
        assert estimator.aabbs.equal(other.aabbs)


def test_cells_are_kept_while_the_gate_says_the_same(built):
    asked = LearnedOccupancyEstimator(SLAB.occupancy(), cache_bytes=BUDGET)
    rays = crossing()
    for change in (
        lambda: None,
        lambda: asked.load_state_dict(asked.state_dict()),
        lambda: asked.load_state_dict(asked.state_dict(), assign=True),
        lambda: setattr(asked, "occupancy", SLAB.occupancy()),
    ):
        change()
        asked.sampling(*rays[:2], render_step_size=0.05)
        copy.deepcopy(asked).sampling(*rays[:2], render_step_size=0.05)
    assert len(built) == 1


def test_to_see_that_nothing_has_changed_waits_for_no_device():
    asked = LearnedOccupancyEstimator(SLAB.occupancy(), cache_bytes=BUDGET)
    with Waits() as waits:
        asked._refresh()
    assert waits.seen == []


def test_torchs_default_type_changes_no_cell_and_no_sample(built):
    asked, rays = ball(), crossing()

    def told() -> list[torch.Tensor]:
        estimator = LearnedOccupancyEstimator(asked, cache_bytes=BUDGET)
        return [*estimator.sampling(*rays[:2], render_step_size=0.05), estimator.occs]

    torch.set_default_dtype(torch.float64)
    try:
        found = told()
    finally:
        torch.set_default_dtype(torch.float32)
    assert all(map(torch.equal, found, told()))
    assert all(map(torch.equal, *(cache.tables() for cache in built)))
