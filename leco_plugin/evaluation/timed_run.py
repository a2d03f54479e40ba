"""One training run for a fixed wall-clock time through nerfstudio's own trainer.

Evaluation is off the clock.
"""

from __future__ import annotations

import copy
import math
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.utils import writer
from torch import Tensor

from leco_plugin.evaluation.json_file import finite_or_null
from leco_plugin.evaluation.metrics import image_metrics

CURVE_RAYS = 4096
"""Test pixels behind each point of a curve."""

ENDLESS = 10_000_000
"""Steps that no timed run reaches; the clock ends it."""


@dataclass
class TimedRun:
    """What one run did. Times are in seconds of training, evaluation left out."""

    method: str
    sampler: str
    seed: int
    steps: int = 0
    train_seconds: float = 0.0
    psnr: float = 0.0
    ssim: float = 0.0
    lpips: float | None = None
    samples_per_ray: float = 0.0
    field_queries_per_ray: float = 0.0
    render_seconds_per_image: float = 0.0
    peak_memory_bytes: int = 0
    freeze_seconds: float | None = None
    curve: list[tuple[float, float]] = field(default_factory=list)

    def to_dict(self) -> dict[str, Any]:
        """JSON values, rounded to what the measurement means; None where there is no number."""
        values = dict(vars(self))
        for name in ("train_seconds", "psnr", "ssim", "samples_per_ray", "field_queries_per_ray"):
            values[name] = round(values[name], 4)
        values["curve"] = [[round(seconds, 2), round(psnr, 3)] for seconds, psnr in self.curve]
        return finite_or_null(values)


class Clock:
    """Training time: runs between a step's start and its end, and stands still while evaluating."""

    def __init__(self) -> None:
        self.seconds = 0.0
        self._started = 0.0

    def start(self) -> None:
        synchronize()
        self._started = time.perf_counter()

    def stop(self) -> None:
        synchronize()
        self.seconds += time.perf_counter() - self._started


def synchronize() -> None:
    """Waits for the device, so that a time belongs to what was timed."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def timed_run(
    config: TrainerConfig,
    seconds: float,
    *,
    sampler: str,
    seed: int = 0,
    curve_points: int = 8,
    images: int = 2,
    on_progress: Callable[[float], None] | None = None,
) -> tuple[TimedRun, Trainer]:
    """Trains for `seconds` and evaluates on the test images.

    The learning rates of all groups decay to a tenth over the time, whatever the number of steps;
    nerfstudio's own schedulers count steps, and a slow method would end with a high rate.

    Args:
        config: a method with its data; it is copied, not changed.
        seconds: training time.
        sampler: what to call the sampler in the record.
        curve_points: evaluations along the way, evenly spaced in time.
        images: whole test images rendered at the end, for SSIM, LPIPS and the rendering time.
        on_progress: called with the share of the time that has passed.
    Returns:
        The record, and the trainer with its model.
    """
    torch.manual_seed(seed)
    config = copy.deepcopy(config)
    config.machine.seed = seed
    config.max_num_iterations = ENDLESS
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
    run = TimedRun(config.method_name or "", sampler, seed)
    clock = Clock()
    rates = {
        name: [group["lr"] for group in optimizer.param_groups]
        for name, optimizer in trainer.optimizers.optimizers.items()
    }
    marks = [seconds * (i + 1) / curve_points for i in range(curve_points - 1)]

    def before(step: int) -> None:
        share = min(1.0, clock.seconds / seconds)
        for name, optimizer in trainer.optimizers.optimizers.items():
            for group, rate in zip(optimizer.param_groups, rates[name]):
                group["lr"] = rate * 0.1**share
        clock.start()

    def after(step: int) -> None:
        clock.stop()
        run.steps = step + 1
        if run.freeze_seconds is None and bool(getattr(trainer.pipeline.model, "frozen", False)):
            run.freeze_seconds = round(clock.seconds, 2)
        if on_progress is not None:
            on_progress(min(1.0, clock.seconds / seconds))
        if clock.seconds >= seconds:
            trainer.stop_training = True
        elif marks and clock.seconds >= marks[0]:
            while marks and clock.seconds >= marks[0]:
                marks.pop(0)
            run.curve.append((clock.seconds, psnr_on_rays(trainer, CURVE_RAYS)))

    where = TrainingCallbackLocation
    trainer.callbacks.insert(0, TrainingCallback([where.BEFORE_TRAIN_ITERATION], before))
    trainer.callbacks.append(TrainingCallback([where.AFTER_TRAIN_ITERATION], after))
    run_training(trainer)
    run.train_seconds = clock.seconds
    run.peak_memory_bytes = peak_memory_bytes()
    figures = evaluate_images(trainer, images)
    run.ssim, run.lpips = figures["ssim"], figures.get("lpips")
    run.psnr = psnr_on_rays(trainer, 4 * CURVE_RAYS)
    run.samples_per_ray = figures["samples_per_ray"]
    run.field_queries_per_ray = run.samples_per_ray
    run.render_seconds_per_image = figures["render_seconds_per_image"]
    run.curve.append((clock.seconds, psnr_on_rays(trainer, CURVE_RAYS)))
    return run, trainer


def run_training(trainer: Trainer) -> None:
    """nerfstudio's training loop, without the last checkpoint and its banner."""
    trainer._after_train = lambda: None  # type: ignore[method-assign]
    trainer.train()


@torch.no_grad()
def psnr_on_rays(trainer: Trainer, rays: int, seed: int = 0) -> float:
    """PSNR over pixels spread over all test images: the same pixels at every call.

    A full image of an unguided method takes minutes on a CPU; some thousand pixels say as much.
    """
    pipeline = trainer.pipeline
    pipeline.eval()
    dataset: Any = pipeline.datamanager.eval_dataset
    generator = torch.Generator().manual_seed(seed)
    per_image = -(-rays // len(dataset))
    squared_error, count = 0.0, 0
    for number in range(len(dataset)):
        image = dataset.get_data(number)["image"]
        rows = torch.randint(image.shape[0], (per_image,), generator=generator)
        columns = torch.randint(image.shape[1], (per_image,), generator=generator)
        coords = torch.stack([rows, columns], dim=-1) + 0.5
        camera = dataset.cameras.to("cpu")
        bundle = camera.generate_rays(camera_indices=number, coords=coords).to(pipeline.device)
        rgb = pipeline.model(bundle)["rgb"].clamp(0.0, 1.0)
        truth = true_image(pipeline.model, image[rows, columns], rgb)
        squared_error += float(((rgb - truth) ** 2).sum(dtype=torch.float64))
        count += truth.numel()
    pipeline.train()
    return -10.0 * math.log10(max(squared_error / count, 1e-12))


@torch.no_grad()
def evaluate_images(trainer: Trainer, most_images: int) -> dict[str, float]:
    """Mean figures over whole test images, evenly chosen; rendering alone is timed."""
    pipeline = trainer.pipeline
    pipeline.eval()
    dataset: Any = pipeline.datamanager.eval_dataset
    count = min(most_images, len(dataset))
    chosen = torch.linspace(0, len(dataset) - 1, count).round().long().tolist()
    sums: dict[str, float] = {}
    times = []
    for number in chosen:
        camera = dataset.cameras[number : number + 1].to(pipeline.device)
        clock = Clock()
        clock.start()
        outputs = pipeline.model.get_outputs_for_camera(camera)
        clock.stop()
        times.append(clock.seconds)
        predicted = outputs["rgb"].clamp(0.0, 1.0)
        truth = true_image(pipeline.model, dataset.get_data(number)["image"], predicted)
        figures = image_metrics(predicted, truth)
        for name in ("samples_per_ray", "num_samples_per_ray"):
            if name in outputs:
                figures["samples_per_ray"] = float(outputs[name].float().mean())
        for name, value in figures.items():
            sums[name] = sums.get(name, 0.0) + value / count
    pipeline.train()
    sums.setdefault("samples_per_ray", float("nan"))
    sums["render_seconds_per_image"] = sorted(times)[len(times) // 2]
    return sums


def true_image(model: Any, image: Tensor, like: Tensor) -> Tensor:
    """The truth [H, W, 3] behind the method's own background."""
    image = image.to(like.device)
    renderer = getattr(model, "renderer_rgb", None)
    return renderer.blend_background(image) if renderer is not None else image[..., :3]


def peak_memory_bytes() -> int:
    """Highest memory of this process so far, or on CUDA of the allocator."""
    if torch.cuda.is_available():
        return int(torch.cuda.max_memory_allocated())
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
