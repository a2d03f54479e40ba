"""The one trained field that teaches all representations, and what they are measured on."""

from __future__ import annotations

import copy
import random
from dataclasses import replace
from pathlib import Path
from pickle import UnpicklingError
from types import SimpleNamespace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from leco_plugin.evaluation.equal_loss import reached_volume
from leco_plugin.models.leco import LecoModel
from leco_plugin.models.losses import widen
from leco_plugin.models.objective import GateLossConfig
from leco_plugin.scenes.input_error import InputError, one_line, require_folder
from leco_plugin.scenes.whole_files import write_whole
from leco_plugin.shrink.evidence import Evidence, gather
from leco_plugin.shrink.sources import Source, held_out, trained_on
from leco_plugin.shrink.teaching import Lesson

FIELD = "field.pt"
RAYS, TAUGHT_RAYS = 8192, 1 << 15
VOLUME_POINTS = 1 << 17


class Ground(NamedTuple):
    """What every representation is taught and measured on."""

    model: LecoModel
    lesson: Lesson
    held_out: Evidence
    """Dense candidates of pixels that nothing was trained on."""
    mapped: Tensor
    """[M, 3] of those candidates, in [-1, 1]."""
    volume: Tensor
    """[P, 3] mapped, spread evenly over what rays of photographs reach of the scene's box: what a
    representation says of other places is nobody's teaching."""


def prepare(data: Path, folder: Path, learn_steps: int) -> Ground:
    """Learns the field, or loads the one that an earlier call left, and renders rays with it.

    Raises:
        InputError: `data` is no folder, or what was left is not of it.
    """
    require_folder("--data", data)
    from leco_plugin.hosts.learn_first import learn_model
    from leco_plugin.method_configs import best_device, leco_occupancy

    config: Any = copy.deepcopy(leco_occupancy.config.pipeline)
    config.datamanager.data = data
    config.model.schedule = replace(config.model.schedule, learn_steps=learn_steps)
    device, stored = best_device(), folder / FIELD
    if not stored.exists():
        manager = _photographs(config, device)
        pipeline = SimpleNamespace(datamanager=manager, device=torch.device(device))
        rays = config.datamanager.train_num_rays_per_batch
        learned = learn_model(config.model, pipeline, rays)
        write_whole(stored, lambda file: torch.save(learned.state_dict(), file))
    # also whoever has learned it begins anew: a manager that has trained gives other rays
    manager = _photographs(config, device)
    dataset = manager.train_dataset
    model: LecoModel = config.model.setup(
        scene_box=dataset.scene_box,
        num_train_data=len(dataset),
        metadata=dataset.metadata,
        device=device,
    ).to(device)
    _load(model, stored)
    return _ground(Source(manager, model.eval()))


def _photographs(config: Any, device: str) -> Any:
    """A data manager; nerfstudio caches images in an order that Python's own generator draws."""
    random.seed(0)
    torch.manual_seed(0)
    return config.datamanager.setup(device=device, test_mode="val")


def _load(model: LecoModel, stored: Path) -> None:
    """Restores the field that an earlier call left.

    Raises:
        InputError: the file is damaged, or does not fit the scene.
    """
    try:
        model.load_state_dict(torch.load(stored, map_location=model.device, weights_only=True))
    except (OSError, RuntimeError, ValueError, KeyError, EOFError, UnpicklingError) as error:
        line = one_line(error, 200)
        raise InputError(
            f"{stored} cannot be used ({line}): name a new folder with --out, or delete {stored} "
            "and the points beside it"
        ) from None


def _ground(source: Source) -> Ground:
    model = source.model
    assert model is not None
    torch.manual_seed(1)  # so that whoever goes on is taught by the same rays
    lesson = lesson_by(source)
    occupancy = model.occupancy().eval()
    measured, _ = gather(source, None, held_out(source, occupancy, RAYS, parts=1)[0])
    if not bool(measured.worth.any()):
        raise InputError(
            "the field shows nothing along held-out rays, so that no loss can be measured: let one "
            "learn longer, with a larger --learn-steps and a new folder at --out"
        )

    volume = reached_volume(model, lesson.mapped, VOLUME_POINTS, seed=5)
    return Ground(model, lesson, measured, _mapped(model, measured.positions), volume)


def lesson_by(source: Source) -> Lesson:
    """What a source's field has to teach along rays that it was trained on, nothing skipped."""
    model = source.model
    assert model is not None
    taught, _ = gather(source, None, trained_on(source, model.occupancy().eval(), TAUGHT_RAYS))
    return lesson_of(_mapped(model, taught.positions), taught, model.config.gate_loss)


def _mapped(model: LecoModel, places: Tensor) -> Tensor:
    return model.space.map(places).clamp(-1.0, 1.0)


def lesson_of(mapped: Tensor, taught: Evidence, losses: GateLossConfig) -> Lesson:
    """The contribution loss with the field's weights, as `leco-occupancy` teaches its gate."""
    rays = taught.ray_indices  # every candidate of each
    wide = widen(taught.weights, rays[1:] == rays[:-1])
    target = (wide / losses.weight_at_full).clamp(max=1.0)
    return Lesson(mapped, losses.emphasis * target, 1.0 - target)
