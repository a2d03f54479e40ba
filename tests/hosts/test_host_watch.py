"""A guided host skips less where skipping has come to cost it too much."""

from __future__ import annotations

import copy
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from ball_occupancy import ball
from nerfstudio.model_components.renderers import RGBRenderer

from leco_plugin.hosts import host_watch
from leco_plugin.hosts.guide import Guide
from leco_plugin.hosts.guided import GuidedHost
from leco_plugin.hosts.host_watch import (
    CAREFUL,
    LOWERED_TO,
    HostWatch,
    begin_carefully,
    squared_errors,
)
from leco_plugin.hosts.stand_ins import GuidedEstimator
from leco_plugin.learning import price_watch
from leco_plugin.learning.calibration import THRESHOLDS, CalibrationConfig
from leco_plugin.learning.run import LearningOnly
from leco_plugin.occupancy import CALIBRATED_AT, CAMERAS_THAT_VOUCH, Occupancy

BOX = torch.tensor([-4.0, -4.0, -4.0, 4.0, 4.0, 4.0])
RAYS = 64


class Host:
    """A host whose pixels are off by `price` where something is skipped."""

    device = torch.device("cpu")

    def __init__(self, guide: Guide) -> None:
        self.guide, self.price, self.training = guide, 0.0, True
        self.thresholds: list[float] = []

    def eval(self) -> None:
        self.training = False

    def train(self, mode: bool = True) -> None:
        self.training = mode

    def __call__(self, truth: torch.Tensor) -> dict[str, torch.Tensor]:
        assert not self.training
        self.thresholds.append(self.guide.followed().threshold)
        self.guide.kept = 0  # as if it sampled
        off = 0.1 + (0.0 if self.guide.dense else self.price)
        return {"rgb": truth + off}


@pytest.fixture
def packed(watched: Watched) -> torch.nn.Module:
    """A host whose samples are packed."""
    return torch.nn.ModuleList([GuidedEstimator(watched.guide, BOX)])


class Watched(SimpleNamespace):
    @property
    def threshold(self) -> float:
        """As files and checkpoints say."""
        return self.guide.the_occupancy().threshold

    def go(self, first: int, last: int) -> None:
        for step in range(first, last):
            self.watch.before_step(step)
            self.now[0] += 0.1
            self.guide.kept = self.kept
            self.watch.after_step(step)


@pytest.fixture
def watched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Watched:
    guide, now, asked = Guide(), [0.0], []
    occupancy = copy.deepcopy(ball())
    occupancy.report = {"threshold": occupancy.threshold, "empty_fraction": 0.8, "params": 5}
    guide.set_occupancy(occupancy)
    host = Host(guide)
    monkeypatch.setattr(host_watch, "seconds_now", lambda: now[0])

    def held_out_bundle(_: Any, count: int, seed: int, share: str) -> Any:
        assert share == "recheck"
        asked.append(seed)
        truth = torch.rand(RAYS, 3)
        return truth, truth

    monkeypatch.setattr(host_watch, "held_out_bundle", held_out_bundle)
    run = LearningOnly()
    run.folder = tmp_path
    pipeline = SimpleNamespace(datamanager=None)
    watch = HostWatch(host, guide, CalibrationConfig(), pipeline, run)
    return Watched(guide=guide, host=host, watch=watch, now=now, asked=asked, kept=9, out=tmp_path)


def test_an_occupancy_that_others_hold_keeps_its_threshold(watched: Watched) -> None:
    held = watched.guide.the_occupancy()
    before, report = held.threshold, copy.deepcopy(held.report)
    watched.watch._lower(5, 0.5 * before, "a reason")
    assert (held.threshold, held.report) == (before, report)
    assert watched.threshold == 0.5 * before and watched.guide.the_occupancy().gate is held.gate


def test_a_price_beyond_its_bound_lowers_the_threshold_until_it_is_not(watched: Watched) -> None:
    before, version = watched.threshold, watched.guide.version
    watched.go(0, 250)
    assert watched.asked == [1, 2] and watched.threshold == before
    watched.host.price = 0.05
    watched.go(250, 301)
    after = watched.guide.the_occupancy()
    assert after.threshold == pytest.approx(LOWERED_TO * before)
    assert watched.guide.version > version and not watched.guide.dense
    assert watched.host.training and watched.guide.kept == 9
    left = Occupancy.load(watched.out / "occupancy.safetensors")
    assert left.threshold == after.threshold and left.report["lowered"] == [[300, after.threshold]]
    assert left.report[CALIBRATED_AT] == before and left.report["empty_fraction"] == 0.8
    watched.go(301, 3000)
    assert watched.threshold == 0.0
    nothing = watched.guide.the_occupancy().report
    assert nothing["empty_fraction"] == nothing["image_price_db"] == 0.0
    assert CALIBRATED_AT not in nothing and nothing["params"] == 5
    measured = len(watched.asked)
    watched.go(3000, 3500)
    assert len(watched.asked) == measured  # nothing is skipped, nothing is lost


def test_figures_stay_those_of_the_calibrated_threshold_however_often_it_is_lowered() -> None:
    once = host_watch._lowered({"empty_fraction": 0.8, "threshold": 0.4}, 0.4, 100, 0.1)
    twice = host_watch._lowered(once, 0.1, 200, 0.025)
    assert once[CALIBRATED_AT] == twice[CALIBRATED_AT] == 0.4
    assert twice["threshold"] == 0.025 and twice["empty_fraction"] == 0.8
    assert twice["lowered"] == [[100, 0.1], [200, 0.025]]


def test_where_nothing_is_skipped_photographs_that_vouch_lose_nothing() -> None:
    said = {"count": 9, "worst_surface_mass": 1e-3, "bound": 2e-3, "confidence": 0.9}
    report = {"empty_fraction": 0.8, "threshold": 0.4, CAMERAS_THAT_VOUCH: said}
    assert host_watch._lowered(report, 0.4, 100, 0.1)[CAMERAS_THAT_VOUCH] == said
    nothing = host_watch._lowered(report, 0.4, 100, 0.0)[CAMERAS_THAT_VOUCH]
    assert nothing["worst_surface_mass"] == nothing["bound"] == 0.0 and nothing["count"] == 9


def test_photographs_with_alpha_are_compared_as_the_host_renders_them(watched: Watched) -> None:
    """White under transparent pixels is black before the black that a random background is when a
    host renders; as it stands in the file it would be an error that hides the price of skipping."""
    watched.host.renderer_rgb = RGBRenderer(background_color="random")
    seen, alpha = torch.zeros(RAYS, 3), (torch.arange(RAYS) % 2)[:, None].float()
    truth = torch.cat([1.0 - alpha.expand(-1, 3), alpha], dim=-1)
    host = watched.host
    host.__class__ = type("Black", (Host,), {"__call__": lambda self, _: {"rgb": seen}})
    assert not squared_errors(host, None, truth).any()


@pytest.mark.parametrize("price", [0.0, 0.05])
def test_probation_ends_in_every_process_though_the_first_one_alone_measures(
    watched: Watched, packed: torch.nn.Module, monkeypatch: pytest.MonkeyPatch, price: float
) -> None:
    """The second process gets what the first one has found, and calls nothing itself."""
    found: list[Any] = []
    guides = watched.guide, copy.deepcopy(watched.guide)
    ends = []
    for rank, guide in enumerate(guides):

        def from_first(make: Any, device: Any, rank: int = rank) -> Any:
            if rank == 0:
                found.append(make())
                return copy.deepcopy(found[-1])
            return found.pop(0)

        monkeypatch.setattr(price_watch, "from_first", from_first)
        guide.watched.lower = guide.the_occupancy().threshold / 16
        host = Host(guide)
        host.price = price
        watch = HostWatch(host, guide, CalibrationConfig(), watched.watch.pipeline, LearningOnly())
        Watched(guide=guide, watch=watch, now=watched.now, kept=9).go(0, 250)
        ends.append((guide.followed().threshold, guide.watched.due, guide.watched.lower))
    assert ends[0] == ends[1] and not found


def a_half(occupancy: Occupancy) -> float:
    """What is skipped, where the threshold does not matter."""
    return 0.5


def test_all_processes_begin_with_what_the_first_one_has_found(
    watched: Watched, packed: torch.nn.Module, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(host_watch, "from_first", lambda make, device: 0.123)
    assert begin_carefully(packed, watched.guide, a_half)
    assert watched.guide.followed().threshold == pytest.approx(0.123)


def test_what_skips_too_little_is_no_beginning(watched: Watched, packed: Any) -> None:
    """The threshold is doubled until 40% as much is skipped as by the calibrated one, of what is
    within the bounds: here 40% of the rays are not."""
    calibrated = watched.threshold

    def from_a_fifth_on(occupancy: Occupancy) -> float:
        within = 0.8 if occupancy.threshold > 0.2 * calibrated else 0.3
        return 0.4 + 0.6 * within if occupancy.threshold > 1e-20 else 0.4

    assert begin_carefully(packed, watched.guide, from_a_fifth_on)
    assert watched.guide.followed().threshold == pytest.approx(4.0 * CAREFUL * calibrated)


def test_where_only_the_calibrated_threshold_skips_it_is_followed_at_once(
    watched: Watched, packed: Any
) -> None:
    calibrated = watched.threshold

    def all_or_nothing(occupancy: Occupancy) -> float:
        return 0.8 if occupancy.threshold >= calibrated else 0.0

    assert not begin_carefully(packed, watched.guide, all_or_nothing)
    assert watched.guide.followed() is watched.guide.the_occupancy()


def test_a_host_that_can_afford_it_follows_the_calibrated_threshold_after_a_while(
    watched: Watched, packed: Any, capsys: Any
) -> None:
    calibrated, version = watched.threshold, watched.guide.version
    assert begin_carefully(packed, watched.guide, a_half) and watched.guide.version > version
    watched.go(0, 100)
    assert watched.guide.followed().threshold == pytest.approx(CAREFUL * calibrated)
    assert watched.threshold == calibrated  # as files and checkpoints say
    version = watched.guide.version
    watched.go(100, 201)
    assert watched.guide.followed() is watched.guide.the_occupancy()
    assert watched.guide.version > version and watched.asked == [1, 2]
    assert set(watched.host.thresholds) == {calibrated}  # that is what is measured
    assert not (watched.out / "occupancy.safetensors").exists()  # nothing of it has changed
    assert f"its threshold is {calibrated:.4f} now" in " ".join(capsys.readouterr().out.split())


def test_a_host_that_cannot_afford_it_stays_with_the_lower_threshold(
    watched: Watched, packed: Any
) -> None:
    calibrated = watched.threshold
    begin_carefully(packed, watched.guide, a_half)
    watched.host.price = 0.05
    watched.go(0, 101)
    watched.host.price = 0.0
    watched.go(101, 500)
    after = watched.guide.followed()
    assert after is watched.guide.the_occupancy()
    assert after.threshold == pytest.approx(CAREFUL * calibrated)
    left = Occupancy.load(watched.out / "occupancy.safetensors")
    assert left.threshold == after.threshold
    assert left.report["lowered"] == [[100, pytest.approx(after.threshold)]]


def test_the_careful_beginning_goes_on_in_a_resumed_run(watched: Watched, packed: Any) -> None:
    calibrated = watched.threshold
    begin_carefully(packed, watched.guide, a_half)
    watched.go(0, 50)
    fresh = Guide()
    fresh.load_state_dict(watched.guide.state_dict())
    assert fresh.the_occupancy().threshold == pytest.approx(calibrated)
    assert fresh.followed().threshold == pytest.approx(CAREFUL * calibrated)


def test_without_measurements_no_careful_beginning_goes_on(watched: Watched, packed: Any) -> None:
    begin_carefully(packed, watched.guide, a_half)
    never = CalibrationConfig(recheck_rays=0)
    HostWatch(watched.host, watched.guide, never, watched.watch.pipeline, LearningOnly())
    assert watched.guide.followed() is watched.guide.the_occupancy()


def test_what_keeps_nothing_is_followed_by_nobody(watched: Watched, packed: Any) -> None:
    begin_carefully(packed, watched.guide, a_half)
    watched.kept = 0
    watched.go(0, 101)
    assert watched.guide.followed().threshold == 0.0


def test_hosts_with_samples_of_a_fixed_number_and_thresholds_of_nothing_begin_as_they_are(
    watched: Watched, packed: Any
) -> None:
    assert not begin_carefully(torch.nn.Linear(2, 2), watched.guide, a_half)
    watched.guide.the_occupancy().threshold_value.fill_(THRESHOLDS[-1])
    assert not begin_carefully(packed, watched.guide, a_half)
    assert watched.guide.followed() is watched.guide.the_occupancy()


def test_what_was_wrong_once_is_soon_looked_at_again_however_long_that_takes(
    watched: Watched, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(price_watch, "steps_until_next", lambda *_: 2000)
    before = watched.threshold
    watched.host.price = 0.05
    watched.go(0, 201)
    assert watched.threshold == pytest.approx(LOWERED_TO**2 * before)
    watched.host.price = 0.0
    watched.go(201, 1000)
    assert watched.threshold == pytest.approx(LOWERED_TO**2 * before)
    assert len(watched.asked) == 3  # nothing was found again, and the next look is far away


def test_an_occupancy_that_keeps_nothing_is_not_followed(watched: Watched, capsys: Any) -> None:
    watched.kept = 0
    watched.go(0, 60)
    watched.kept = 3
    watched.go(60, 70)
    watched.kept = 0
    watched.go(70, 170)
    assert watched.threshold > 0.0
    watched.go(170, 171)
    assert watched.threshold == 0.0
    said = " ".join(capsys.readouterr().out.split())
    assert "step 170: the occupancy kept nothing for 100 steps" in said


def test_what_was_found_travels_with_a_checkpoint(watched: Watched) -> None:
    watched.go(0, 150)
    fresh = Guide()
    fresh.load_state_dict(watched.guide.state_dict())
    assert fresh.watched == watched.guide.watched and fresh.watched.rechecks == 1


@pytest.mark.parametrize("where", ["image", "loss", "weight"])
def test_a_host_takes_no_step_with_a_loss_that_is_not_finite(where: str) -> None:
    loss = torch.ones(())

    class Line(torch.nn.Linear):
        def get_loss_dict(self, outputs: Any, batch: Any) -> dict[str, torch.Tensor]:
            return {"rgb_loss": loss}

    host: Any = type("Line", (GuidedHost, Line), {})(2, 2)
    host.leco_guide = Guide()
    batch = {"image": torch.zeros(3)}
    assert host.get_loss_dict({}, batch) == {"rgb_loss": loss}
    loss.fill_(torch.nan)
    if where == "image":
        batch["image"][0] = torch.nan
    if where == "weight":
        host.weight.data[0] = torch.inf
    cause = {"image": "training image", "loss": "the loss itself", "weight": "parameter weight"}
    with pytest.raises(FloatingPointError, match=f"rgb_loss is not finite: .*{cause[where]}"):
        host.get_loss_dict({}, batch)
    host.eval()
    host.get_loss_dict({}, batch)


def test_all_processes_lower_the_threshold_or_none(
    watched: Watched, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept_elsewhere = 7.0
    monkeypatch.setattr(price_watch, "mean", lambda here, _: 0.5 * (here + kept_elsewhere))
    watched.kept = 0
    watched.go(0, 300)
    assert watched.threshold > 0.0
