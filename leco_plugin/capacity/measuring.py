"""One trained field teaches all representations; what each keeps and loses on the same rays."""

from __future__ import annotations

import copy
import random
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from pickle import UnpicklingError
from types import SimpleNamespace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from leco_plugin.capacity.evidence import RAYS_AT_ONCE, Evidence, gather
from leco_plugin.capacity.search import Candidate, find_threshold
from leco_plugin.capacity.sources import Source, draw_held_out, draw_training_rays
from leco_plugin.evaluation.equal_loss import (
    kept_shares,
    mapped_box,
    reached_volume,
)
from leco_plugin.evaluation.field_grids import largest_in_cells, plain_and_dilated
from leco_plugin.evaluation.inspection import ViewBox, in_parts
from leco_plugin.learning.sharpening import Lesson, lesson_by, round_weights, teach
from leco_plugin.models.gate import GateConfig, occupancy_logit
from leco_plugin.models.leco import LecoModel
from leco_plugin.models.mixture import Mixture
from leco_plugin.models.objective import GateLossConfig
from leco_plugin.occupancy import Precision, gate_precision
from leco_plugin.scenes.input_error import InputError, one_line
from leco_plugin.scenes.whole_files import write_whole

FIELD = "field.pt"
RAYS, TAUGHT_RAYS = 8192, 1 << 15
VOLUME_POINTS = 1 << 17
STEPS = 1000
"""With which each gate is taught. After 300 small ones still keep two to nine times what they keep
after 1000 (docs/decisions.md)."""
VOLUMES = (0.01, 0.015, 0.02, 0.03, 0.04, 0.06, 0.08, 0.11, 0.15, 0.2, 0.3, 0.45)
"""Kept volumes at which the loss is noted."""


class Taught(NamedTuple):
    """What every representation is taught and measured on."""

    mixture: Mixture
    lesson: Lesson
    held_out: Evidence
    """Dense candidates of pixels that nothing was trained on."""
    mapped: Tensor
    """[M, 3] of those candidates, in [-1, 1]."""
    volume: Tensor
    """[P, 3] mapped, spread evenly over the part of the scene's box that rays reach. Elsewhere
    nothing is taught."""


def prepare(data: Path, folder: Path, learn_steps: int) -> Taught:
    """Learns the field, or loads the one that an earlier call left, and renders rays with it.

    Raises:
        InputError: what was left is damaged or of another scene, or the field shows nothing.
    """
    from leco_plugin.hosts.learn_first import learn_model
    from leco_plugin.method_configs import best_device, leco_occupancy

    config: Any = copy.deepcopy(leco_occupancy.config.pipeline)
    config.datamanager.data = data
    config.model.schedule = replace(config.model.schedule, learn_steps=learn_steps)
    device, stored = best_device(), folder / FIELD

    def photographs() -> Any:
        random.seed(0)  # nerfstudio caches images in an order that Python's own generator draws
        torch.manual_seed(0)
        return config.datamanager.setup(device=device, test_mode="val")

    if not stored.exists():
        pipeline = SimpleNamespace(datamanager=photographs(), device=torch.device(device))
        rays = config.datamanager.train_num_rays_per_batch
        learned = learn_model(config.model, pipeline, rays)
        write_whole(stored, lambda file: torch.save(learned.state_dict(), file))
    manager = photographs()  # a manager that has trained would give other rays
    dataset = manager.train_dataset
    model: LecoModel = config.model.setup(
        scene_box=dataset.scene_box,
        num_train_data=len(dataset),
        metadata=dataset.metadata,
        device=device,
    ).to(device)
    try:
        model.load_state_dict(torch.load(stored, map_location=model.device, weights_only=True))
    except (OSError, RuntimeError, ValueError, KeyError, EOFError, UnpicklingError) as error:
        raise InputError(
            f"{stored} cannot be used ({one_line(error, 200)}): name a new folder with --out, or "
            f"delete {stored} and the points beside it"
        ) from None
    return _render_rays(Source(manager, model.eval()), model)


def _render_rays(source: Source, model: LecoModel) -> Taught:
    torch.manual_seed(1)  # the same rays also where the field was loaded
    mixture = model.mixture
    lesson = lesson_of(source, model.config.gate_loss)
    rays = draw_held_out(source, mixture.occupancy().eval(), RAYS, parts=1)[0]
    evidence, _ = gather(mixture, None, rays)
    if not bool(evidence.worth.any()):
        raise InputError(
            "the field shows nothing along held-out rays, so that no loss can be measured: let one "
            "learn longer, with a larger --learn-steps and a new folder at --out"
        )
    volume = reached_volume(mixture, lesson.mapped, VOLUME_POINTS, seed=5)
    mapped = mixture.region.space.map(evidence.positions).clamp(-1.0, 1.0)
    return Taught(mixture, lesson, evidence, mapped, volume)


def lesson_of(source: Source, losses: GateLossConfig) -> Lesson:
    """What a source's field has to teach along rays that it was trained on, nothing skipped."""
    mixture = source.mixture
    assert mixture is not None
    taught = draw_training_rays(source, mixture.occupancy().eval(), TAUGHT_RAYS).rays
    return lesson_by(mixture, taught, losses, seen=0.0, rays_at_once=RAYS_AT_ONCE)


def measure(evidence: Evidence, scores: Tensor, of_volume: Tensor, lost: float) -> dict[str, Any]:
    """What a representation keeps when it loses a given share, and loses at given kept volumes.

    Args:
        evidence: dense candidates.
        scores: [M] of those candidates.
        of_volume: [P] of places spread evenly over what rays reach of the scene's box.
        lost: share of the weight near surfaces.
    """
    volume, candidates = kept_shares(evidence.worth, scores, of_volume, lost)
    total = float(evidence.worth.double().sum())
    losses = [
        float(evidence.worth[scores < find_threshold(of_volume, share)].double().sum()) / total
        for share in VOLUMES
    ]
    return {"kept_volume": volume, "kept_candidates": candidates, "lost_at_volumes": losses}


def measure_gate(taught: Taught, candidate: Candidate, lost: float) -> dict[str, Any]:
    """Teaches a gate and measures it, as it would be stored and asked."""
    assert candidate.gate is not None
    started = time.monotonic()
    score = taught_score(candidate.gate, taught.lesson, taught.mixture.precision)
    scores, of_volume = in_parts(score, taught.mapped), in_parts(score, taught.volume)
    return _row(candidate, started, measure(taught.held_out, scores, of_volume, lost))


def taught_score(
    config: GateConfig, lesson: Lesson, precision: Precision
) -> Callable[[Tensor], Tensor]:
    """The logit of a gate that is taught now, as it would be stored and asked: of mapped positions
    [N, 3], [N]."""
    gate = teach(config, lesson, STEPS, precision)
    round_weights(gate)

    @torch.no_grad()
    def score(mapped: Tensor) -> Tensor:
        with gate_precision(mapped.device.type, precision):
            return occupancy_logit(gate(mapped))

    return score


def measure_grid(taught: Taught, candidate: Candidate, lost: float) -> dict[str, Any]:
    """Teaches a grid and measures it, dilated by a cell where it keeps less so."""
    assert candidate.resolution is not None
    started, box = time.monotonic(), mapped_box(taught.mixture)
    scores = taught_grid(taught.lesson, box, candidate.resolution)
    both = [
        measure(taught.held_out, of_rays, of_volume, lost)
        for of_rays, of_volume in plain_and_dilated(scores, box, taught.mapped, taught.volume)
    ]
    return _row(candidate, started, min(both, key=lambda one: one["kept_volume"]))


def taught_grid(lesson: Lesson, box: ViewBox, cells: int) -> Tensor:
    """Scores [n, n, n] of a grid that the lesson of the gates teaches: a cell has the largest
    target in it."""
    scores = torch.zeros((cells,) * 3, device=lesson.mapped.device)
    return largest_in_cells(scores, box, lesson.mapped, 1.0 - lesson.skip)


def _row(candidate: Candidate, started: float, found: dict[str, Any]) -> dict[str, Any]:
    seconds = round(time.monotonic() - started, 2)
    named = {"family": candidate.family, "size": candidate.size, "bytes": candidate.bytes}
    return {**named, "seconds": seconds, **found}
