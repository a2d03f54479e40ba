"""Whether sparse points shown to the gate before the first step pay: `python benchmarks/prior.py`.

Gates that learn with and without the prior are asked, as they learn, about the same samples:
those of the dense rendering of a field trained before, on held-out rays. Each keeps a fixed share
of them, its likeliest; what is lost is the reference's weight near surfaces on the others. Seconds
are of the processor, learning steps and prior only.
"""

from __future__ import annotations

import copy
import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from nerfstudio.engine.callbacks import TrainingCallbackAttributes

from leco_plugin.evaluation.report import describe_code, describe_machine, made_by
from leco_plugin.method_configs import leco_occupancy
from leco_plugin.models.compute.optimizers import RATES, FusedAdamConfig
from leco_plugin.models.freezing.calibration import Reference
from leco_plugin.models.freezing.held_out_rendering import calibration_rays, dense_reference
from leco_plugin.models.gate import occupancy_from_logits
from leco_plugin.models.learning.lifecycle import Lifecycle
from leco_plugin.models.learning.phases import ScheduleConfig
from leco_plugin.models.learning.prior import PriorConfig
from leco_plugin.models.leco import LecoModel
from leco_plugin.models.rendering import Rays, mapped_middles
from leco_plugin.occupancy import gate_precision


@dataclass
class Options:
    """Settings of the benchmark."""

    data: tuple[Path, ...]
    """Scenes with sparse points, in nerfstudio's format."""
    seeds: tuple[int, ...] = (0, 1)
    """Of the gates that are compared; the reference has one of its own."""
    steps: int = 120
    """Learning steps."""
    steps_per_look: int = 10
    """Steps between two looks at a gate."""
    prior_steps: int = 60
    """Steps of the prior."""
    kept: tuple[float, ...] = (0.5, 0.3, 0.2)
    """Shares of the reference's samples that each gate may keep."""
    lost: float = 1e-3
    """Lost surface mass up to which seconds are counted."""
    rays: int = 2048
    """Held-out rays of the reference."""
    out: Path = Path(__file__).parent / "results" / "prior.json"
    """Where the figures go."""


def lost_when_keeping(weights: torch.Tensor, scores: torch.Tensor, kept: float) -> float:
    """Share of the weights [M] on samples that are not among the likeliest share `kept`."""
    order = scores.argsort(descending=True)
    first_lost = round(kept * len(order))
    return float(weights[order[first_lost:]].sum() / weights.sum().clamp(min=1e-12))


def seconds_until(curve: list[list[float]], lost: float, column: int = 1) -> float | None:
    """Seconds (column 0) after which a column stays at or below `lost`; None is never."""
    above = [i for i, row in enumerate(curve) if row[column] > lost]
    first = above[-1] + 1 if above else 0
    return curve[first][0] if first < len(curve) else None


def run(
    pipeline: Any, options: Options, seed: int, prior: int, references: Any
) -> tuple[LecoModel, list[list[float]]]:
    """Trains one model to the end of the first phase, without freezing it; looks on the way.

    Args:
        references: rays and dense renderings by another field; None for that field itself.
    Returns:
        The model, and at each look seconds, then the lost surface mass for each share kept.
    """
    torch.manual_seed(seed)
    config = copy.deepcopy(leco_occupancy.config.pipeline.model)
    config.schedule = ScheduleConfig(freeze=False, learn_steps=options.steps)
    config.prior = PriorConfig(steps=prior)
    manager = pipeline.datamanager
    dataset = manager.train_dataset
    model: Any = config.setup(
        scene_box=dataset.scene_box, num_train_data=len(dataset), metadata=dataset.metadata
    )
    model.train()
    started = time.process_time()
    lifecycle = Lifecycle(model, TrainingCallbackAttributes(None, None, pipeline, None))
    spent = time.process_time() - started
    groups = model.get_param_groups()
    optimizers = [FusedAdamConfig(lr=RATES[name]).setup(group) for name, group in groups.items()]
    curve = [[round(spent, 2), *look(model, references, options.kept)]] if references else []
    for step in range(options.steps):
        started = time.process_time()
        lifecycle.before_step(step)
        bundle, batch = manager.next_train(step)
        losses = model.get_loss_dict(model(bundle), batch)
        for optimizer in optimizers:
            optimizer.zero_grad(set_to_none=True)
        torch.stack(list(losses.values())).sum().backward()
        for optimizer in optimizers:
            optimizer.step()
        spent += time.process_time() - started
        if references and (step + 1) % options.steps_per_look == 0:
            curve.append([round(spent, 2), *look(model, references, options.kept)])
    return model, curve


@torch.no_grad()
def look(
    model: LecoModel, references: list[tuple[Rays, Reference]], kept: tuple[float, ...]
) -> list[float]:
    """Lost surface mass of a model's gate on a reference, for each share kept."""
    weights, scores = [], []
    for rays, reference in references:
        mapped = mapped_middles(model.space, rays, reference.intervals)
        with gate_precision(model.device.type, model.precision):
            score = occupancy_from_logits(model.gate(mapped))
        counted = ~reference.always_kept
        weights.append((reference.weights * reference.near_surface)[counted])
        scores.append(score[counted])
    together = torch.cat(weights), torch.cat(scores)
    return [round(lost_when_keeping(*together, share), 6) for share in kept]


@torch.no_grad()
def references_of(model: LecoModel, manager: Any, rays: int) -> list[tuple[Rays, Reference]]:
    """Dense renderings of held-out rays."""
    model.eval()
    all_rays, _ = calibration_rays(model, manager)
    chunks = [
        Rays._make(None if part is None else part[i : i + 512] for part in all_rays)
        for i in range(0, min(rays, len(all_rays.origins)), 512)
    ]
    return [(chunk, dense_reference(model, chunk)) for chunk in chunks]


def compare(data: Path, options: Options) -> list[dict[str, Any]]:
    """The runs of one scene."""
    config: Any = copy.deepcopy(leco_occupancy.config.pipeline)
    config.datamanager.data = data
    pipeline = config.setup(device="cpu")
    reference, _ = run(pipeline, options, seed=100, prior=0, references=None)
    references = references_of(reference, pipeline.datamanager, options.rays)
    rows = []
    for seed in options.seeds:
        for prior in (0, options.prior_steps):
            _, curve = run(pipeline, options, seed, prior, references)
            row = {
                "scene": data.name,
                "seed": seed,
                "prior_steps": prior,
                "seconds": [
                    seconds_until(curve, options.lost, column + 1)
                    for column in range(len(options.kept))
                ],
                "curve": curve,
            }
            print(json.dumps(row), flush=True)
            rows.append(row)
    return rows


def main(options: Options) -> None:
    code = describe_code()  # before anything is measured
    rows = [row | made_by(code) for data in options.data for row in compare(data, options)]
    results = {
        "format": 1,
        "machine": describe_machine(),
        "kept": options.kept,
        "lost_surface_mass": options.lost,
        "steps": options.steps,
        "runs": rows,
    }
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main(tyro.cli(Options))
