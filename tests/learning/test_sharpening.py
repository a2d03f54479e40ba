"""Claims about the small gate that a frozen mixture's field teaches."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from small_learner import SMALLEST, ARun, small_learner, small_mixture
from torch import Tensor

from leco_plugin.learning import sharpening
from leco_plugin.learning.calibration import CalibrationConfig, Measured, lost_by_each
from leco_plugin.learning.dense import dense_rendering
from leco_plugin.learning.history import as_learned
from leco_plugin.learning.learner import Learner
from leco_plugin.learning.sharpening import (
    Lesson,
    Sharpened,
    SharpeningConfig,
    _rescore,
    guided_reference,
    lesson_from_field,
    sharpen,
)
from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.gate import Gate, GateConfig
from leco_plugin.models.mixture import Mixture
from leco_plugin.models.objective import GateLossConfig
from leco_plugin.models.rendering import Rays
from leco_plugin.occupancy import CAMERAS_THAT_VOUCH, TESTS_LOSE, Occupancy
from leco_plugin.scenes.input_error import InputError

GATE = GateConfig(EncodingConfig(octaves=2), 16, 1, 1, normed=False)
LOSSES = GateLossConfig()
WALL = 0.1
"""Half the thickness of the wall at x = 0, in the mapped cube."""


class WallField(torch.nn.Module):
    """Opaque within `WALL` of x = 0, and white."""

    def __init__(self, field: Any) -> None:
        super().__init__()
        self.experts, self.color = field.experts, lambda features, *_: torch.ones_like(features)
        self.asked = 0

    def density(self, mapped: Tensor, routes: Tensor, gate_values: Tensor) -> tuple[Tensor, Tensor]:
        self.asked += len(mapped)
        return 500.0 * (mapped[:, 0].abs() < WALL).float(), torch.ones(len(mapped), 3)


class WideGate(Gate):
    """Sure that nothing lies beyond so many walls' thickness, and that something lies within."""

    walls = 4.0

    def forward(self, mapped: Tensor) -> Tensor:
        within = mapped[:, 0].abs() < self.walls * WALL
        logit = torch.where(within, 2.0, -9.0)
        return torch.stack([torch.zeros_like(logit), logit, logit - 1.0], dim=-1)


def a_mixture() -> Mixture:
    torch.manual_seed(0)
    mixture = small_mixture(replace(SMALLEST, candidates=64))
    mixture.region.space.set("box", torch.zeros(3), 1.0)
    mixture.region.near.fill_(0.01)
    mixture.region.far.fill_(4.0)
    mixture.region.aabb.copy_(torch.tensor([-1.0] * 3 + [1.0] * 3))
    mixture.steps.fill_(2.0 / 64)
    mixture.field = WallField(mixture.field)  # type: ignore[assignment]
    mixture.gate = WideGate(SMALLEST.gate)
    mixture.freeze(0.5, {"step": 3, "params": 7, **report_of(0.6)})
    return mixture.eval()


def report_of(skipped: float) -> dict[str, float]:
    return Measured(0.5, 1e-4, 2e-4, 0.01, skipped)._asdict()


def vouched(worst: float, bound: float) -> dict[str, float]:
    return {"count": 9, "worst_surface_mass": worst, "bound": bound, "confidence": 0.9}


def some_rays(mixture: Mixture, count: int) -> Rays:
    origins = torch.rand(count, 3) * torch.tensor([0.0, 1.0, 1.0]) - torch.tensor([0.99, 0.5, 0.5])
    directions = torch.tensor([[1.0, 0.0, 0.0]]).expand(count, 3)
    return mixture.rays(origins, directions, None)


def test_the_lesson_is_the_widened_weight_of_every_candidate() -> None:
    mixture = a_mixture()
    lesson = lesson_from_field(mixture, some_rays(mixture, 20), LOSSES, 0.125, 8)
    x = lesson.mapped[:, 0]
    front = -WALL + torch.tensor([-0.04, 0.05])  # a step before the wall, and the first within
    met = (x > front[0]) & (x < front[1])
    torch.testing.assert_close(lesson.keep, LOSSES.emphasis * (1.0 - lesson.skip))
    assert (lesson.skip[met] < 0.5).any() and (lesson.skip[x < front[0] - 0.05] == 1.0).all()
    assert (lesson.skip[x > 0.5] == 1.0).all(), "what no ray reaches has nothing to say"
    assert len(x) > 20 * 50, "candidates that are skipped teach too"
    rays = some_rays(mixture, 5)
    every = mixture.with_backdrops(rays, mixture.candidates(rays))
    taught = lesson_from_field(mixture, rays, LOSSES, 0.125, 8).mapped
    assert len(taught) == len(every.t_starts) - 5, "and no backdrop, which no gate skips"


def test_only_what_is_seen_is_rendered_and_the_lesson_is_the_same() -> None:
    mixture = a_mixture()
    rays = some_rays(mixture, 20)
    every = lesson_from_field(mixture, rays, LOSSES, 0.0, 8)
    asked = mixture.field.asked
    some = lesson_from_field(mixture, rays, LOSSES, 0.125, 8)
    assert mixture.field.asked - asked < 0.6 * asked
    for one, other in zip(every, some):
        torch.testing.assert_close(one, other)


def test_what_is_not_seen_has_no_weight_and_is_a_candidate_still() -> None:
    mixture = a_mixture()
    mixture.gate.walls = 0.5  # type: ignore[assignment]
    rays, truth = some_rays(mixture, 10), torch.ones(10, 3)
    dense = dense_rendering(mixture, rays, truth, 10).references[0]
    seen = guided_reference(mixture, rays)
    assert len(seen.weights) == len(dense.weights)
    below = seen.occupancies < 0.5
    assert not seen.weights[below & ~seen.always_kept].any() and dense.weights[below].any()


def test_a_small_gate_skips_what_the_large_one_keeps_of_free_space() -> None:
    mixture = a_mixture()
    taught, held_out = some_rays(mixture, 400), (some_rays(mixture, 100), torch.ones(100, 3))
    config = SharpeningConfig(steps=150, gate=GATE)
    found = sharpen(mixture, taught, held_out, [], [], LOSSES, CalibrationConfig(), config)
    assert found.pays and found.measured.empty_fraction > found.before.empty_fraction + 0.1
    assert found.measured.within(CalibrationConfig()) and found.measured.threshold > 0.0
    assert mixture.small is None, "it only says what would be"
    assert all(torch.equal(p, p.bfloat16().float()) for p in found.gate.parameters())


def test_a_small_gate_may_cost_only_what_the_large_one_has_left() -> None:
    mixture, bounds = a_mixture(), CalibrationConfig()
    data = some_rays(mixture, 400), (some_rays(mixture, 100), torch.ones(100, 3))
    views = [some_rays(mixture, 50)], [some_rays(mixture, 50)]  # of the latter, nothing is known
    config = SharpeningConfig(steps=150, gate=GATE)
    mixture.report = report_of(0.6) | {CAMERAS_THAT_VOUCH: vouched(0.001, 0.002)}
    found = sharpen(mixture, *data, *views, LOSSES, bounds, config)
    assert found is not None and found.measured.threshold > 0.0 and found.promised is not None
    assert found.promised["worst_surface_mass"] >= 0.001 and found.promised["confidence"] is None
    mixture.report |= {"lost_surface_mass": 2.0 * bounds.lost_surface_mass}
    spent = sharpen(mixture, *data, *views, LOSSES, bounds, config)
    assert spent is not None and spent.measured.threshold == 0.0 and not spent.pays


def test_a_new_view_loses_to_both_gates_what_test_photographs_do() -> None:
    mixture, bounds = a_mixture(), CalibrationConfig()
    data = some_rays(mixture, 400), (some_rays(mixture, 100), torch.ones(100, 3))
    tests = [some_rays(mixture, 50), some_rays(mixture, 50)]
    so_far = {CAMERAS_THAT_VOUCH: vouched(0.001, 0.002), TESTS_LOSE: [0.004, 0.0]}
    mixture.report |= so_far
    found = sharpen(mixture, *data, [], tests, LOSSES, bounds, SharpeningConfig(150, gate=GATE))
    assert found is not None
    score, threshold = partial(mixture.occupancies, gate=found.gate), found.measured.threshold
    with torch.no_grad():
        again = [_rescore(mixture, score, rays, guided_reference(mixture, rays)) for rays in tests]
    first, second = lost_by_each(again, threshold)
    assert found.tests_lose == pytest.approx([0.004 + first, second]) and threshold > 0.0
    worst = max(found.tests_lose)
    expected = {"count": 2, "worst_surface_mass": worst, "confidence": 0.667}
    assert found.promised == expected | {"bound": max(worst, bounds.camera_surface_mass)}
    report = found.report(mixture.report, SMALLEST.gate)
    assert report[CAMERAS_THAT_VOUCH] == found.promised
    assert report[TESTS_LOSE] == found.tests_lose


def test_only_what_is_kept_is_taught_and_rendered(monkeypatch: pytest.MonkeyPatch) -> None:
    shares: list[float] = []
    real = sharpening._candidates_of

    def noted(mixture: Mixture, rays: Rays, seen: float) -> Any:
        shares.append(seen)
        return real(mixture, rays, seen)

    monkeypatch.setattr(sharpening, "_candidates_of", noted)
    mixture = a_mixture()
    data = some_rays(mixture, 30), (some_rays(mixture, 10), torch.ones(10, 3))
    config = SharpeningConfig(steps=1, gate=GATE)
    sharpen(mixture, *data, [], [], LOSSES, CalibrationConfig(), config)
    assert shares == [1.0, 1.0], "the lesson, then prices"


class Pixels:
    """Data of a mixture, whose pixels are white."""

    def __init__(self, mixture: Mixture) -> None:
        self.mixture = mixture
        self.survey = None

    def training_rays(self, mixture: Mixture, count: int) -> Rays:
        return some_rays(mixture, count)

    def held_out(self, mixture: Mixture, count: int, *_: Any) -> tuple[Rays, Tensor]:
        return some_rays(mixture, 60), torch.ones(60, 3)

    def of_vouching(self, *_: Any) -> list[Any]:
        return []

    def of_tests(self, *_: Any) -> list[Any]:
        return []

    def prepare_batch(self, *_: Any, **__: Any) -> None:
        """Nothing is drawn."""

    def count_held_out(self, limit: int) -> float:
        return 0.0


def at_the_end(mixture: Mixture, end: float = 31, **options: Any) -> Learner:
    """A learner before the last step of a run whose gate was frozen at step 3."""
    given = {"steps": 5, "least_steps": 10, "rays": 50, "gate": GATE} | options
    sharpening, run = SharpeningConfig(**given), ARun(end=end)
    pixels = Pixels(mixture)
    return small_learner(run, mixture, pixels, sharpening=sharpening, calibration=NEVER_AGAIN)


@pytest.mark.parametrize(("end", "sharpened"), [(15, True), (14, False)])
def test_it_is_sharpened_at_the_end_of_a_run_that_pays_for_it(
    tmp_path: Path, end: int, sharpened: bool, printed: Any
) -> None:
    """Frozen at step 3, a run of 15 steps is guided for 10.5 until nine tenths are over."""
    mixture = a_mixture()
    learner = at_the_end(mixture, end, steps=100, rays=200)
    learner.run.folder, last = tmp_path, end - 2
    learner.watch.state.evidence = {"the image price": (9.0, 9.0, 9.0)}
    learner.after_step(last - 1, 0.1, 5.0)
    assert mixture.small is None
    learner.after_step(last, 0.1, 5.0)
    assert (mixture.small is not None) == sharpened
    assert learner.progress.sharpened_at == (last if sharpened else -1)
    assert learner.run.saved == ([last] if sharpened else [])
    soon = last + NEVER_AGAIN.steps_per_recheck
    assert learner.watch.state.due == (soon if sharpened else 0), "its price is measured soon"
    assert (learner.watch.state.evidence == {}) == sharpened, "it was of the large gate"
    if not sharpened:
        return
    said = printed().split("taught in")[1]
    assert "new views may lose more" in said, "the promise is that of the new gate"
    file = Occupancy.load(tmp_path / "occupancy.safetensors")
    assert file.gate.config == GATE and file.threshold == float(mixture.threshold)
    report = file.report
    assert report["empty_fraction"] > 0.6 and report["params"] == file.num_params
    assert report["lost_surface_mass"] >= 1e-4, "what was lost before is declared too"
    assert report["learned"]["empty_fraction"] == 0.6 and report["learned"]["params"] == 7
    assert report["sharpened"][0][0] == last
    assert as_learned(file).gate.config == SMALLEST.gate and as_learned(file).threshold == 0.5


@pytest.mark.parametrize(
    ("end", "steps", "goes_on", "careful"),
    [
        (200, 5, True, True),
        (15, 5, True, True),
        (14, 5, True, False),
        (200, 0, True, False),
        (200, 5, False, False),
        (math.inf, 5, True, False),
    ],
    ids=["long", "just long enough", "too short", "never sharpened", "a gate alone", "endless"],
)
def test_a_gate_that_a_small_one_follows_skips_carefully(
    end: float, steps: int, goes_on: bool, careful: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frozen at step 3, a run of 15 steps is guided for 10.5 until nine tenths are over."""
    learner, asked = at_the_end(small_mixture(), end, steps=steps), []
    monkeypatch.setattr(learner.run, "goes_on", goes_on)

    def price(careful: bool) -> None:
        asked.append(careful)
        raise StopIteration

    monkeypatch.setattr(learner.held_out, "price", price)
    with pytest.raises(StopIteration):
        learner._freeze(3)
    assert asked == [careful]


def test_a_gate_that_no_small_one_can_follow_is_not_careful() -> None:
    table = GateConfig(EncodingConfig("hash", levels=2, log2_table=6), 8, 1, 1)
    assert at_the_end(small_mixture(), 200)._may_sharpen(after=3)
    assert not at_the_end(small_mixture(), 200, gate=table)._may_sharpen(after=3)


@pytest.mark.parametrize("least_steps", [0, 1, 10])
def test_a_tenth_of_a_run_is_sharpened(least_steps: int, monkeypatch: pytest.MonkeyPatch) -> None:
    learner = at_the_end(a_mixture(), 200, least_steps=least_steps)
    asked: list[int] = []
    monkeypatch.setattr(learner.held_out, "sharpened", lambda *_: asked.append(step))
    for step in range(170, 200):  # a gate that skips no more is not taught again and again
        learner.after_step(step, 0.1, 5.0)
    assert asked == [179]


NEVER_AGAIN = CalibrationConfig(recheck_rays=0)


def test_a_gate_that_learns_again_at_the_last_step_is_not_sharpened() -> None:
    mixture = a_mixture()
    learner = at_the_end(mixture, 21)
    learner._watch = lambda *_: mixture.reopen()  # type: ignore[method-assign]
    learner.after_step(20, 0.1, 0.0)
    assert mixture.small is None and not bool(mixture.frozen)


@pytest.mark.parametrize("why", ["too soon after the last time", "another kind", "no positions"])
def test_at_the_last_step_a_gate_stays(why: str, monkeypatch: pytest.MonkeyPatch) -> None:
    options: dict[str, Any] = {}
    if why == "another kind":
        table = EncodingConfig("hash", levels=2, log2_table=6)
        options["gate"] = GateConfig(table, 8, 1, 1)
    elif why == "no positions":
        empty = Lesson(torch.empty(0, 3), torch.empty(0), torch.empty(0))
        monkeypatch.setattr(sharpening, "lesson_from_field", lambda *_: empty)
    else:
        options["least_steps"] = 20
    mixture = a_mixture()
    learner = at_the_end(mixture, **options)
    if why == "too soon after the last time":
        learner.progress.sharpened_at = 15
    learner.after_step(30, 0.1, 5.0)
    assert mixture.small is None


def test_prices_of_guided_sharpening_are_sums_of_costs() -> None:
    before = Measured(0.5, 1e-4, 1e-4, 0.03, 0.6, 3e-5, 0.003)
    found = Measured(0.4, 2e-4, 2e-4, -0.05, 0.7, 4e-5, 0.004)
    report = Sharpened(Gate(GATE), found, before, vouched(3e-4, 2e-3)).report(
        {"params": 7, **before._asdict(), CAMERAS_THAT_VOUCH: vouched(1e-4, 2e-3)},
        SMALLEST.gate,
    )
    assert report["image_price_db"] == 0.03 and report["price_error_db"] == pytest.approx(0.005)
    assert report["lost_surface_mass"] == pytest.approx(3e-4)
    assert report["surface_error"] == pytest.approx(5e-5)


def test_a_second_small_gate_leaves_in_the_report_what_the_large_one_did() -> None:
    frozen, then, now = (Measured(0.5 - skip, 1e-4, 1e-4, 0.01, skip) for skip in (0.1, 0.2, 0.3))
    report: dict[str, Any] = {"params": 7, **frozen._asdict()}
    for measured, before in ((then, frozen), (now, then)):
        report = Sharpened(Gate(GATE), measured, before, None).report(report, SMALLEST.gate)
    learned = report["learned"]
    assert (learned["threshold"], learned["empty_fraction"], learned["params"]) == (0.4, 0.1, 7)
    assert (report["threshold"], report["empty_fraction"]) == (now.threshold, now.empty_fraction)


def test_the_log_names_the_costs_of_both_gates_and_what_does_not_pay() -> None:
    before, more = (Measured(0.5, 2e-4, 0.0, 0.02, share) for share in (0.5, 0.75))
    line = Sharpened(Gate(GATE), more, before, None).line({"image_price_db": 0.01})
    assert line.startswith("skips 75.0% for +0.030 dB and 2.00e-04 of the surface mass in all")
    none = Sharpened(Gate(GATE), before, before, None)
    assert not none.pays and "the gate stays" in none.line({})


def test_a_small_gate_travels_with_a_checkpoint_and_leaves_when_the_gate_learns_again() -> None:
    one, other = small_mixture(), small_mixture()
    one.freeze(0.4, {})
    one.sharpen(Gate(GATE), 0.3, {"params": 1})
    other.load_state_dict(one.state_dict())
    assert other.small is not None and other.small.config == GATE
    mapped = 2.0 * torch.rand(50, 3) - 1.0
    assert torch.equal(one.occupancies(mapped), other.occupancies(mapped))
    assert torch.equal(other.occupancies(mapped), other.small.occupancy(mapped))
    assert other.occupancy().gate is other.small and float(other.threshold) == pytest.approx(0.3)
    plain = small_mixture()
    plain.freeze(0.4, {})
    other.load_state_dict(plain.state_dict())
    assert other.small is None
    one.reopen()
    assert one.small is None and one.occupancy().gate is one.gate


def test_prices_of_a_sharpened_mixture_are_of_the_small_gate() -> None:
    mixture = a_mixture()
    rays = some_rays(mixture, 10)
    small = WideGate(GATE)
    small.walls = 1.5  # type: ignore[assignment]
    mixture.sharpen(small, 0.5, {})
    reference = dense_rendering(mixture, rays, torch.ones(10, 3), 10).references[0]
    kept = (reference.occupancies >= 0.5) & ~reference.always_kept
    assert 0.05 < float(kept.float().mean()) < 0.25


@pytest.mark.parametrize(("option", "value"), [("steps", -1), ("rays", 0), ("least_steps", -1)])
def test_settings_that_make_no_sense_are_refused(option: str, value: float) -> None:
    with pytest.raises(InputError, match=f"sharpening.{option.replace('_', '-')}"):
        SharpeningConfig(**{option: value})
