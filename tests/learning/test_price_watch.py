"""Skipping is never more than calibration allows, also for the field that the gate meets later."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from small_learner import ARun, NoPixels, small_learner, small_mixture

from leco_plugin.learning import held_out, price_watch
from leco_plugin.learning.calibration import CalibrationConfig, Measured, RayPrices
from leco_plugin.learning.collapse import GateCollapsed
from leco_plugin.learning.dense import DenseRendering, Reference
from leco_plugin.learning.freezing import FILE_NAME
from leco_plugin.learning.held_out import HeldOut
from leco_plugin.learning.learner import Learner
from leco_plugin.learning.price_watch import (
    SHARE_OF_TIME,
    Evidence,
    Finding,
    PriceWatch,
    steps_until_next,
)
from leco_plugin.learning.run import Progress, WatchState
from leco_plugin.learning.schedule import ScheduleConfig
from leco_plugin.models.rendering import Intervals
from leco_plugin.occupancy import CAMERAS_THAT_VOUCH, Occupancy

CONFIG = CalibrationConfig()


def evidence_after(mean: float, measurements: int = 8, seed: int = 0) -> Evidence:
    generator = torch.Generator().manual_seed(seed)
    evidence = Evidence()
    for _ in range(measurements):
        evidence = evidence.with_rays(mean + torch.randn(512, generator=generator), math.inf)
    return evidence


def test_the_evidence_is_a_mean_in_which_older_rays_count_less() -> None:
    evidence = Evidence()
    for value in (1.0, 2.0):
        evidence = evidence.with_rays(torch.full((10,), value), math.inf)
    assert evidence.total / evidence.rays == pytest.approx((0.8 * 1.0 + 2.0) / 1.8)


def test_rays_that_are_all_there_are_count_once() -> None:
    few = torch.linspace(-1.0, 1.2, 40)
    same = new = Evidence()
    for _ in range(20):
        same, new = same.with_rays(few, 40), new.with_rays(few, math.inf)
    assert same.rays == pytest.approx(40.0) and not same.exceeds()
    assert same.total / same.rays == pytest.approx(new.total / new.rays)
    assert new.exceeds()  # as so many new ones they would be taken for proof


def test_a_price_beyond_its_bound_is_found_and_one_at_it_rarely_taken_for_more() -> None:
    assert evidence_after(0.3, measurements=1).exceeds()
    assert sum(evidence_after(0.07, seed=seed).exceeds() for seed in range(20)) >= 18
    assert sum(evidence_after(0.0, seed=seed).exceeds() for seed in range(200)) <= 10
    assert not Evidence().exceeds() and not evidence_after(-0.5).exceeds()


def test_a_ray_that_is_no_number_is_no_evidence() -> None:
    values = torch.tensor([math.nan, 1.0, math.inf, 3.0])
    evidence = Evidence().with_rays(values, math.inf)
    assert evidence == (2.0, 4.0, 10.0)
    assert evidence.with_rays(values[:1], math.inf).rays == pytest.approx(1.6)


def test_measuring_again_keeps_to_its_share_of_the_time() -> None:
    for seconds, a_step in ((0.3, 0.1), (20.0, 0.1), (1e-3, 1.0), (1.0, 0.0)):
        steps = steps_until_next(CONFIG, seconds, a_step)
        assert steps >= CONFIG.steps_per_recheck
        assert seconds <= SHARE_OF_TIME * steps * max(a_step, 1e-9) * 1.0001


def test_the_share_is_of_the_time_of_all_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten steps take 2 s on average, and the last one, which saves, 11 s. Measuring takes 20 s."""
    times = iter((0.0, 20.0))
    monkeypatch.setattr(price_watch, "seconds_now", lambda: next(times))
    source: Any = SimpleNamespace(prepare=lambda: None, excesses=lambda _: {}, count_rays=float)
    state = WatchState(due=9)
    watch = PriceWatch(state, source, CONFIG, torch.device("cpu"))
    for step in range(10):
        watch.after_step(step, 1.0 if step < 9 else 11.0, 1.0, skips=True)
    assert state.due == 9 + 20.0 / (SHARE_OF_TIME * 2.0)


def test_a_measurement_that_is_due_while_nothing_is_skipped_is_put_off_once() -> None:
    state = WatchState(due=700)
    watch = PriceWatch(state, HeldOut.__new__(HeldOut), CONFIG, torch.device("cpu"))
    for step, due in ((650, 700), (699, 700), (700, 700 + CONFIG.steps_per_recheck)):
        assert watch.after_step(step, 1.0, 1.0, skips=False) is None
        assert state.due == due


def test_endless_new_rays_count_until_they_are_forgotten() -> None:
    rays, asked = torch.zeros(CONFIG.recheck_rays), []

    def count_rays(limit: int) -> float:
        asked.append(limit)
        return float(limit)

    source: Any = SimpleNamespace(excesses=lambda _: {"a price": rays}, count_rays=count_rays)
    source.prepare = lambda: None
    watch = PriceWatch(WatchState(due=1), source, CONFIG, torch.device("cpu"))
    for step in range(1, 5002, 100):
        watch.after_step(step, 1.0, 1.0, skips=True)
    sums = [*watch.state.evidence.values()]
    assert len(asked) > 40 and Evidence(*sums[0]).rays == pytest.approx(5.0 * len(rays), rel=1e-3)


REPORT = {"step": 3, "threshold": 0.4, "empty_fraction": 0.7, "params": 5}


def guided(run: ARun, restart: bool = False) -> Learner:
    """A learner whose gate is frozen at 0.4."""
    mixture = small_mixture()
    mixture.freeze(0.4, REPORT)
    return small_learner(run, mixture, schedule=ScheduleConfig(restart=restart))


@pytest.mark.parametrize("anew", [False, True])
def test_lost_surfaces_are_evidence(anew: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    half, same = torch.full((64,), 0.5), torch.ones(64)
    prices = RayPrices(same, half, half, same, same, same, 32, 64)
    monkeypatch.setattr(held_out, "dense_rendering", lambda *_: ())
    monkeypatch.setattr(held_out, "ray_prices", lambda *_, missed_only: prices)
    renderer: Any = HeldOut(small_mixture(), NoPixels(), CONFIG, restarted=anew)  # type: ignore[arg-type]
    renderer.rays = lambda *_: (None, None)
    state = WatchState(due=700)
    watch = PriceWatch(state, renderer, CONFIG, torch.device("cpu"))
    finding = watch.after_step(700, 1.0, 1.0, skips=True)
    assert state.rechecks == 1
    assert finding == (("within", "") if anew else ("beyond", "lost surface mass"))


@pytest.mark.parametrize("anew", [False, True])
@pytest.mark.parametrize("found", [0.2, 0.0])
def test_the_threshold_is_lowered_to_one_within_the_bounds_or_to_none(
    found: float, anew: bool, monkeypatch: pytest.MonkeyPatch, printed: Any, without_cache: None
) -> None:
    asked: list[Any] = []

    def calibrate(
        rendering: Any, config: CalibrationConfig, below: float, missed_only: bool
    ) -> Measured:
        assert missed_only
        any_surface = replace(CONFIG, lost_surface_mass=1.0)
        assert config == (any_surface if anew else CONFIG)  # haze is before a young field's
        asked.append((rendering[0], below))
        return Measured(found, 1e-4, 2e-3, 0.01, 0.5 if found else 0.0)

    monkeypatch.setattr(held_out, "dense_rendering", lambda mixture, *rays: rays[:2])
    monkeypatch.setattr(held_out, "calibrate", calibrate)
    learner = guided(ARun(), restart=anew)
    learner.held_out.rays = lambda _, seed, which: (f"{which} rays {seed}", None)  # type: ignore
    mixture, watch = learner.mixture, learner.progress.watch
    watch.rechecks, watch.evidence = 3, {"lost surface mass": (9.0, 9.0, 9.0)}
    before = mixture.estimator()
    learner.watch.after_step = lambda *_: Finding("beyond", "lost surface mass")  # type: ignore[method-assign]
    learner.after_step(700, 1.0, 1.0)
    assert asked == [("all rays 3", pytest.approx(0.4))]
    assert float(mixture.threshold) == pytest.approx(found)
    assert mixture.estimator() is not before
    assert mixture.report["threshold"] == found and mixture.report["params"] == 5
    assert mixture.report["lowered"] == [[700, found]] and "lowered" not in REPORT
    assert watch.evidence == {}
    said = printed()
    assert "step 700: lost surface mass of skipping" in said
    assert ("from now on nothing is skipped" in said) == (found == 0.0)


def lowered_to(found: Measured, monkeypatch: pytest.MonkeyPatch, restart: bool) -> dict[str, Any]:
    """What a frozen gate's report says once its threshold has been lowered."""
    monkeypatch.setattr(held_out, "dense_rendering", lambda *_: ())
    monkeypatch.setattr(held_out, "calibrate", lambda *_, **__: found)
    learner = guided(ARun(), restart)
    learner.held_out.rays = lambda *_: (None, None)  # type: ignore[method-assign, assignment]
    vouched = {"count": 9, "worst_surface_mass": 1e-3, "bound": 2e-3, "confidence": 0.9}
    frozen = Measured(0.4, 1e-4, 2e-3, 0.01, 0.7, 3e-5)._asdict()
    learner.mixture.report = {**frozen, CAMERAS_THAT_VOUCH: vouched}
    learner._skip_less(700, "a reason", 0.4)
    return learner.mixture.report


def test_a_field_begun_anew_declares_no_haze(monkeypatch: pytest.MonkeyPatch) -> None:
    found = Measured(0.2, 0.3, 0.4, 0.02, 0.5, 0.1)  # nothing asks for surfaces of such a field
    report = lowered_to(found, monkeypatch, restart=True)
    assert Measured(*(report[name] for name in Measured._fields)).within(CONFIG)
    assert (report["lost_surface_mass"], report["lost_mass"]) == (1e-4, 2e-3)
    assert (report["image_price_db"], report["empty_fraction"]) == (0.02, 0.5)
    assert lowered_to(found, monkeypatch, restart=False)["lost_surface_mass"] == 0.3
    nothing = lowered_to(Measured(0.0, 0.0, 0.0, 0.0, 0.0), monkeypatch, restart=True)
    assert nothing["lost_surface_mass"] == nothing["lost_mass"] == 0.0


@pytest.mark.parametrize(("threshold", "lost"), [(0.2, 1e-3), (0.0, 0.0)])
def test_photographs_that_vouch_lose_no_more_by_less_and_nothing_by_nothing(
    threshold: float, lost: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = Measured(threshold, 0.0, 0.0, 0.0, 0.5)
    said = lowered_to(found, monkeypatch, restart=False)[CAMERAS_THAT_VOUCH]
    assert said["worst_surface_mass"] == lost and said["bound"] == 2.0 * lost
    assert said["count"] == 9


@pytest.fixture
def watched(tmp_path: Path) -> SimpleNamespace:
    """A learner over a guided mixture whose price is `price` more than allowed."""
    run = ARun()
    run.folder = tmp_path
    learner = guided(run)
    made = SimpleNamespace(price=-1.0, kept=3.0, measured=[], lowered=0, step=0)
    made.run, made.learner, made.mixture = run, learner, learner.mixture

    def excesses(seed: int) -> dict[str, torch.Tensor]:
        made.measured.append(made.step)
        return {"lost surface mass": made.price + 0.1 * torch.randn(50)}

    def lower(below: float, seed: int) -> Measured:
        made.lowered += 1
        return Measured(0.5 * below, 1e-4, 2e-3, 0.01, 0.5)

    def go(first: int, last: int) -> None:
        for made.step in range(first, last):
            if not bool(made.mixture.frozen):  # as if it learned at once
                assert not learner.progress.looks_collapsed
                made.mixture.freeze(0.4, REPORT)
            learner.after_step(made.step, 1.0, made.kept)

    learner.held_out.excesses, learner.held_out.lower = excesses, lower  # type: ignore[method-assign]
    made.go = go
    return made


def test_a_gate_whose_field_gets_better_skips_less_and_leaves_a_new_file(
    watched: Any, tmp_path: Path, printed: Any
) -> None:
    torch.manual_seed(0)
    watched.go(200, 650)
    assert watched.measured == [300, 400, 500, 600] and not watched.lowered
    assert not (tmp_path / FILE_NAME).exists()
    watched.price = 5.0
    watched.go(650, 750)
    assert watched.lowered == 1 and watched.run.saved == [700]
    assert "step 700: lost surface mass of" in printed()
    assert Occupancy.load(tmp_path / FILE_NAME).threshold == pytest.approx(0.2)
    watched.price = -1.0
    watched.go(750, 1200)
    assert watched.lowered == 1


def test_where_nothing_is_skipped_nothing_is_measured(watched: Any) -> None:
    watched.mixture.freeze(0.0, REPORT)
    watched.go(0, 500)
    assert not watched.measured


def test_a_gate_that_keeps_nothing_is_reopened_and_then_given_up(watched: Any) -> None:
    watched.kept = 0.0
    with pytest.raises(GateCollapsed, match=r"step \d+: the frozen gate keeps .* bounds"):
        watched.go(200, 2000)
    assert watched.learner.progress.recoveries == 3
    assert watched.step == 200 + 4 * 101 - 1


def test_an_occupancy_of_an_empty_scene_may_keep_nothing(watched: Any) -> None:
    watched.kept = 0.0
    watched.mixture.freeze(0.4, REPORT | {"empty_fraction": 1.0})
    watched.go(200, 900)
    assert bool(watched.mixture.frozen) and watched.learner.progress.recoveries == 0


def test_what_was_found_travels_with_a_checkpoint() -> None:
    evidence = {"lost surface mass": tuple(evidence_after(0.3))}
    progress = Progress(watch=WatchState(rechecks=4, due=800, evidence=evidence))
    found = Progress.from_dict(progress.to_dict()).watch
    assert Evidence(*found.evidence["lost surface mass"]).exceeds()
    assert (found.rechecks, found.due) == (4, 800)


WALL, WIRE, SAMPLES = 15, 6, 20
"""Places along a ray: what the gate keeps at any threshold, and what it takes for hardly there."""


class Street:
    """Rays that end at a white wall; in a tenth of them a black wire is before it."""

    wires_are_learned = False

    def rays(self, count: int, seed: int = 0, which: str = "") -> Any:
        generator = torch.Generator().manual_seed(seed)
        there = torch.rand(count, generator=generator) < 0.1
        noise = 0.05 * torch.randn(len(there), 3, generator=generator)
        return there, torch.where(there, 0.1, 1.0)[:, None] + noise

    def rendering(self, mixture: Any, there: torch.Tensor, truth: Any, _: int) -> DenseRendering:
        assert not mixture.training
        shown = there & self.wires_are_learned
        weights = torch.zeros(len(there), SAMPLES)
        weights[:, WIRE] = 0.9 * shown
        weights[:, WALL] = 1.0 - weights[:, WIRE]
        occupancies = torch.full_like(weights, 0.05)
        occupancies[:, WIRE], occupancies[:, WALL] = 0.2, 0.95
        median = torch.where(shown, WIRE, WALL)[:, None]
        near = (torch.arange(SAMPLES) - median).abs() <= 2
        ray_indices = torch.arange(len(there)).repeat_interleave(SAMPLES)
        starts = torch.arange(SAMPLES).float().repeat(len(there))
        intervals = Intervals(ray_indices, starts, starts + 1.0)
        never = torch.zeros(weights.numel(), dtype=torch.bool)
        flat = weights.flatten(), occupancies.flatten(), near.flatten()

        def render_kept(_: int, mask: torch.Tensor) -> torch.Tensor:
            kept = weights * mask.view_as(weights)
            if not bool(mask.view_as(weights)[:, WIRE].all()):  # light goes on to the wall
                kept = kept.clone()
                kept[:, WALL] = 1.0
            return kept[:, WALL, None].expand(-1, 3)

        rgb = render_kept(0, ~never)
        return DenseRendering([Reference(intervals, *flat, rgb, never)], [truth], render_kept)


def test_a_learned_wire_lowers_the_threshold(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    street, run = Street(), ARun()
    monkeypatch.setattr(held_out, "dense_rendering", street.rendering)
    run.folder = tmp_path
    learner = guided(run)
    mixture = learner.mixture.train()
    learner.held_out.rays = street.rays  # type: ignore[method-assign]

    def go(first: int, last: int) -> None:
        for step in range(first, last):
            learner.after_step(step, 100.0, 3.0)

    go(200, 901)
    # nobody sees the wires yet
    assert float(mixture.threshold) == pytest.approx(0.4) and not run.saved
    street.wires_are_learned = True
    go(901, 1001)
    assert learner.progress.watch.rechecks == 8 and run.saved == [1000]
    assert 0.15 < float(mixture.threshold) < 0.2
    report = Occupancy.load(tmp_path / FILE_NAME).report
    assert report["threshold"] == pytest.approx(float(mixture.threshold))
    assert report["lost_surface_mass"] <= CONFIG.lost_surface_mass
    assert report["image_price_db"] <= CONFIG.image_price_db and report["empty_fraction"] > 0.8
    go(1001, 3000)
    assert run.saved == [1000] and mixture.training


def test_a_gate_that_keeps_nothing_near_the_end_stays_frozen_and_keeps_everything(
    watched: Any, tmp_path: Path, printed: Any
) -> None:
    measured = Measured(0.0, 1e-9, 2e-9, 3e-9, 0.0, 4e-9, 5e-9)

    def lower(below: float, seed: int) -> Measured:
        assert below == 0.0
        return measured

    watched.learner.held_out.lower = lower
    watched.run.end = 400
    watched.kept = 0.0
    watched.go(280, 381)
    assert not watched.learner.progress.looks_collapsed, "else nothing would be saved"
    watched.kept = 64.0
    watched.go(381, 400)
    assert bool(watched.mixture.frozen) and float(watched.mixture.threshold) == 0.0
    assert watched.run.saved == [380]
    occupancy = Occupancy.load(tmp_path / FILE_NAME)
    assert occupancy.threshold == 0.0 and occupancy.report["lowered"] == [[380, 0.0]]
    assert occupancy.report.items() >= measured._asdict().items(), "prices are as measured"
    assert "keeps nothing of what the cameras see, and" in printed()
