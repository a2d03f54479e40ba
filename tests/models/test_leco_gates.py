"""`leco-occupancy` learns, freezes and saves a gate on any kind of features."""

from __future__ import annotations

import copy
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, get_args

import pytest
import torch
from nerfstudio.engine.callbacks import TrainingCallbackAttributes, TrainingCallbackLocation

from leco_plugin.learning.calibration import CalibrationConfig
from leco_plugin.learning.freezing import FILE_NAME
from leco_plugin.learning.schedule import ScheduleConfig
from leco_plugin.method_configs import leco_occupancy
from leco_plugin.models.encodings import EncodingConfig, Kind
from leco_plugin.models.field import FieldConfig
from leco_plugin.models.gate import GateConfig
from leco_plugin.models.hmoe import HMoEConfig
from leco_plugin.models.leco import LecoModel
from leco_plugin.models.leco_config import LecoModelConfig
from leco_plugin.models.sizing.sizes import Sizes
from leco_plugin.occupancy import Occupancy
from leco_plugin.samplers.estimator import LearnedOccupancyEstimator
from leco_plugin.samplers.registry import build_estimator

LEARN_STEPS = 8


def sizes_of(kind: Kind) -> Sizes:
    """As small as still learns, with a gate on features of this kind."""
    encoding = EncodingConfig(kind, levels=2, log2_table=8, coarsest=4, finest=8, plane_cells=8)
    return Sizes(
        gate=GateConfig(encoding, width=8, layers=1, scene_experts=2),
        field=FieldConfig(
            EncodingConfig("hash", levels=4, log2_table=10), HMoEConfig(2, width=16, layers=1)
        ),
        learn_candidates=16,
        candidates=32,
    )


def model_of(kind: Kind) -> LecoModel:
    return LecoModel(LecoModelConfig(sizes=sizes_of(kind)), scene_box=None, num_train_data=2)  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", get_args(Kind))
def test_every_parameter_is_in_one_group_and_the_tables_of_field_and_gate_in_one(kind) -> None:
    model = model_of(kind)
    groups = model.get_param_groups()
    listed = [id(parameter) for group in groups.values() for parameter in group]
    assert len(listed) == len(set(listed))
    assert set(listed) == {
        id(p) for p in model.parameters() if p is not model.device_indicator_param
    }
    tables = [*model.mixture.field.encoding.parameters(), *model.mixture.gate.encoding.parameters()]
    assert {id(p) for p in groups["encoding"]} == {id(p) for p in tables}


def test_a_gate_that_no_file_could_hold_is_refused_before_it_is_built() -> None:
    sizes = replace(sizes_of("vm"), gate=GateConfig(EncodingConfig("vm", plane_cells=4096)))
    with pytest.raises(ValueError, match="a gate on vm features of these sizes holds"):
        LecoModel(LecoModelConfig(sizes=sizes), scene_box=None, num_train_data=2)  # type: ignore[arg-type]


def pipeline_of(kind: Kind, scene: Path) -> tuple[Any, Any]:
    """A pipeline on a scene, and what its trainer would call around each step."""
    config = copy.deepcopy(leco_occupancy.config)
    manager = config.pipeline.datamanager
    manager.data, manager.train_num_rays_per_batch = scene, 128
    manager.dataparser.downscale_factor = 1  # else nerfstudio leaves an image open to look at it
    model = config.pipeline.model
    model.sizes = sizes_of(kind)
    model.schedule = ScheduleConfig(learn_steps=LEARN_STEPS, steps_per_check=4)
    model.calibration = CalibrationConfig(rays=128)
    pipeline = config.pipeline.setup(device="cpu", test_mode="val")
    attributes = TrainingCallbackAttributes(None, None, pipeline, None)  # type: ignore[arg-type]
    return pipeline, pipeline.get_training_callbacks(attributes)


@pytest.mark.parametrize("kind", ["hash", "vm", "k-planes", "grid"])
def test_a_gate_on_any_features_is_learned_frozen_and_saved(
    kind, tiny_scene, tmp_path, monkeypatch
) -> None:
    torch.manual_seed(0)
    without_cache = partial(LearnedOccupancyEstimator, cache_bytes=0)  # seconds to build
    monkeypatch.setattr("leco_plugin.models.mixture.LearnedOccupancyEstimator", without_cache)
    pipeline, callbacks = pipeline_of(kind, tiny_scene)
    model = pipeline.model.train()
    groups = model.get_param_groups()
    optimizer = torch.optim.Adam([{"params": group} for group in groups.values()], lr=1e-2)
    first = [table.detach().clone() for table in model.mixture.gate.encoding.parameters()]
    for step in range(LEARN_STEPS + 2):
        for call in callbacks:
            call.run_callback_at_location(step, TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
        _, losses, _ = pipeline.get_train_loss_dict(step)
        optimizer.zero_grad()
        sum(losses.values()).backward()
        optimizer.step()
        if step == 0:
            tables = list(model.mixture.gate.encoding.parameters())
            assert all(bool(table.grad.any()) for table in tables)
            assert not any(torch.equal(table, before) for table, before in zip(tables, first))
        for call in callbacks:
            call.run_callback_at_location(step, TrainingCallbackLocation.AFTER_TRAIN_ITERATION)
        if step == LEARN_STEPS - 1:
            assert bool(model.mixture.frozen)
            at_freezing = [table.detach().clone() for table in tables]
    assert all(torch.equal(table, before) for table, before in zip(tables, at_freezing))
    model.mixture.occupancy().save(tmp_path / FILE_NAME)
    occupancy = Occupancy.load(tmp_path / FILE_NAME)
    estimator = build_estimator(f"learned-occupancy-{kind}", occupancy=occupancy, cache_bytes=0)
    positions = torch.rand(1000, 3) - 0.5
    assert torch.equal(estimator.occupied(positions), model.mixture.occupancy().occupied(positions))


def test_a_frozen_run_that_is_resumed_with_more_learn_steps_does_not_learn_again(
    tiny_scene: Path,
) -> None:
    pipeline, _ = pipeline_of("frequency", tiny_scene)
    model, attributes = pipeline.model, TrainingCallbackAttributes(None, None, pipeline, None)  # type: ignore[arg-type]
    model.mixture.freeze(0.5, {})
    model.config.schedule = replace(model.config.schedule, learn_steps=100 * LEARN_STEPS)
    pipeline.get_training_callbacks(attributes)
    assert model.progress.learn_steps == LEARN_STEPS  # from which it follows what is learned from
    model.mixture.reopen()
    pipeline.get_training_callbacks(attributes)
    assert model.progress.learn_steps == 100 * LEARN_STEPS
