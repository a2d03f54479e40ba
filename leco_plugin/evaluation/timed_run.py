"""One training run of fixed time or steps in nerfstudio's trainer, and its figures on test images.

Learning an occupancy counts as training time; evaluation does not.
"""

from __future__ import annotations

import copy
import math
import random
import statistics
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.utils import writer
from torch import Tensor

from leco_plugin.evaluation.clock import (
    Budget,
    Clock,
    peak_allocator_bytes,
    peak_process_bytes,
    warm_up,
)
from leco_plugin.evaluation.metrics import decibels, image_metrics, spread_evenly
from leco_plugin.evaluation.queries import GridUpdates, count_queries
from leco_plugin.evaluation.report import finite_or_null
from leco_plugin.hosts.learn_first import FIRST_TIMED, TIMED_STEPS, keep_within
from leco_plugin.learning.schedule import rate_at
from leco_plugin.on_cpu import in_float64
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.learning_data import bundles_of_tests
from leco_plugin.scenes.pixels.held_out_pixels import visible_in_test
from leco_plugin.studio.host_models import run_training, true_colours
from leco_plugin.studio.run_folder import ENDLESS

RAYS_AT_ONCE = 1024
"""Test rays rendered at a time: few, so that an evaluation does not set the peak memory."""
CURVE_RAYS = 8192
"""Test pixels behind each point of a curve."""

PRICES = ("threshold", "empty_fraction", "lost_mass", "lost_surface_mass", "image_price_db")
RECENT = 100
"""Steps by which it is foreseen how many are left."""


@dataclass
class TimedRun:
    """What one run did. Times are in seconds of training, evaluation left out."""

    method: str
    sampler: str
    seed: int
    steps: int = 0
    train_seconds: float = 0.0
    step_seconds: float | None = None
    """Median of a step; if there is ever an occupancy, of the steps with one."""
    learn_seconds: float | None = None
    """Of the training time: until there was an occupancy, or all updates of a grid."""
    freeze_seconds: float | None = None
    """When there was an occupancy."""
    at_freezing: dict[str, Any] | None = None
    """What it cost and saved then, `PRICES` of its report: a host may skip less later on."""
    recoveries: int | None = None
    """How often a collapsed gate was healed; None where a model learns none itself."""
    warming_up: bool | None = None
    """Whether the run ended in the warm-up of a grid, in which all cells are asked."""
    psnr: float = math.nan
    """Of the pixels of all test images together, as the last point of the curve."""
    image_psnr: float | None = None
    """Mean over test images of the PSNR of each, as ns-eval averages it, on the same pixels."""
    ssim: float = math.nan
    flip: float | None = None
    lpips: float | None = None
    samples_per_ray: float = 0.0
    field_queries_per_ray: float = 0.0
    """In rendering; those for pruning samples are counted too."""
    proposal_queries_per_ray: float = 0.0
    gate_queries_per_ray: float = 0.0
    """To a frozen gate, about what its cell cache does not know."""
    train_queries: Counter[str] = field(default_factory=Counter)
    """In all of the training."""
    render_seconds_per_image: float = 0.0
    peak_memory_bytes: int | None = 0
    """Of the allocator on CUDA, of the process elsewhere; None where it may be other work's."""
    peak_process_bytes: int | None = 0
    peak_allocator_bytes: int | None = None
    curve: list[tuple[float, float]] = field(default_factory=list)
    """Seconds of training, and PSNR on test pixels; stored without points that are no number."""

    def to_dict(self) -> dict[str, Any]:
        """JSON values, rounded to what the measurement means; None where there is no number."""
        values = {
            name: round(value, 4) if isinstance(value, float) else value
            for name, value in vars(self).items()
        }
        values["curve"] = [
            [round(seconds, 2), round(psnr, 3)]
            for seconds, psnr in self.curve
            if math.isfinite(psnr)
        ]
        return finite_or_null(values)


def timed_run(
    config: TrainerConfig,
    budget: Budget,
    *,
    sampler: str,
    seed: int = 0,
    curve_points: int = 6,
    images: int = 2,
    on_progress: Callable[[float], None] | None = None,
) -> tuple[TimedRun, Trainer]:
    """Trains until the budget is used and evaluates on the test images.

    The learning rates of all groups fall by `schedule.rate_at` over the budget, whatever the number
    of steps: nerfstudio's schedulers count steps, and a slow method would end with a high rate. A
    host that learns its occupancy first has the full rates until long after its own first step.

    Args:
        config: a method with its data; it is copied, not changed.
        sampler: what to call the sampler in the record.
        curve_points: evaluations, evenly spaced over the budget, the last at its end; 0 leaves
            the PSNR to the caller.
        images: whole test images rendered at the end, for SSIM, FLIP, LPIPS and the rendering
            time; none leaves those out.
        on_progress: called with the share of the budget that is used, after each step.
    Returns:
        The record, and the trainer with its model.
    Raises:
        InputError: the scene has no test image; nothing was trained.
        FloatingPointError: the PSNR at the end is no number.
    """
    trainer = set_up(config, budget, seed)
    manager: Any = trainer.pipeline.datamanager
    if (curve_points or images) and len(manager.eval_dataset) == 0:
        raise InputError("the scene has no test image, on which runs could be compared")
    run = TimedRun(config.method_name or "", sampler, seed)
    model = trainer.pipeline.model
    with count_queries(model) as queries:
        course = _Course(trainer, budget, run, queries, curve_points, on_progress)
        run_training(trainer)
        course.end()
        if curve_points:
            errors = errors_on_rays(trainer, CURVE_RAYS)
            run.psnr = decibels(statistics.fmean(errors))
            if not math.isfinite(run.psnr):
                raise FloatingPointError("it has diverged: the PSNR at its end is no number")
            run.image_psnr = statistics.fmean(map(decibels, errors))
            run.curve.append((run.train_seconds, run.psnr))
        figures = evaluate_images(trainer, images, queries) if images else {}
    for name in figures.keys() - {"psnr"}:
        setattr(run, name, figures[name])
    return run, trainer


def set_up(config: TrainerConfig, budget: Budget, seed: int) -> Trainer:
    """A trainer that logs, saves and evaluates nothing by itself."""
    for sow in (random.seed, np.random.seed, torch.manual_seed):
        sow(seed)
    config = copy.deepcopy(config)
    config.machine.seed = seed
    config.max_num_iterations = budget.steps or ENDLESS
    config.vis = "tensorboard"
    config.steps_per_save = config.steps_per_eval_image = config.steps_per_eval_batch = 0
    config.steps_per_eval_all_images = 0
    config.logging.local_writer.enable = False
    for group in config.optimizers.values():
        group["scheduler"] = None
    config.set_timestamp()
    writer.GLOBAL_BUFFER.clear()
    writer.EVENT_WRITERS.clear()
    trainer: Trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    warm_up(trainer.device)
    return trainer


@dataclass
class _Course:
    """Stands around every step of a run: clock, learning rates, evaluation, the end. Arguments are
    those of `timed_run`, with the record to fill and the counts of queries."""

    trainer: Trainer
    budget: Budget
    run: TimedRun
    queries: Counter[str]
    curve_points: int
    on_progress: Callable[[float], None] | None

    def __post_init__(self) -> None:
        self.clock = Clock()
        self.marks = [(i + 1) / self.curve_points for i in range(self.curve_points - 1)]
        self.step_times: list[float] = []
        self.before_step = self.queries.copy()
        self.share_before = 0.0
        self.model: Any = self.trainer.pipeline.model
        self.rates = [
            (group, group["lr"])
            for optimizer in self.trainer.optimizers.optimizers.values()
            for group in optimizer.param_groups
        ]
        self.updates = GridUpdates(
            self.model, lambda step: self.budget.share(self.clock.now(), step)
        )
        where, around = TrainingCallbackLocation, self.trainer.callbacks
        around.insert(0, TrainingCallback([where.BEFORE_TRAIN_ITERATION], self.before))
        around.append(TrainingCallback([where.BEFORE_TRAIN_ITERATION], self.begun))
        around.append(TrainingCallback([where.AFTER_TRAIN_ITERATION], self.after))

    def before(self, step: int) -> None:
        """Before everything else that happens before a step."""
        share = self.budget.share(self.clock.seconds, step)
        trained = max(0.0, share - self.share_before) / max(1.0 - self.share_before, 1e-9)
        for group, rate in self.rates:
            group["lr"] = rate * rate_at(trained)
        self.before_step = self.queries.copy()
        self.clock.start()

    def begun(self, step: int) -> None:
        """Before a step, after everything else: a host that learns its occupancy first has it."""
        if self._look_for_occupancy() and hasattr(self.model, "leco_guide"):
            self.share_before = self.budget.share(self.clock.now(), step)

    def after(self, step: int) -> None:
        """After everything else that happens after a step."""
        run, clock = self.run, self.clock
        frozen_now = self._look_for_occupancy()
        seconds = clock.stop()
        for kind, count in self.queries.items():
            run.train_queries[kind] += count - self.before_step[kind]
        if frozen_now:
            self.step_times.clear()
        else:
            self.step_times.append(seconds)
        run.steps = step + 1
        self._keep_to_learning_time()
        self._foresee_the_end()
        share = self.budget.share(clock.seconds, run.steps)
        if self.on_progress is not None:
            self.on_progress(share)
        if share >= 1.0:
            self.trainer.stop_training = True
        elif self.marks and share >= self.marks[0]:
            self.marks = [mark for mark in self.marks if mark > share]
            run.curve.append((clock.seconds, psnr_on_rays(self.trainer, CURVE_RAYS)))

    def end(self) -> None:
        """Writes down what is known when the training is over."""
        run = self.run
        run.train_seconds = self.clock.seconds
        run.step_seconds = statistics.median(self.step_times) if self.step_times else None
        if self.updates.grids:
            run.learn_seconds = self.updates.clock.seconds
            run.warming_up = self.updates.warming_up
        run.recoveries = getattr(getattr(self.model, "progress", None), "recoveries", None)
        run.peak_process_bytes = peak_process_bytes()
        run.peak_allocator_bytes = peak_allocator_bytes()
        run.peak_memory_bytes = run.peak_allocator_bytes or run.peak_process_bytes

    def _look_for_occupancy(self) -> bool:
        """Notes when there is an occupancy; returns whether there is one since the last look."""
        mixture = getattr(self.model, "mixture", None)
        frozen = mixture is not None and bool(mixture.frozen)
        guide = getattr(self.model, "leco_guide", None)
        learned = mixture if frozen else getattr(guide, "occupancy", None)
        if self.run.freeze_seconds is not None or learned is None:
            return False
        self.run.freeze_seconds = self.run.learn_seconds = self.clock.now()
        report = getattr(learned, "report", {})
        self.run.at_freezing = {name: report.get(name) for name in PRICES}
        return True

    def _foresee_the_end(self) -> None:
        """For a model that learns itself: how long, and when it sharpens its gate, is its share of
        a run."""
        seconds, steps, config = self.budget.seconds, self.run.steps, self.trainer.config
        mixture = getattr(self.model, "mixture", None)
        if seconds is None or mixture is None:
            return
        config.max_num_iterations = self.budget.steps or ENDLESS
        if self.step_times:
            left = (seconds - self.clock.seconds) / statistics.fmean(self.step_times[-RECENT:])
            foreseen = steps + math.ceil(max(0.0, left))
            config.max_num_iterations = min(config.max_num_iterations, foreseen)

    def _keep_to_learning_time(self) -> None:
        """As a host that learns first does: a model that learns itself freezes in time. Looked at
        once, by the first steps, and from when that time is over."""
        progress, limit = getattr(self.model, "progress", None), self.budget.learn_seconds
        if progress is None or limit is None or self.run.freeze_seconds is not None:
            return
        left = limit - self.clock.seconds
        if left <= 0.0:
            keep_within(progress, 0.0, self.run.steps)
        elif self.run.steps == TIMED_STEPS:
            more = left / statistics.fmean(self.step_times[FIRST_TIMED:])
            keep_within(progress, more, self.run.steps)


def psnr_on_rays(trainer: Trainer, rays: int) -> float:
    """PSNR in dB of the pixels of `errors_on_rays`, all together."""
    return decibels(statistics.fmean(errors_on_rays(trainer, rays)))


def render_rays(model: Any, bundle: Any, at_once: int) -> Tensor:
    """Colours [N, 3] of rays [N], in [0, 1]."""
    parts = [bundle[i : i + at_once] for i in range(0, len(bundle), at_once)]
    return torch.cat([model(part)["rgb"] for part in parts]).clamp(0.0, 1.0)


@torch.no_grad()
def errors_on_rays(trainer: Trainer, rays: int) -> list[float]:
    """Mean squared error of each test image on its share of `rays` pixels, the same at every call,
    less those that a lens or mask hides; `InputError` where all are. Some thousand pixels say as
    much as full images, one of which takes an unguided method minutes on a CPU."""
    pipeline, manager = trainer.pipeline, trainer.pipeline.datamanager
    pipeline.eval()
    dataset: Any = manager.eval_dataset
    numbers, errors = range(len(dataset)), []
    for bundle, colours in bundles_of_tests(manager, numbers, -(-rays // len(dataset))):
        rgb = render_rays(pipeline.model, bundle.to(pipeline.device), RAYS_AT_ONCE)
        truth = true_colours(pipeline.model, colours.to(rgb.device))
        errors.append(float(in_float64((rgb - truth) ** 2).mean()))
    pipeline.train()
    if not errors:
        raise InputError("masks hide all test images, on which runs could be compared")
    return errors


@torch.no_grad()
def evaluate_images(trainer: Trainer, most_images: int, queries: Counter[str]) -> dict[str, float]:
    """Figures over whole test images, evenly chosen; rendering alone is timed. What a lens or mask
    hides counts as rendered right.

    The model has to have rendered before, so that nothing is built on the way.

    Returns:
        Means of what `image_metrics` has for all of these images, of `samples_per_ray`, and of
        `field_queries_per_ray`, `proposal_queries_per_ray` and `gate_queries_per_ray`; and the
        median of `render_seconds_per_image`.
    """
    pipeline, manager = trainer.pipeline, trainer.pipeline.datamanager
    pipeline.eval()
    dataset: Any = manager.eval_dataset
    found: list[dict[str, float]] = []
    clock, times = Clock(), []
    for number in spread_evenly(len(dataset), most_images):
        camera = dataset.cameras[number : number + 1].to(pipeline.device)
        before = queries.copy()
        clock.start()
        outputs = pipeline.model.get_outputs_for_camera(camera)
        times.append(clock.stop())
        predicted = outputs["rgb"].clamp(0.0, 1.0)
        data = dataset.get_data(number)
        truth = true_colours(pipeline.model, data["image"].to(predicted.device))
        pixels = torch.ones(truth.shape[:2]).nonzero()
        shown = visible_in_test(manager, number, data, pixels).view_as(truth[..., :1])
        figures = image_metrics(predicted.where(shown.to(truth.device), truth), truth)
        for kind in ("field", "proposal", "gate"):
            asked = queries[kind] - before[kind]
            figures[f"{kind}_queries_per_ray"] = asked / (predicted.numel() / 3)
        figures["samples_per_ray"] = figures["field_queries_per_ray"]
        for name in ("samples_per_ray", "num_samples_per_ray"):
            if name in outputs:
                figures["samples_per_ray"] = float(outputs[name].float().mean())
        found.append(figures)
    pipeline.train()
    # of a small image there is no LPIPS: a mean without it would be of other images
    names = [name for name in found[0] if all(name in figures for figures in found)]
    means = {name: statistics.fmean(figures[name] for figures in found) for name in names}
    return means | {"render_seconds_per_image": statistics.median(times)}
