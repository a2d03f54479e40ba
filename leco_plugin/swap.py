"""`leco swap`: trains any registered nerfstudio method with its sampler swapped."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import tyro
from nerfstudio.engine.trainer import Trainer, TrainerConfig

from leco_plugin.compat.atomic_trainer import AtomicTrainer
from leco_plugin.compat.data_parallel import DataParallelTrainerConfig
from leco_plugin.compat.dynamic_batch import ClampedDynamicBatchPipelineConfig
from leco_plugin.models.guided import GuidedModelConfig
from leco_plugin.models.guided_start import OccupancyConfig, occupancy_file
from leco_plugin.occupancy import Occupancy
from leco_plugin.scenes.input_error import InputError


def swapped_config(method: str, file: Path, arguments: Sequence[str] = ()) -> TrainerConfig:
    """The config of a registered method with its sampler swapped.

    Args:
        method: name, as `ns-train` knows it.
        file: an occupancy, or the folder of a run that left one.
        arguments: what `ns-train METHOD` would be given.
    Raises:
        InputError: there is no such method, or it is guided or learns occupancy itself.
        ValueError, OSError: there is no such file, or it is no occupancy.
        SystemExit: the arguments are none of the method's; tyro has said why.
    """
    found = occupancy_file(file)
    assert found is not None
    Occupancy.load(found)
    config = tyro.cli(
        tyro.conf.SuppressFixed[tyro.conf.FlagConversionOff[TrainerConfig]],
        default=registered(method),
        args=list(arguments),
        prog=f"leco swap {method} --occupancy {file} --",
    )
    return with_sampler_swapped(config, found)


def registered(method: str) -> TrainerConfig:
    """A copy of the config of a registered method.

    Raises:
        InputError: there is no such method, or its package is not installed.
    """
    from nerfstudio.configs.method_configs import all_methods

    if method not in all_methods:
        raise InputError(f"there is no method {method!r}; there are {', '.join(all_methods)}")
    config = copy.deepcopy(all_methods[method])
    if not isinstance(config, TrainerConfig):
        raise InputError(f"{method!r} is known by name only: its package is not installed")
    return config


def with_sampler_swapped(config: TrainerConfig, file: Path) -> TrainerConfig:
    """The same training with its model guided by an occupancy; the config given is not changed.

    Raises:
        InputError: the model learns or has an occupancy already.
    """
    from leco_plugin.models.leco import LecoModelConfig

    pipeline: Any = copy.deepcopy(config.pipeline)
    host = pipeline.model
    if isinstance(host, GuidedModelConfig | LecoModelConfig):
        raise InputError(
            f"{config.method_name} finds its occupancy itself; swap another method's sampler"
        )
    pipeline.model = GuidedModelConfig(host=host, occupancy=OccupancyConfig(path=file.resolve()))
    if type(config) is TrainerConfig:
        values = {f.name: getattr(config, f.name) for f in fields(config)}
        config = DataParallelTrainerConfig(**values)
    trainer = AtomicTrainer if config._target is Trainer else config._target
    return replace(config, pipeline=clamped(pipeline), _target=trainer)


def clamped(pipeline: Any) -> Any:
    """A pipeline of dynamic batches as one that keeps within bounds; any other as it is."""
    from nerfstudio.pipelines.dynamic_batch import DynamicBatchPipelineConfig

    if type(pipeline) is not DynamicBatchPipelineConfig:
        return pipeline
    values = {f.name: getattr(pipeline, f.name) for f in fields(pipeline) if f.name != "_target"}
    return ClampedDynamicBatchPipelineConfig(**values)


def swap(method: str, file: Path, arguments: Sequence[str] = ()) -> Path:
    """Trains, and returns the folder of the run. Arguments and errors as for `swapped_config`."""
    from nerfstudio.scripts.train import main as train

    config = swapped_config(method, file, arguments)
    train(config)
    return config.get_base_dir()
