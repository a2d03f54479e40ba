"""Claims about a run that is given a time: its rates, its clock, and what it is scored on."""

from __future__ import annotations

import math
import random
import statistics
from collections import Counter
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from torch import Tensor, nn

from leco_plugin.evaluation import clock as clock_module
from leco_plugin.evaluation import timed_run as module
from leco_plugin.evaluation.clock import Budget
from leco_plugin.evaluation.metrics import psnr
from leco_plugin.evaluation.timed_run import (
    TimedRun,
    _Course,
    errors_on_rays,
    evaluate_images,
    psnr_on_rays,
    set_up,
    timed_run,
)
from leco_plugin.learning.run import Progress
from leco_plugin.scenes.input_error import InputError

RATE = 0.01


def course_of(model: Any) -> tuple[_Course, Any]:
    """A run of 100 s of a model, and the group of its optimizer."""
    optimizer = torch.optim.Adam([nn.Parameter(torch.zeros(1))], lr=RATE)
    trainer: Any = SimpleNamespace(
        pipeline=SimpleNamespace(model=model),
        optimizers=SimpleNamespace(optimizers={"fields": optimizer}),
        callbacks=[],
    )
    run = TimedRun("method", "sampler", 0)
    course = _Course(trainer, Budget(100.0), run, Counter(), 0, None)
    return course, optimizer.param_groups[0]


def rate_at(course: _Course, group: Any, seconds: float, step: int) -> float:
    course.clock.seconds = seconds
    course.before(step)
    return float(group["lr"])


def test_rates_of_a_host_that_learns_first_count_from_its_own_first_step(time: Time) -> None:
    host = nn.Linear(1, 1)
    host.leco_guide = nn.Module()
    host.leco_guide.occupancy = None
    course, group = course_of(host)
    assert rate_at(course, group, 0.0, 0) == RATE
    host.leco_guide.occupancy = SimpleNamespace(report={})
    time.now += 40.0  # learning is a part of the first step, which goes on
    course.begun(0)
    assert course.run.learn_seconds == pytest.approx(40.0, abs=1.0)
    assert rate_at(course, group, 84.5, 1) == pytest.approx(RATE, rel=0.02)
    assert rate_at(course, group, 91.0, 100) == pytest.approx(RATE * 0.6, rel=0.02)
    assert rate_at(course, group, 100.0, 200) == 0.0


def test_rates_of_a_model_that_goes_on_with_what_it_learned_count_all_of_its_time() -> None:
    model = nn.Linear(1, 1)
    course, group = course_of(model)
    model.mixture = nn.Module()
    model.mixture.frozen = True
    course.clock.seconds = 40.0
    course.begun(50)
    assert course.run.learn_seconds == pytest.approx(40.0, abs=1.0)
    assert rate_at(course, group, 74.0, 51) == RATE
    assert rate_at(course, group, 90.0, 52) == pytest.approx(RATE * 0.4)


class Time:
    """The seconds that a run counts."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 100.0
        monkeypatch.setattr(clock_module, "seconds_now", lambda: self.now)


@pytest.fixture
def time(monkeypatch: pytest.MonkeyPatch) -> Time:
    return Time(monkeypatch)


class Cameras:
    """Of test pictures: a ray is its picture, row and column."""

    def __getitem__(self, chosen: slice) -> Any:
        return SimpleNamespace(to=lambda device: chosen.start)

    def to(self, device: str) -> Cameras:
        return self

    def generate_rays(self, camera_indices: int, coords: Tensor) -> Tensor:
        return nn.functional.pad(coords, (1, 0), value=camera_indices)


class Pictures:
    """Three test pictures, with pixels that are white."""

    def __init__(self) -> None:
        self.cameras = Cameras()
        self.images = [0.1 + 0.5 * torch.rand(*size, 3) for size in ((6, 8), (8, 6), (7, 9))]
        self.masks: list[Tensor] | None = None
        for image in self.images:
            image[:2] = 1.0

    def __len__(self) -> int:
        return len(self.images)

    def get_data(self, number: int) -> dict[str, Tensor]:
        mask = {} if self.masks is None else {"mask": self.masks[number]}
        return {"image": self.images[number], **mask}


class Renderer(nn.Module):
    """Renders pictures, each with an error and in a time of its own; what is white, whiter than
    white. A ray takes seven questions to the field."""

    errors, seconds, samples = (0.1, 0.2, 0.3), (1.0, 9.0, 2.0), (4.0, 5.0, 9.0)

    def __init__(self, time: Time) -> None:
        super().__init__()
        self.time, self.pictures, self.queries = time, Pictures(), Counter({"field": 11})
        self.rays: list[tuple[int, int, int]] = []
        self.rendered: list[int] = []

    def forward(self, rays: Tensor) -> dict[str, Tensor]:
        assert not self.training
        assert bool((rays[:, 1:] % 1.0 == 0.5).all())  # the middles of pixels
        asked = [(int(number), int(row), int(column)) for number, row, column in rays.tolist()]
        self.rays += asked
        whole = [self.picture(number) for number in range(3)]
        return {"rgb": torch.stack([whole[number][row, column] for number, row, column in asked])}

    def get_outputs_for_camera(self, number: int) -> dict[str, Tensor]:
        assert not self.training
        self.rendered.append(number)
        self.time.now += self.seconds[number]
        rgb = self.picture(number)
        self.queries["field"] += 7 * rgb[..., 0].numel()
        samples = torch.full((*rgb.shape[:2], 1), self.samples[number])
        return {"rgb": rgb, "num_samples_per_ray": samples}

    def picture(self, number: int) -> Tensor:
        return self.pictures.images[number] + self.errors[number]

    def trainer(self) -> Any:
        manager = SimpleNamespace(eval_dataset=self.pictures, train_dataset=None)
        pipeline = SimpleNamespace(model=self, device="cpu", datamanager=manager)
        pipeline.eval, pipeline.train = self.eval, self.train
        return SimpleNamespace(pipeline=pipeline)

    def squared_error(self, number: int, row: int, column: int) -> float:
        """Mean over the colours of a pixel, by a loop."""
        truth = self.pictures.images[number][row, column].tolist()
        shown = [min(value + self.errors[number], 1.0) for value in truth]
        return sum((one - other) ** 2 for one, other in zip(shown, truth)) / 3


def test_pixels_of_all_test_pictures_are_scored_and_always_the_same(time: Time) -> None:
    model = Renderer(time)
    found = psnr_on_rays(model.trainer(), 100)
    errors = [model.squared_error(*ray) for ray in model.rays]
    assert found == pytest.approx(-10.0 * math.log10(statistics.fmean(errors)), abs=1e-4)
    of_images = [statistics.fmean(errors[at : at + 34]) for at in (0, 34, 68)]
    assert errors_on_rays(model.trainer(), 100) == pytest.approx(of_images, rel=1e-4)
    model.rays = model.rays[:102]
    assert Counter(number for number, _, _ in model.rays) == {0: 34, 1: 34, 2: 34}
    assert len(set(model.rays)) > 60 and model.training
    torch.manual_seed(1)
    assert psnr_on_rays(model.trainer(), 100) == found
    assert model.rays[102:] == model.rays[:102]


def test_what_masks_hide_of_test_pictures_is_not_scored(time: Time) -> None:
    model = Renderer(time)
    model.pictures.masks = [torch.ones(*image.shape[:2], 1) > 0 for image in model.pictures.images]
    model.pictures.masks[0][:] = False
    model.pictures.masks[1][:2] = model.pictures.masks[2][:2] = False  # what is white
    assert errors_on_rays(model.trainer(), 300) == pytest.approx([0.2**2, 0.3**2], rel=1e-4)
    hidden = evaluate_images(model.trainer(), 1, model.queries)
    assert hidden["psnr"] == 120.0 and hidden["ssim"] == pytest.approx(1.0)
    model.pictures.masks = [torch.zeros_like(mask) for mask in model.pictures.masks]
    with pytest.raises(InputError, match="masks hide all test images"):
        errors_on_rays(model.trainer(), 300)


@pytest.mark.parametrize(("most", "chosen"), [(9, [0, 1, 2]), (2, [0, 2])])
def test_figures_are_means_over_test_pictures_and_only_rendering_is_timed(
    most: int, chosen: list[int], time: Time, monkeypatch: pytest.MonkeyPatch
) -> None:
    def figures(predicted: Tensor, truth: Tensor) -> dict[str, float]:
        time.now += 100.0
        return {"psnr": psnr(predicted, truth)}

    monkeypatch.setattr(module, "image_metrics", figures)
    model = Renderer(time)
    found = evaluate_images(model.trainer(), most, model.queries)
    of_each = []
    for number in chosen:
        rows, columns, _ = model.pictures.images[number].shape
        places = [(row, column) for row in range(rows) for column in range(columns)]
        error = statistics.fmean(model.squared_error(number, *place) for place in places)
        of_each.append(-10.0 * math.log10(error))
    assert model.rendered == chosen and model.training
    assert found["psnr"] == pytest.approx(statistics.fmean(of_each), abs=1e-4)
    samples = statistics.fmean(model.samples[number] for number in chosen)
    assert found["samples_per_ray"] == pytest.approx(samples)
    assert found["field_queries_per_ray"] == pytest.approx(7.0)
    middle = statistics.median(model.seconds[number] for number in chosen)
    assert found["render_seconds_per_image"] == middle


def test_a_figure_that_is_missing_has_no_mean(time: Time, monkeypatch: pytest.MonkeyPatch) -> None:
    """As LPIPS of a small picture among larger ones."""
    lpips = iter(({"lpips": 0.4}, {}, {"lpips": 0.2}))
    monkeypatch.setattr(module, "image_metrics", lambda *_: {"psnr": 20.0, **next(lpips)})
    model = Renderer(time)
    found = evaluate_images(model.trainer(), 3, model.queries)
    assert "lpips" not in found and found["psnr"] == pytest.approx(20.0)


class Fog(nn.Module):
    """A field that is simply called."""

    def forward(self, positions: Tensor) -> Tensor:
        return positions[..., 0]


class Grid(nn.Module):
    """An occupancy grid whose update takes two seconds."""

    def __init__(self, time: Time) -> None:
        super().__init__()
        self.time = time
        self.register_buffer("occs", torch.zeros(1))

    def update_every_n_steps(self, step: int, warmup_steps: int = 2) -> None:
        self.time.now += 2.0


class Run:
    """A run of a model whose steps take known times; PSNR falls, and looking at it takes long.

    Args:
        seconds: of each step, beside those of `begins` and `ends`, the model's callbacks.
    """

    def __init__(
        self, time: Time, model: Any, seconds: list[float], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        self.time, self.model, self.seconds = time, model, seconds
        self.begins: Callable[[int], None] = lambda step: None
        self.ends: Callable[[int], None] = lambda step: None
        self.psnrs = iter((20.0, 18.0))
        model.field = Fog()
        monkeypatch.setattr(module, "set_up", lambda *_: self.trainer)
        monkeypatch.setattr(module, "run_training", self.train)
        monkeypatch.setattr(module, "errors_on_rays", self.look)
        where = TrainingCallbackLocation
        self.trainer: Any = SimpleNamespace(
            config=SimpleNamespace(max_num_iterations=module.ENDLESS),
            pipeline=SimpleNamespace(
                model=model, datamanager=SimpleNamespace(eval_dataset=Pictures())
            ),
            optimizers=SimpleNamespace(optimizers={}),
            callbacks=[
                TrainingCallback([where.BEFORE_TRAIN_ITERATION], lambda step: self.begins(step)),
                TrainingCallback([where.AFTER_TRAIN_ITERATION], lambda step: self.ends(step)),
            ],
            stop_training=False,
        )

    def train(self, trainer: Any) -> None:
        for step, seconds in enumerate(self.seconds):
            for where in TrainingCallbackLocation:
                if where is TrainingCallbackLocation.AFTER_TRAIN_ITERATION:
                    self.time.now += seconds
                    self.model.field(torch.zeros(5, 3))
                for callback in trainer.callbacks:
                    callback.run_callback_at_location(step, where)
            self.time.now += 1000.0  # saving, and whatever else is not training
            if trainer.stop_training:
                return
        raise AssertionError("the run does not end")

    def look(self, trainer: Any, rays: int) -> list[float]:
        """Errors of two images; of one that is black in both there is hardly any."""
        self.time.now += 1000.0
        self.model.field(torch.zeros(rays, 3))
        return [2.0 * 10.0 ** (-next(self.psnrs) / 10.0), 1e-13]

    def record(
        self, points: int = 2, seconds: float = 40.0, learn_seconds: float | None = None
    ) -> TimedRun:
        config: Any = SimpleNamespace(method_name="method")
        budget = Budget(seconds, learn_seconds=learn_seconds)
        return timed_run(config, budget, sampler="s", curve_points=points, images=0)[0]


@pytest.fixture
def a_run(time: Time, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Run]:
    return lambda model, *seconds: Run(time, model, list(seconds), monkeypatch)


def test_learning_counts_as_time_and_looks_do_not(a_run: Callable[..., Run], time: Time) -> None:
    host = nn.Module()
    host.leco_guide = nn.Module()
    host.leco_guide.occupancy = None
    run = a_run(host, 1.0, 1.0, 1.0, 1.0, 5.0, 1.0, 1.0)

    def learn_first(step: int) -> None:
        if step == 0:
            time.now += 30.0
            host.leco_guide.occupancy = SimpleNamespace(report={"threshold": 0.4})

    run.begins = learn_first
    record = run.record()
    assert (record.steps, record.train_seconds, record.step_seconds) == (6, 40.0, 1.0)
    assert record.learn_seconds == record.freeze_seconds == 30.0
    assert record.at_freezing is not None and record.at_freezing["threshold"] == 0.4
    seconds, psnrs = zip(*record.curve)
    assert seconds == (31.0, 40.0) and psnrs == pytest.approx((20.0, 18.0))
    assert record.psnr == psnrs[-1]
    assert record.image_psnr == pytest.approx((18.0 - 10.0 * math.log10(2.0) + 120.0) / 2)
    assert record.train_queries["field"] == 6 * 5


def test_looks_are_evenly_spaced_over_the_budget(a_run: Callable[..., Run]) -> None:
    run = a_run(nn.Module(), *[4.0] * 10)
    run.psnrs = iter([20.0] * 4)
    assert [seconds for seconds, _ in run.record(points=4).curve] == [12.0, 20.0, 32.0, 40.0]


@pytest.mark.parametrize(("allocator", "peak"), [(None, 5), (3, 3)])
def test_the_peak_memory_is_the_allocators_where_there_is_one(
    allocator: int | None, peak: int, a_run: Callable[..., Run], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "peak_process_bytes", lambda: 5)
    monkeypatch.setattr(module, "peak_allocator_bytes", lambda: allocator)
    assert a_run(nn.Module(), 40.0).record().peak_memory_bytes == peak


def test_points_of_a_curve_that_are_no_number_are_left_out() -> None:
    """A run that ends with a number is stored: JSON knows no other."""
    record = TimedRun("method", "sampler", 0, psnr=20.0, curve=[(1.0, math.nan), (2.0, 20.0)])
    assert record.to_dict()["curve"] == [[2.0, 20.0]]


def test_a_run_without_a_number_has_diverged(a_run: Callable[..., Run]) -> None:
    run = a_run(nn.Module(), 40.0)
    run.psnrs = iter((math.nan,))
    with pytest.raises(FloatingPointError, match="it has diverged"):
        run.record()


def test_a_scene_without_tests_is_refused_first(a_run: Callable[..., Run], time: Time) -> None:
    run = a_run(nn.Module(), 40.0)
    run.trainer.pipeline.datamanager.eval_dataset = []
    with pytest.raises(InputError, match="no test image"):
        run.record()
    assert time.now == 100.0


ENDLESS = module.ENDLESS


@pytest.mark.parametrize(
    ("recent", "frozen_after", "seconds", "ends"),
    [
        # while the gate learns 31 s and 22 s are left for steps of 9 s; guided steps are others,
        # and the first of them leaves 11 s for steps of 2 s each
        (None, range(2, 5), (9, 9, 9, 2, 4, 4, 3), [ENDLESS, 5, 5, ENDLESS, 4 + 6, 5 + 3, 6 + 1]),
        # 33 s and 27 s are left for steps of 6 s, 23 s for those of 5, then 19 s and 15 s for those
        # of 4, and 6 s for those of 6.5
        (2, range(9), (1, 6, 6, 4, 4, 4, 9, 9), [*[ENDLESS] * 2, 8, 8, 9, 10, 10, 8]),
        (None, range(3, 9), (9, 9, 9, 9, 2, 1, 1), None),
    ],
    ids=["learning and guided", "by the latest steps", "after freezing"],
)
def test_a_model_that_learns_itself_knows_its_last_step(
    recent: int | None, frozen_after: range, seconds: Any, ends: Any, a_run: Any, monkeypatch: Any
) -> None:
    monkeypatch.setattr(module, "RECENT", recent or module.RECENT)
    model: Any = nn.Module()
    model.mixture = nn.Module()
    model.mixture.field, model.mixture.frozen = Fog(), False
    run, found = a_run(model, *map(float, seconds)), []

    def freeze(step: int) -> None:
        found.append(run.trainer.config.max_num_iterations)
        model.mixture.frozen = step in frozen_after

    run.ends = freeze
    record = run.record()
    assert ends is None or found == ends
    assert record.steps == len(seconds)
    if ends is None:
        assert (record.freeze_seconds, record.step_seconds) == (36.0, 1.0)


def test_a_model_that_learns_itself_keeps_to_its_learning_time(a_run: Callable[..., Run]) -> None:
    """Of 100 s 45 are left after 15 steps. The first five, which compile, say nothing of others."""
    model: Any = nn.Module()
    model.progress = Progress(learn_steps=2000, configured=2000)
    run, found = a_run(model, *[9.0] * 5, *[1.0] * 10, 145.0), []
    run.ends = lambda step: found.append(model.progress.learn_steps)
    run.record(seconds=200.0, learn_seconds=100.0)
    assert found == [2000] * 15 + [15 + 45]


def test_updates_of_a_grid_are_learning_time(a_run: Callable[..., Run], time: Time) -> None:
    host = nn.Module()
    host.grid = Grid(time)
    run = a_run(host, 18.0, 18.0)
    run.begins = lambda step: host.grid.update_every_n_steps(step=step)
    record = run.record()
    assert (record.train_seconds, record.learn_seconds) == (40.0, 4.0)
    assert record.warming_up is False and record.freeze_seconds is None  # over with the first step


@pytest.mark.parametrize("seed", [0, 3])
def test_a_seed_decides_all_random_numbers(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[float] = []

    def draw() -> None:
        drawn.extend((random.random(), np.random.rand(), float(torch.rand(()))))  # noqa: NPY002

    warm: list[str] = []
    monkeypatch.setattr(module, "warm_up", warm.append)

    class Config(SimpleNamespace):
        def setup(self, **_: Any) -> Any:
            return SimpleNamespace(setup=draw, device="cpu", config=self)

    config: Any = Config(
        machine=SimpleNamespace(seed=42),
        logging=SimpleNamespace(local_writer=SimpleNamespace()),
        pipeline=SimpleNamespace(model=None),
        optimizers={},
        set_timestamp=lambda: None,
    )
    made = set_up(config, Budget(1.0), seed)
    assert (made.config.machine.seed, config.machine.seed) == (seed, 42) and warm == ["cpu"]
    generator = torch.Generator().manual_seed(seed)
    expected = [random.Random(seed).random(), np.random.RandomState(seed).rand()]
    assert drawn == [*expected, float(torch.rand((), generator=generator))]
