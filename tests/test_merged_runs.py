"""A run whose field has lost experts goes on from its checkpoint as if it had not been stopped."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from nerfstudio.engine.callbacks import TrainingCallbackLocation as Where
from tiny_run import tiny_config

from leco_plugin.learning import history
from leco_plugin.learning.freezing import FIELD_FILE, field_at_freezing
from leco_plugin.learning.merging import MergingConfig
from leco_plugin.models import mixture
from leco_plugin.studio.run_folder import drop_missing_parameters
from leco_plugin.studio.trainer import AtomicTrainer


def trainer_of(scene: Path, folder: Path, load_from: Path | None = None) -> AtomicTrainer:
    config = tiny_config(scene, folder, candidates=32)
    model = config.pipeline.model
    model.schedule = replace(model.schedule, learn_steps=4, learn_share=0.0)
    model.calibration = replace(model.calibration, rays=64, recheck_rays=0)
    model.merging = MergingConfig(1e3, rays=64)  # whatever it costs
    config.load_dir = load_from
    config.max_num_iterations = 100
    torch.manual_seed(0)
    trainer = config.setup(local_rank=0, world_size=1)
    assert isinstance(trainer, AtomicTrainer)
    trainer.setup()
    return trainer


def take_steps(trainer: AtomicTrainer, first: int, end: int) -> None:
    """Steps with their callbacks, as nerfstudio's loop takes them."""
    for step in range(first, end):
        torch.manual_seed(step)
        trainer.step = step
        for callback in trainer.callbacks:
            callback.run_callback_at_location(step, Where.BEFORE_TRAIN_ITERATION)
        trainer.train_iteration(step)
        for callback in trainer.callbacks:
            callback.run_callback_at_location(step, Where.AFTER_TRAIN_ITERATION)


def test_it_is_frozen_merged_saved_and_resumed(
    tiny_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(history, "PROBES", 256)
    monkeypatch.setattr(mixture, "LearnedOccupancyEstimator", without_cells)
    first = trainer_of(tiny_scene, tmp_path / "first")
    model = first.pipeline.model.mixture
    model.estimator()  # of a gate that is not frozen: nobody's afterwards
    take_steps(first, 0, 4)
    assert model.estimator().occupancy.threshold == float(model.threshold)
    assert not any(parameter.requires_grad for parameter in model.gate.parameters())
    assert bool(model.frozen) and int(model.field.experts.left.sum()) == 1
    optimizer: Any = first.optimizers.optimizers["field"]
    there = {id(parameter) for parameter in model.field.parameters()}
    assert {id(p) for g in optimizer.param_groups for p in g["params"]} <= there
    assert {id(p) for p in optimizer.state} <= there
    frozen = field_at_freezing(model, first.base_dir)
    assert frozen is not None and bool(frozen.field.experts.left.all())

    take_steps(first, 4, 5)
    first.save_checkpoint(4)
    second = trainer_of(tiny_scene, tmp_path / "second", first.checkpoint_dir)
    again = second.pipeline.model.mixture
    assert not any(parameter.requires_grad for parameter in again.gate.parameters())
    state = again.state_dict()
    for name, value in model.state_dict().items():
        if isinstance(value, torch.Tensor):
            assert torch.equal(state[name], value), name
    kept = [list(one.optimizers.optimizers["field"].state.values()) for one in (first, second)]
    for ours, theirs in zip(*kept, strict=True):
        assert all(torch.equal(ours[name], theirs[name]) for name in ours)
    assert (second.base_dir / FIELD_FILE).read_bytes() == (first.base_dir / FIELD_FILE).read_bytes()
    take_steps(second, 5, 6)
    drop_missing_parameters(
        second.optimizers, again.parameter_groups()
    )  # nothing is left to forget
    assert len(optimizer.state) == len(second.optimizers.optimizers["field"].state)


def without_cells(occupancy: Any) -> Any:
    from leco_plugin.samplers.estimator import LearnedOccupancyEstimator

    return LearnedOccupancyEstimator(occupancy, cache_bytes=0)
