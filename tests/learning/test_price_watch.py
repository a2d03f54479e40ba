"""Skipping is never more than calibration allows, also for the field that the gate meets later."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from leco_plugin.models.failures import GateCollapsed
from leco_plugin.learning import freezing, guided_watch, recheck
from leco_plugin.learning.calibration import (
    CalibrationConfig,
    Measured,
    RayPrices,
    Reference,
)
from leco_plugin.learning.guided_watch import GuidedWatch
from leco_plugin.learning.held_out_rendering import DenseRendering
from leco_plugin.learning.price_watch import (
    SHARE_OF_TIME,
    Evidence,
    beyond_bounds,
    measure_again,
    skip_less,
    steps_until_next,
)
from leco_plugin.learning.collapse import heal
from leco_plugin.learning.schedule import Collapse
from leco_plugin.learning.progress import NO_EVIDENCE, Progress
from leco_plugin.models.objective import GateLossConfig
from leco_plugin.models.rendering import Intervals

CONFIG = CalibrationConfig()


def evidence_after(mean: float, measurements: int = 8, seed: int = 0) -> Evidence:
    generator = torch.Generator().manual_seed(seed)
    evidence = Evidence(*NO_EVIDENCE)
    for _ in range(measurements):
        evidence = evidence.with_rays(mean + torch.randn(512, generator=generator), math.inf)
    return evidence


def test_the_evidence_is_a_mean_in_which_older_rays_count_less() -> None:
    evidence = Evidence(*NO_EVIDENCE)
    for value in (1.0, 2.0):
        evidence = evidence.with_rays(torch.full((10,), value), math.inf)
    assert evidence.total / evidence.rays == pytest.approx((0.8 * 1.0 + 2.0) / 1.8)


def test_rays_that_are_all_there_are_count_once() -> None:
    few = torch.linspace(-1.0, 1.2, 40)
    same = new = Evidence(*NO_EVIDENCE)
    for _ in range(20):
        same, new = same.with_rays(few, 40), new.with_rays(few, math.inf)
    assert same.rays == pytest.approx(40.0) and not same.exceeds()
    assert same.total / same.rays == pytest.approx(new.total / new.rays)
    assert new.exceeds()  # as so many new ones they would be taken for proof


def test_a_price_well_beyond_its_bound_is_found_at_once() -> None:
    assert evidence_after(0.3, measurements=1).exceeds()


def test_a_price_a_little_beyond_its_bound_is_found_by_more_rays() -> None:
    found = [evidence_after(0.07, measurements=8, seed=seed).exceeds() for seed in range(20)]
    assert sum(found) >= 18


def test_a_price_at_its_bound_is_rarely_taken_for_more() -> None:
    found = [evidence_after(0.0, seed=seed).exceeds() for seed in range(200)]
    assert sum(found) <= 10
    assert not Evidence(*NO_EVIDENCE).exceeds()
    assert not evidence_after(-0.5).exceeds()


def test_a_ray_that_is_no_number_is_no_evidence() -> None:
    values = torch.tensor([math.nan, 1.0, math.inf, 3.0])
    evidence = Evidence(*NO_EVIDENCE).with_rays(values, math.inf)
    assert evidence == (2.0, 4.0, 10.0)
    assert evidence.with_rays(values[:1], math.inf).rays == pytest.approx(1.6)


def test_measuring_again_keeps_to_its_share_of_the_time() -> None:
    for seconds, a_step in ((0.3, 0.1), (20.0, 0.1), (1e-3, 1.0), (1.0, 0.0)):
        steps = steps_until_next(CONFIG, seconds, a_step)
        assert steps >= CONFIG.steps_per_recheck
        assert seconds <= SHARE_OF_TIME * steps * max(a_step, 1e-9) * 1.0001


class Model(SimpleNamespace):
    """Of a frozen model, what watching touches."""

    def __init__(self, threshold: float = 0.4) -> None:
        super().__init__(
            config=SimpleNamespace(
                calibration=CONFIG,
                schedule=SimpleNamespace(restart=False),
                sizes=SimpleNamespace(candidates=64),
                gate_loss=GateLossConfig(),
            ),
            threshold=torch.tensor(threshold),
            device=torch.device("cpu"),
            progress=Progress(learn_steps=200, configured=200),
            report={"threshold": threshold, "empty_fraction": 0.7, "params": 5},
            gate=SimpleNamespace(head=torch.nn.Linear(4, 3)),
            guided_kept=3.0,
            forgotten=0,
            reopened=0,
        )

    def forget_estimator(self) -> None:
        self.forgotten += 1

    def reopen(self) -> None:
        self.reopened += 1

    training = True

    def eval(self) -> None:
        self.training = False

    def train(self, mode: bool) -> None:
        self.training = mode


@pytest.mark.parametrize("anew", [False, True])
def test_lost_surfaces_are_evidence_unless_the_field_has_never_learned_what_is_skipped(
    anew: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    half, same = torch.full((64,), 0.5), torch.ones(64)
    prices = RayPrices(same, half, half, same, same, same, 32, 64)
    monkeypatch.setattr(recheck, "calibration_rays", lambda *_: (None, None))
    monkeypatch.setattr(recheck, "dense_rendering", lambda *_: ())
    monkeypatch.setattr(recheck, "ray_prices", lambda *_, missed_only: prices)
    monkeypatch.setattr(recheck, "rays_to_check_with", lambda *_: math.inf)
    model = Model()
    model.config.schedule.restart = anew
    measure_again(model, None)  # type: ignore[arg-type]
    assert model.progress.rechecks == 1
    found = beyond_bounds(model.progress)
    assert found is None if anew else found == "lost surface mass"


@pytest.mark.parametrize("anew", [False, True])
@pytest.mark.parametrize("found", [0.2, 0.0])
def test_the_threshold_is_lowered_to_one_within_the_bounds_or_to_none(
    found: float, anew: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[Any] = []

    def calibrate(
        rays: Any, truth: Any, config: CalibrationConfig, below: float, missed_only: bool
    ) -> Measured:
        assert missed_only
        any_surface = replace(CONFIG, lost_surface_mass=1.0)
        assert config == (any_surface if anew else CONFIG)  # haze is before a young field's
        asked.append((rays, below))
        return Measured(found, 1e-4, 2e-3, 0.01, 0.5 if found else 0.0)

    monkeypatch.setattr(
        recheck, "calibration_rays", lambda *_, seed, share: (f"{share} rays {seed}", None)
    )
    monkeypatch.setattr(recheck, "dense_rendering", lambda model, *rays: rays)
    monkeypatch.setattr(recheck, "calibrate", calibrate)
    model = Model()
    model.config.schedule.restart = anew
    model.progress.rechecks, model.progress.surface = 3, (9.0, 9.0, 9.0)
    before = model.report
    skip_less(model, None, 700, "lost surface mass")  # type: ignore[arg-type]
    assert asked == [("all rays 3", pytest.approx(0.4))]
    assert float(model.threshold) == pytest.approx(found) and model.forgotten == 1
    assert model.report["threshold"] == found and model.report["params"] == 5
    assert model.report["lowered"] == [[700, found]] and "lowered" not in before
    assert model.progress.surface == NO_EVIDENCE
    said = " ".join(capsys.readouterr().out.split())
    assert "step 700: lost surface mass of skipping" in said
    assert ("from now on nothing is skipped" in said) == (found == 0.0)


@pytest.fixture
def watched(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """A watch over a model whose price is `price` more than allowed."""
    made = SimpleNamespace(price=-1.0, written=0, saved=[], measured=[], lowered=[])
    lifecycle = SimpleNamespace(
        model=Model(),
        pipeline=SimpleNamespace(datamanager=None),
        folder="folder",
        save=made.saved.append,
    )
    lifecycle.progress = lifecycle.model.progress

    def reopen(collapse: Collapse, step: int) -> None:
        model = lifecycle.model
        model.reopen()
        heal(model.gate.head, model.progress, collapse, torch.zeros(3), step, GateLossConfig())

    lifecycle.recoveries = SimpleNamespace(reopen=reopen)
    made.model, made.watch = lifecycle.model, GuidedWatch(lifecycle)  # type: ignore[arg-type]

    def measure_again(model: Any, _: Any) -> None:
        made.measured.append(made.step)
        rays = made.price + 0.1 * torch.randn(50)
        model.progress.surface = tuple(Evidence(*model.progress.surface).with_rays(rays, math.inf))

    def lower(model: Any, _: Any, step: int, why: str) -> None:
        made.lowered.append((step, why))
        model.threshold.mul_(0.5)
        model.progress.surface = NO_EVIDENCE

    def write(*_: Any) -> None:
        made.written += 1

    monkeypatch.setattr(guided_watch, "measure_again", measure_again)
    monkeypatch.setattr(guided_watch, "skip_less", lower)
    monkeypatch.setattr(guided_watch, "write_occupancy", write)

    def go(first: int, last: int) -> None:
        for made.step in range(first, last):
            made.watch.after_step(made.step, 1.0)

    made.go = go
    return made


def test_a_gate_whose_field_gets_better_skips_less_and_leaves_a_new_file(watched: Any) -> None:
    torch.manual_seed(0)
    watched.go(200, 650)
    assert watched.measured == [300, 400, 500, 600] and not watched.lowered
    watched.price = 5.0
    watched.go(650, 750)
    assert watched.lowered == [(700, "lost surface mass")]
    assert watched.saved == [700] and watched.written == 1
    watched.price = -1.0
    watched.go(750, 1200)
    assert len(watched.lowered) == 1


def test_where_nothing_is_skipped_nothing_is_measured(watched: Any) -> None:
    watched.model.threshold.fill_(0.0)
    watched.go(0, 500)
    assert not watched.measured


def test_a_frozen_gate_that_keeps_nothing_is_opened_again_and_then_given_up(watched: Any) -> None:
    watched.model.guided_kept = 0.0
    with pytest.raises(GateCollapsed, match=r"step \d+: the frozen gate keeps .* bounds"):
        watched.go(200, 2000)
    assert watched.model.reopened == watched.model.progress.recoveries == 3
    assert watched.step == 200 + 4 * 101 - 1


def test_an_occupancy_of_an_empty_scene_may_keep_nothing(watched: Any) -> None:
    watched.model.guided_kept = 0.0
    watched.model.report["empty_fraction"] = 1.0
    watched.go(200, 900)
    assert watched.model.reopened == 0


def test_what_was_found_travels_with_a_checkpoint() -> None:
    progress = Progress(rechecks=4, recheck_due=800, surface=tuple(evidence_after(0.3)))
    found = Progress.from_dict(progress.to_dict())
    assert beyond_bounds(found) == "lost surface mass"
    assert (found.rechecks, found.recheck_due) == (4, 800)


WALL, WIRE, SAMPLES = 15, 6, 20
"""Places along a ray: what the gate keeps at any threshold, and what it takes for hardly there."""


class Street:
    """Rays that end at a white wall; in a tenth of them a black wire is before it."""

    wires_are_learned = False

    def rays(
        self, model: Any, data: Any, count: int | None = None, seed: int = 0, share: str = ""
    ) -> Any:
        generator = torch.Generator().manual_seed(seed)
        there = torch.rand(count or CONFIG.rays, generator=generator) < 0.1
        noise = 0.05 * torch.randn(len(there), 3, generator=generator)
        return there, torch.where(there, 0.1, 1.0)[:, None] + noise

    def rendering(self, model: Any, there: torch.Tensor, truth: torch.Tensor) -> DenseRendering:
        assert not model.training
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


def test_a_field_that_learns_a_wire_lowers_the_threshold_until_the_wire_is_kept(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    street, model, left, saved = Street(), Model(), [], []
    for module in (recheck, freezing):
        monkeypatch.setattr(module, "calibration_rays", street.rays)
        monkeypatch.setattr(module, "dense_rendering", street.rendering)
    monkeypatch.setattr(guided_watch, "write_occupancy", lambda m, _: left.append(m.report))
    lifecycle: Any = SimpleNamespace(
        model=model,
        progress=model.progress,
        pipeline=SimpleNamespace(datamanager=None),
        folder="folder",
        save=saved.append,
    )
    watch = GuidedWatch(lifecycle)

    def go(first: int, last: int) -> None:
        for step in range(first, last):
            watch.after_step(step, 100.0)

    go(200, 901)
    assert float(model.threshold) == pytest.approx(0.4) and not saved  # nobody sees the wires yet
    street.wires_are_learned = True
    go(901, 1001)
    assert model.progress.rechecks == 8 and saved == [1000]
    assert 0.15 < float(model.threshold) < 0.2
    (report,) = left
    assert report["threshold"] == pytest.approx(float(model.threshold))
    assert report["lost_surface_mass"] <= CONFIG.lost_surface_mass
    assert report["image_price_db"] <= CONFIG.image_price_db and report["empty_fraction"] > 0.8
    go(1001, 3000)
    assert saved == [1000] and model.training
