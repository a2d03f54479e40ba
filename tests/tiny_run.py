"""A run of `leco-occupancy` on the tiny scene, set up and not trained."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

from leco_plugin.models.gate import GateConfig


def tiny_config(scene: Path, outputs: Path, candidates: int) -> Any:
    """Its config.

    Args:
        scene: the tiny scene.
        outputs: where the folders of runs are.
        candidates: of a ray.
    """
    from leco_plugin.method_configs import leco_occupancy

    config: Any = copy.deepcopy(leco_occupancy.config)
    config.output_dir = outputs
    config.experiment_name, config.timestamp, config.vis = "tiny", "run", "tensorboard"
    config.logging.local_writer.enable = False
    config.data = config.pipeline.datamanager.data = scene
    config.pipeline.datamanager.train_num_rays_per_batch = 64
    model = config.pipeline.model
    field = replace(model.sizes.field, encoding=replace(model.sizes.field.encoding, log2_table=8))
    model.sizes = replace(model.sizes, field=field, candidates=candidates)
    return config


def tiny_trainer(scene: Path, outputs: Path, gate: GateConfig, candidates: int) -> Any:
    """Its trainer; the config is saved in the run's folder, as `ns-train` does.

    Args:
        scene, outputs, candidates: as of `tiny_config`.
        gate: of the model, whose field is as small.
    """
    config = tiny_config(scene, outputs, candidates)
    model = config.pipeline.model
    model.sizes = replace(model.sizes, gate=gate)
    config.save_config()
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    return trainer
