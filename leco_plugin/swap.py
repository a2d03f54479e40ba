"""`leco swap`: trains any registered nerfstudio method with its sampler swapped."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import tyro
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.models.base_model import ModelConfig

from leco_plugin.hosts.guided import Codes, GuidedModelConfig
from leco_plugin.hosts.guided_start import OccupancyConfig, load_occupancy, occupancy_file
from leco_plugin.method_configs import LEARNING, ON_GPU, best_device
from leco_plugin.models.sizing.sizes import learning_only
from leco_plugin.names import unknown_name
from leco_plugin.samplers.registry import check_gate, refuse_unknown_options, sampler_spec
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.reading import with_checks
from leco_plugin.studio.dynamic_batch import clamped
from leco_plugin.studio.processes import DataParallelTrainerConfig
from leco_plugin.studio.trainer import AtomicTrainer

LEARNED = "learned-occupancy"
"""Name of the sampler that goes into a host unless another one is asked for."""
NO_OPTIONS: Mapping[str, int | float] = MappingProxyType({})


def swapped_config(
    method: str,
    file: Path | None,
    arguments: Sequence[str] = (),
    sampler: str = LEARNED,
    options: Mapping[str, int | float] = NO_OPTIONS,
    codes: Codes = "small",
    other_scene: bool = False,
    learn_seconds: float | None = None,
) -> TrainerConfig:
    """The config of a registered method with its sampler swapped.

    `ns-train` would be given `method` and `arguments`. `file` is an occupancy, or the folder of a
    run that left one; None learns one first, for a sampler that asks one. `sampler` is a name in
    the registry of samplers, `options` are its own. `codes` is as of `GuidedModelConfig`,
    `other_scene` as of `OccupancyConfig`, whose `seconds` are `learn_seconds`.

    Raises:
        InputError: an occupancy is given, and seconds for learning one, or either of them to a
            sampler that asks none; there is no such method, or it is guided, learns occupancy
            itself or draws no rays; there is no such sampler, or it asks another kind of gate, or
            has no such option; there is no such file, or it is no occupancy; the arguments name a
            config that would replace this one, or no scene.
        SystemExit: the arguments are none of the method's; tyro has said why.
    """
    _check_sampler(sampler, options, file, learn_seconds)
    config = tyro.cli(
        tyro.conf.SuppressFixed[tyro.conf.FlagConversionOff[TrainerConfig]],
        default=registered(method),
        args=list(arguments),
        prog=f"leco swap {method}{'' if file is None else f' --occupancy {file}'} --",
    )
    if config.load_config is not None:
        raise InputError(
            "--load-config would train what that file says, without a swap; a run that was swapped "
            "is trained again with ns-train and its config"
        )
    if config.data is not None and not config.data.exists():
        raise InputError(f"there is no scene {config.data} (--data)")
    asked = {"sampler": sampler, "options": dict(options), "seconds": learn_seconds}
    return with_sampler_swapped(config, file, codes, other_scene=other_scene, **asked)


def _check_sampler(
    sampler: str, options: Mapping[str, int | float], file: Path | None, learn_seconds: float | None
) -> None:
    """InputError as `swapped_config` says, of what is given to a sampler."""
    if file is not None and learn_seconds is not None:
        raise InputError("--occupancy gives what --learn-seconds would learn: leave one out")
    try:
        gate = LEARNING.sizes.gate if file is None else load_occupancy(file).gate.config
        check_gate(sampler, gate)
        refuse_unknown_options(sampler, options)
    except ValueError as error:
        raise InputError(str(error)) from None
    if (file or learn_seconds is not None) and not sampler_spec(sampler).needs_occupancy:
        unused = "leave --occupancy and --learn-seconds out"
        raise InputError(f"the sampler {sampler!r} asks no occupancy: {unused}")


def registered(method: str) -> TrainerConfig:
    """A copy of the config of a registered method, for the device that is there. InputError if
    there is no such method, its package is not installed, or it draws no rays."""
    from nerfstudio.configs.method_configs import all_methods

    if method not in all_methods:
        raise InputError(unknown_name("method", method, all_methods))
    config = copy.deepcopy(all_methods[method])
    if not isinstance(config, TrainerConfig):
        raise InputError(f"{method!r} is known by name only: its package is not installed")
    if isinstance(getattr(config.pipeline, "datamanager", None), FullImageDatamanagerConfig):
        lack = f"{method} draws whole images, not rays, and has no sampler that could be swapped"
        raise InputError(f"{lack}: `leco export FILE` writes points to start splats from")
    if config.machine.device_type == "cuda":
        config.machine.device_type = best_device()  # what nerfstudio's methods take for granted
    return config


def with_sampler_swapped(
    config: TrainerConfig, file: Path | None, codes: Codes = "small", **settings: Any
) -> TrainerConfig:
    """The same training with its model guided by an occupancy, learned first where there is no
    file, with other settings of `OccupancyConfig`; the config given is not changed. InputError if
    the model learns or has an occupancy already, or there is no model."""
    from leco_plugin.models.leco_config import LecoModelConfig

    pipeline: Any = copy.deepcopy(config.pipeline)
    host = getattr(pipeline, "model", None)
    if isinstance(host, GuidedModelConfig):
        option = "learns one first" if file is None else f"--pipeline.model.occupancy.path {file}"
        raise InputError(
            f"{config.method_name} is guided already: ns-train {config.method_name} {option}"
        )
    if isinstance(host, LecoModelConfig):
        raise InputError(
            f"{config.method_name} is no host: it learns the occupancy that guides other methods"
        )
    if not isinstance(host, ModelConfig):
        raise InputError(
            f"{config.method_name} has a pipeline without a model that could be guided"
        )
    path = None if file is None else occupancy_file(file.resolve())
    occupancy = replace(learned_first(), path=path, **settings)
    pipeline.model = GuidedModelConfig(host=host, occupancy=occupancy, codes=codes)
    parser = getattr(getattr(pipeline, "datamanager", None), "dataparser", None)
    if isinstance(parser, DataParserConfig):
        pipeline.datamanager.dataparser = with_checks(parser)
    if type(config) is TrainerConfig:
        config = DataParallelTrainerConfig(**vars(config))
    trainer = AtomicTrainer if config._target is Trainer else config._target
    return replace(config, pipeline=clamped(pipeline), _target=trainer)


def learned_first() -> OccupancyConfig:
    """How an occupancy is learned where a host is given none, on the device that is here."""
    learning = LEARNING if ON_GPU else replace(LEARNING, sizes=learning_only(LEARNING.sizes))
    return OccupancyConfig(learning=learning, rays=4096 if ON_GPU else 1024)
