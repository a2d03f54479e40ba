"""A packed host teaches its own gate: the ball of the tiny scene, whose density is known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from scene_readers import Data
from tiny_scene import BALL_CENTRE, BALL_RADIUS
from torch import Tensor, nn

from leco_plugin.hosts import along
from leco_plugin.hosts.along import OPEN, Along, bounds_of
from leco_plugin.hosts.guide import Guide
from leco_plugin.learning.calibration import image_price
from leco_plugin.learning.run import LearningOnly
from leco_plugin.learning.sharpening import SharpeningConfig
from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.gate import GateConfig
from leco_plugin.models.leco_config import LecoModelConfig
from leco_plugin.occupancy import CALIBRATED_AT, CAMERAS_THAT_VOUCH, TESTS_LOSE, Occupancy
from leco_plugin.samplers.packed import accumulate_along_rays, render_weight_from_density
from leco_plugin.scenes.input_error import InputError

SMALL = SharpeningConfig(
    steps=200, rays=2000, gate=GateConfig(EncodingConfig(octaves=2), 16, 1, 1, normed=False)
)
CONFIG = LecoModelConfig(sharpening=SMALL)
MARCH = {"render_step_size": 0.04, "near_plane": 0.05, "far_plane": 4.0}


class BallHost(nn.Module):
    """White and opaque in the ball, and nothing elsewhere."""

    device = torch.device("cpu")
    price = 0.0
    """By how much its pixels are off where something is skipped."""

    def __init__(self, guide: Guide) -> None:
        super().__init__()
        self.guide = (guide,)
        self.sampler = guide.estimator(None)

    def forward(self, bundle: Any) -> dict[str, Tensor]:
        origins, directions = bundle.origins, bundle.directions

        def density(starts: Tensor, ends: Tensor, of_rays: Tensor) -> Tensor:
            middles = origins[of_rays] + directions[of_rays] * (0.5 * (starts + ends))[:, None]
            apart = (middles - torch.tensor(BALL_CENTRE)).norm(dim=-1)
            return 300.0 * (apart < BALL_RADIUS)

        asked = density if self.training else None
        of_rays, starts, ends = self.sampler.sampling(origins, directions, asked, **MARCH)
        sigmas, rays = density(starts, ends, of_rays), len(origins)
        weights = render_weight_from_density(
            starts, ends, sigmas, ray_indices=of_rays, n_rays=rays
        )[0]
        white = accumulate_along_rays(weights, None, of_rays, rays).expand(-1, 3)
        skips = self.guide[0].the_occupancy().threshold > OPEN
        return {"rgb": white + (self.price if skips else 0.0)}


@pytest.fixture
def made(data: Data, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """A host that teaches after its second step, and its run."""
    monkeypatch.setattr(along, "FIRST", 2)
    torch.manual_seed(0)
    guide, run = Guide(), LearningOnly()
    host, run.folder = BallHost(guide), tmp_path
    cameras = data.train_dataset.cameras

    def next_train(step: int) -> Any:
        image = int(torch.randint(len(cameras), ()))
        bundle = cameras.generate_rays(image).flatten()
        bundle = bundle[torch.randperm(len(bundle))[:500]]
        open_guide = Guide()
        open_guide.set_occupancy(bounds_of(guide.the_occupancy()))
        return bundle, {"image": BallHost(open_guide).eval()(bundle)["rgb"]}

    monkeypatch.setattr(data, "next_train", next_train, raising=False)
    monkeypatch.setattr(data, "get_train_rays_per_batch", lambda: 500, raising=False)
    pipeline = SimpleNamespace(datamanager=data, device="cpu", world_size=1)
    teacher = Along(host, guide, CONFIG, pipeline, run)
    teacher.begin()
    return SimpleNamespace(guide=guide, host=host, teacher=teacher, out=tmp_path, pipe=pipeline)


def within_bounds(guide: Guide) -> Tensor:
    """Positions that training rays reach."""
    occupancy = guide.the_occupancy()
    centre, half = occupancy.space.center, occupancy.space.half_extent
    places = centre + half * (2.0 * torch.rand(4000, 3) - 1.0)
    return places[bounds_of(occupancy).occupied(places)]


def test_it_begins_within_the_bounds_and_keeps_all_that_lies_there(made: Any) -> None:
    occupancy = made.guide.the_occupancy()
    assert occupancy.threshold == pytest.approx(OPEN)
    places = within_bounds(made.guide)
    assert len(places) > 1000 and bool(occupancy.occupied(places).all())
    assert not occupancy.occupied(torch.full((1, 3), 1e3)).any()
    assert not list(made.out.iterdir()), "bounds alone are no file to give to others"


def test_its_weights_teach_a_gate_that_keeps_the_ball_and_skips_the_air(made: Any) -> None:
    made.teacher.after_step(0)
    assert made.guide.the_occupancy().threshold == pytest.approx(OPEN)
    made.teacher.after_step(1)
    occupancy = made.guide.the_occupancy()
    left = Occupancy.load(made.out / "occupancy.safetensors")
    assert left.threshold == occupancy.threshold > OPEN
    assert left.report["learned"] == "along" and left.report["empty_fraction"] > 0.3
    assert left.report["step_size"] == MARCH["render_step_size"]  # as a loop of one's own asks
    assert (left.report["step"], left.report["params"]) == (1, left.num_params)
    assert left.report["cone_angle"] == 0.0 < left.report["near"] < left.report["far"]
    on_it = torch.nn.functional.normalize(torch.randn(500, 3), dim=-1) * BALL_RADIUS * 0.97
    on_it = on_it[on_it[:, 2] > 0.0] + torch.tensor(BALL_CENTRE)
    assert float(occupancy.occupied(on_it).float().mean()) > 0.98
    places = within_bounds(made.guide)
    assert float(occupancy.occupied(places).float().mean()) < 0.7
    assert made.host.training and made.guide.listener is None


def test_teaching_leaves_random_numbers_as_they_were(
    made: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    seeded: list[int] = []
    made.teacher.config = replace(CONFIG, sharpening=replace(SMALL, steps=40))
    monkeypatch.setattr(torch.cuda, "manual_seed_all", seeded.append)
    before = torch.get_rng_state()
    made.teacher._teach(1)
    assert made.guide.the_occupancy().threshold > OPEN, "it guides from now on"
    assert torch.equal(torch.get_rng_state(), before) and seeded == []


def test_what_costs_too_much_in_the_image_is_not_followed(made: Any) -> None:
    made.host.price = 0.1
    made.teacher.after_step(0)
    made.teacher.after_step(1)
    assert made.guide.the_occupancy().threshold == pytest.approx(OPEN)
    assert not list(made.out.iterdir())


def test_a_gate_is_measured_at_its_own_threshold_in_a_host_that_still_follows_a_lower_one(
    made: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As where a file is given, and the first measurement comes after the first lesson."""
    guide, errors, followed = made.guide, made.teacher._errors, []

    def noting(*given: Any) -> Tensor:
        followed.append((guide.followed().threshold, guide.the_occupancy().threshold))
        return errors(*given)

    monkeypatch.setattr(made.teacher, "_errors", noting)
    guide.watched.lower = 2.0 * OPEN
    made.teacher._teach(1)
    assert len(followed) > 1 and all(one == other for one, other in followed)


def test_a_gate_leaves_half_of_what_is_not_spent_and_nothing_where_more_is(made: Any) -> None:
    config = made.teacher.config.calibration
    spent = {"lost_surface_mass": None, "image_price_db": 2.0 * config.image_price_db}
    allowed = made.teacher._allowed(spent, last=False)
    assert allowed.lost_surface_mass == 0.5 * config.lost_surface_mass
    assert allowed.image_price_db == config.image_price_db, "no higher than what was promised"
    assert made.teacher._allowed(spent, last=True) == config
    a_quarter = {"lost_surface_mass": 0.25 * config.lost_surface_mass, "image_price_db": -1.0}
    allowed = made.teacher._allowed(a_quarter, last=False)
    assert allowed.lost_surface_mass == pytest.approx(0.625 * config.lost_surface_mass)
    assert allowed.image_price_db == 0.5 * config.image_price_db, "a gain is not spent"


def test_rays_of_several_batches_are_heard_as_one(made: Any, data: Data) -> None:
    bundle = data.train_dataset.cameras.generate_rays(0).flatten()[200:260]
    alone = [made.teacher._hear([some]) for some in (bundle[:40], bundle[40:])]
    both = made.teacher._hear([bundle[:40], bundle[40:]])
    assert [one.rays for one in (*alone, both)] == [40, 20, 60]
    numbers = [one.intervals.ray_indices for one in alone]
    assert torch.equal(both.intervals.ray_indices, torch.cat([numbers[0], numbers[1] + 40]))
    for name in ("mapped", "weights", "kept"):
        parts = [getattr(one, name) for one in alone]
        torch.testing.assert_close(getattr(both, name), torch.cat(parts))
    assert float(both.weights.max()) > 0.5


def test_what_a_host_prunes_is_heard_all_the_same(
    made: Any, data: Data, monkeypatch: pytest.MonkeyPatch
) -> None:
    bundle = data.train_dataset.cameras.generate_rays(0).flatten()
    whole = made.teacher._hear([bundle])
    monkeypatch.setitem(MARCH, "early_stop_eps", 0.5)
    monkeypatch.setitem(MARCH, "alpha_thre", 0.5)
    pruned = made.teacher._hear([bundle])
    assert torch.equal(pruned.mapped, whole.mapped) and torch.equal(pruned.weights, whole.weights)


def test_all_its_gates_together_cost_no_more_than_the_bound(
    made: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    price = [0.03]  # dB; the bound is 0.04

    def errors(*_: Any) -> Tensor:
        skips = made.guide.the_occupancy().threshold > OPEN
        return torch.full((500,), 10.0 ** (0.1 * price[0]) if skips else 1.0)

    monkeypatch.setattr(made.teacher, "_errors", errors)
    for step in range(2):
        made.teacher.after_step(step)
    assert made.guide.the_occupancy().threshold == pytest.approx(OPEN), "half is for later gates"
    made.teacher.run.end = 3
    made.teacher.after_step(2)
    first = made.guide.the_occupancy()
    assert first.threshold > OPEN, "the last gate may spend all of it"
    assert first.report["image_price_db"] == pytest.approx(0.03, abs=1e-3)
    opened = bounds_of(first)  # from which any gate skips more
    for spent, follows in ((0.005, True), (0.03, False)):
        made.guide.set_occupancy(
            opened.with_threshold(OPEN, opened.report | {"image_price_db": spent})
        )
        made.teacher._teach(2)
        assert (made.guide.the_occupancy().threshold > OPEN) == follows


def test_a_new_gate_has_no_figures_of_the_one_before(made: Any) -> None:
    before = made.guide.the_occupancy()
    said = {CALIBRATED_AT: 0.3, CAMERAS_THAT_VOUCH: {"count": 9}, TESTS_LOSE: [0.1]}
    said |= {"lowered": [[100, 0.1]]}
    made.guide.set_occupancy(before.with_threshold(OPEN, before.report | said))
    made.teacher._teach(1)
    report = made.guide.the_occupancy().report
    assert report["threshold"] > OPEN and report["lowered"] == [[100, 0.1]]
    assert not {CALIBRATED_AT, CAMERAS_THAT_VOUCH, TESTS_LOSE} & report.keys()


def test_teaching_takes_its_share_of_the_time(made: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    now, taught = [0.0], []
    monkeypatch.setattr(along, "seconds_now", lambda: now[0])
    made.teacher.began = 0.0

    def teach(step: int) -> None:
        taught.append(step)
        now[0] += 3.0

    monkeypatch.setattr(made.teacher, "_teach", teach)
    for step in range(100):
        now[0] += 1.0
        made.teacher.after_step(step)
    assert taught == [1, 27, 54, 81], "a tenth of the time: after 2 s, 31 s, 61 s and 91 s"


def test_a_run_that_goes_on_teaches_at_its_end(made: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    made.teacher._teach(1)
    run, taught = SimpleNamespace(end=10), list[int]()
    again = Along(made.host, made.guide, CONFIG, made.pipe, run)  # type: ignore[arg-type]
    again.begin()
    assert again.spent == made.guide.the_occupancy().report["train_seconds"] > 0.0
    monkeypatch.setattr(again, "_teach", taught.append)
    for step in (7, 8, 9):
        again.after_step(step)
    assert taught == [9]


def test_a_gate_is_said_to_have_cost_all_the_teaching_until_then(made: Any) -> None:
    made.teacher.spent = 100.0
    made.teacher._teach(1)
    assert made.guide.the_occupancy().threshold > OPEN
    assert 100.0 < made.guide.the_occupancy().report["train_seconds"] < 200.0


@pytest.mark.parametrize("why", ["no densities", "one process", "sharpening.steps 0"])
def test_who_cannot_teach_is_told_what_to_do(made: Any, why: str) -> None:
    host: nn.Module = nn.Linear(1, 1) if why == "no densities" else made.host
    many = SimpleNamespace(**{**vars(made.pipe), "world_size": 2})
    pipeline = many if why == "one process" else made.pipe
    off = LecoModelConfig(sharpening=SharpeningConfig(steps=0))
    config = off if why == "sharpening.steps 0" else CONFIG
    with pytest.raises(InputError, match=f"{why}.*learned at first"):
        Along(host, made.guide, config, pipeline, LearningOnly())


def test_a_price_is_that_of_the_same_rays() -> None:
    dense = torch.rand(4000) + 0.1
    price, error = image_price(1.01 * dense, dense, 0.0)
    assert price == pytest.approx(0.0432, abs=1e-4) and error == pytest.approx(0.0, abs=1e-4)
    noisy, error = image_price(dense[torch.randperm(4000)], dense, 0.0)
    assert abs(noisy) < 1e-4 < error


def test_bounds_outlive_the_gate_that_was_taught(made: Any) -> None:
    places = within_bounds(made.guide)
    for step in range(2):
        made.teacher.after_step(step)
    assert bool(bounds_of(made.guide.the_occupancy()).occupied(places).all())
