"""From a contender to the config of its training run."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.engine.trainer import TrainerConfig

from leco_plugin.chart.contenders.contender import Contender, changed
from leco_plugin.host_configs import guided
from leco_plugin.hosts.guided import GuidedModelConfig
from leco_plugin.method_configs import best_device
from leco_plugin.models.leco_config import LecoModelConfig
from leco_plugin.scenes.photographs import LecoPhotographsDataParserConfig
from leco_plugin.studio.dynamic_batch import clamped
from leco_plugin.swap import registered


def config_of(
    contender: Contender, data: Path, folder: Path, learn_seconds: float | None = None
) -> TrainerConfig:
    """The method with its data, its sampler and its changes.

    Whatever its own habits, it reads the scene as the others do, so that all are asked about the
    same pixels of the same test images.

    Args:
        data: a scene in nerfstudio's format.
        folder: for what the run leaves.
        learn_seconds: most that a host may spend on learning its occupancy first.
    Raises:
        InputError: there is no such method.
        ValueError: it has no such setting.
    """
    config = copy.deepcopy(registered(contender.method))
    config.output_dir, config.experiment_name = folder, "chart"
    config.machine.device_type = best_device()
    config.data = data
    pipeline: Any = clamped(config.pipeline)
    pipeline.datamanager.data = data
    if type(pipeline.datamanager.dataparser) is NerfstudioDataParserConfig:
        pipeline.datamanager.dataparser = LecoPhotographsDataParserConfig()
    if not isinstance(pipeline.model, GuidedModelConfig | LecoModelConfig):
        pipeline.model = guided(pipeline.model)
    model: Any = pipeline.model
    if isinstance(model, GuidedModelConfig) and learn_seconds is not None:
        model = changed(model, "occupancy.seconds", learn_seconds)
    for path, value in contender.changes.items():
        model = changed(model, path, value)
    pipeline.model = model
    config = replace(config, pipeline=pipeline)
    for path, value in contender.settings.items():
        config = changed(config, path, value)
    return config
