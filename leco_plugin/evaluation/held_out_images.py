"""Figures of a trained model on the test images: PSNR on pixels of all, everything else on some."""

from __future__ import annotations

import math
import statistics
from typing import Any

import torch
from nerfstudio.engine.trainer import Trainer

from leco_plugin.evaluation.clock import Clock
from leco_plugin.evaluation.field_queries import FieldQueries
from leco_plugin.evaluation.metrics import image_metrics
from leco_plugin.scenes.input_error import InputError
from leco_plugin.studio.host_models import true_colours

RAYS_AT_ONCE = 1024
"""Of pixels spread over the images: few, so that looking at a run does not set its peak memory."""


@torch.no_grad()
def psnr_on_rays(trainer: Trainer, rays: int, seed: int = 0) -> float:
    """PSNR over pixels spread over all test images: the same pixels at every call.

    A full image of an unguided method takes minutes on a CPU; some thousand pixels say as much.
    """
    pipeline = trainer.pipeline
    pipeline.eval()
    dataset: Any = pipeline.datamanager.eval_dataset
    if len(dataset) == 0:
        raise InputError("the scene has no test image, on which runs could be compared")
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
        parts = [bundle[i : i + RAYS_AT_ONCE] for i in range(0, per_image, RAYS_AT_ONCE)]
        rgb = torch.cat([pipeline.model(part)["rgb"] for part in parts]).clamp(0.0, 1.0)
        truth = true_colours(pipeline.model, image[rows, columns].to(rgb.device))
        squared_error += float(((rgb - truth) ** 2).sum(dtype=torch.float64))
        count += truth.numel()
    pipeline.train()
    return -10.0 * math.log10(max(squared_error / count, 1e-12))


@torch.no_grad()
def evaluate_images(trainer: Trainer, most_images: int, queries: FieldQueries) -> dict[str, float]:
    """Figures over whole test images, evenly chosen; rendering alone is timed.

    Args:
        trainer: with a model that has rendered before, so that nothing is built on the way.
        most_images: fewer where there are fewer.
        queries: what the model's fields are asked, counted while this lasts.
    Returns:
        Means of `psnr`, `ssim`, `lpips` (absent without its network), `samples_per_ray`,
        `field_queries_per_ray`, `proposal_queries_per_ray`, `gate_queries_per_ray`; the median of
        `render_seconds_per_image`.
    """
    pipeline = trainer.pipeline
    pipeline.eval()
    dataset: Any = pipeline.datamanager.eval_dataset
    count = min(most_images, len(dataset))
    chosen = torch.linspace(0, len(dataset) - 1, count).round().long().tolist()
    sums: dict[str, float] = {}
    times = []
    for number in chosen:
        camera = dataset.cameras[number : number + 1].to(pipeline.device)
        before, clock = queries.copy(), Clock()
        clock.start()
        outputs = pipeline.model.get_outputs_for_camera(camera)
        times.append(clock.stop())
        predicted = outputs["rgb"].clamp(0.0, 1.0)
        image = dataset.get_data(number)["image"].to(predicted.device)
        truth = true_colours(pipeline.model, image)
        figures = image_metrics(predicted, truth)
        asked, pixels = queries.since(before), predicted.numel() / 3
        figures["field_queries_per_ray"] = asked.field / pixels
        figures["proposal_queries_per_ray"] = asked.proposal / pixels
        figures["gate_queries_per_ray"] = asked.gate / pixels
        figures["samples_per_ray"] = figures["field_queries_per_ray"]
        for name in ("samples_per_ray", "num_samples_per_ray"):
            if name in outputs:
                figures["samples_per_ray"] = float(outputs[name].float().mean())
        for name, value in figures.items():
            sums[name] = sums.get(name, 0.0) + value / count
    pipeline.train()
    return sums | {"render_seconds_per_image": statistics.median(times)}
