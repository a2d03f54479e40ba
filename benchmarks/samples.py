"""What becomes of the candidates along a ray: `python benchmarks/samples.py RUN=SCENE ...`.

Of runs of `leco-occupancy`, on their test photographs: how many candidates a ray has, how many are
formed after the coarse question has jumped over empty stretches, how many of those cells leave to
the gate, how many are kept, and how many of these are shaded where rendering ends behind opaque
surfaces; with PSNR and time of either rendering, in turns. Stored in `results/samples.json`.
"""

from __future__ import annotations

import math
import os
import statistics
from collections.abc import Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import checkout  # noqa: F401
import torch
from measured_runs import main
from timing import ratio, time_interleaved

from leco_plugin.capacity.sources import find_source
from leco_plugin.cli_occupancy import occupancy_of
from leco_plugin.evaluation.queries import count_queries
from leco_plugin.models.leco import LecoModel
from leco_plugin.samplers import marching
from leco_plugin.samplers.estimator import LearnedOccupancyEstimator
from leco_plugin.samplers.kernels import VARIABLE
from leco_plugin.studio.host_models import true_colours

IMAGES = 4
"""Test photographs, evenly chosen."""
ROUNDS = 3


@contextmanager
def asked_along(estimator: LearnedOccupancyEstimator) -> Any:
    """Counts what a march asks of an estimator: `coarse` questions and `formed` candidates."""
    count = {"coarse": 0, "formed": 0}
    occupied, near = estimator.questions()
    assert occupied is not None

    def fine(positions: torch.Tensor) -> torch.Tensor:
        count["formed"] += len(positions)
        return occupied(positions)

    def coarse(positions: torch.Tensor, radii: torch.Tensor) -> torch.Tensor:
        assert near is not None
        count["coarse"] += len(positions)
        return near(positions, radii)

    with patch.object(estimator, "questions", lambda: (fine, None if near is None else coarse)):
        yield count


def bundles_of(manager: Any, device: torch.device) -> list[tuple[Any, torch.Tensor]]:
    """Rays and colours of some test photographs."""
    dataset = manager.eval_dataset
    count = min(IMAGES, len(dataset))
    found = []
    for number in torch.linspace(0, len(dataset) - 1, count).round().long().tolist():
        rays = dataset.cameras[number : number + 1].to(device).generate_rays(0, keep_shape=True)
        found.append((rays, dataset.get_data(number)["image"]))
    return found


@torch.no_grad()
def along_rays(model: LecoModel, bundles: Sequence[Any]) -> dict[str, float]:
    """Means over rays of `candidates`, `coarse`, `formed`, `gate` and `kept`."""
    mixture, rule = model.mixture, model.mixture.rule()
    sums = dict.fromkeys(("candidates", "coarse", "formed", "gate", "kept"), 0.0)
    total = 0
    for bundle in bundles:
        flat, at_once = bundle.flatten(), model.config.eval_num_rays_per_chunk
        for first in range(0, len(flat), at_once):
            rays = model.rays_of(flat[first : first + at_once])
            along = marching.Rays(*rays[:4])
            total += len(rays.origins)
            sums["candidates"] += len(marching.march(along, rule)[0])
            estimator = mixture.estimator()
            in_torch = patch.dict(os.environ, {VARIABLE: "native"})  # C asks the same, uncounted
            with in_torch, asked_along(estimator) as count, count_queries(model) as queries:
                kept = estimator.march(along, rule)
            sums["kept"] += len(kept[0])
            sums["gate"] += queries["gate"]
            for name, asked in count.items():
                sums[name] += asked
    return {name: value / max(total, 1) for name, value in sums.items()}


@torch.no_grad()
def rendered(
    model: LecoModel, pictures: Sequence[tuple[Any, torch.Tensor]], front: bool
) -> tuple[float, float]:
    """PSNR of test photographs, and how many samples a ray of them are shaded."""
    model.config.front_to_back = front
    squares, values, rays = 0.0, 0, 0
    with count_queries(model) as queries:
        for bundle, image in pictures:
            rgb = model.get_outputs_for_camera_ray_bundle(bundle)["rgb"].clamp(0.0, 1.0)
            truth = true_colours(model, image.to(rgb.device))
            squares += float((rgb - truth).square().sum(dtype=torch.float64))
            values, rays = values + truth.numel(), rays + rgb.shape[0] * rgb.shape[1]
    return -10.0 * math.log10(max(squares / values, 1e-12)), queries["field"] / rays


def row_of(run: Path, data: Path) -> dict[str, Any]:
    """The figures of one run."""
    source = find_source(occupancy_of(run), data)
    model = source.model
    if model is None or not bool(model.mixture.frozen):
        raise SystemExit(f"{run} is no run of leco-occupancy that has frozen its gate")
    pictures = bundles_of(source.manager, model.device)
    every, front = (rendered(model, pictures, front) for front in (False, True))
    timings = time_interleaved(
        {
            "all": lambda: rendered(model, pictures[:1], False),
            "front": lambda: rendered(model, pictures[:1], True),
        },
        ROUNDS,
    )
    return {
        **along_rays(model, [bundle for bundle, _ in pictures]),
        "shaded": every[1],
        "psnr": every[0],
        "shaded_from_the_front": front[1],
        "psnr_from_the_front": front[0],
        "seconds": statistics.median(timings["all"]),
        "time_from_the_front": ratio(timings, "front", "all"),
    }


if __name__ == "__main__":
    main(row_of, "samples")
