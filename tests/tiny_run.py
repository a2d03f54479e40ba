"""A run of `leco-occupancy` on the tiny scene, set up and not trained."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

from leco_plugin.models.gate import GateConfig


def tiny_trainer(scene: Path, outputs: Path, gate: GateConfig, candidates: int) -> Any:
    """Its trainer; the config is saved in the run's folder, as `ns-train` does.

    Args:
        scene: the tiny scene.
        outputs: where the folders of runs are.
        gate: of the model, whose field is as small.
        candidates: of a ray.
    """
    from leco_plugin.method_configs import leco_occupancy

    config: Any = copy.deepcopy(leco_occupancy.config)
    config.output_dir = outputs
    config.experiment_name, config.timestamp, config.vis = "tiny", "run", "tensorboard"
    config.logging.local_writer.enable = False
    config.data = config.pipeline.datamanager.data = scene
    config.pipeline.datamanager.train_num_rays_per_batch = 64
    sizes = config.pipeline.model.sizes
    field = replace(sizes.field, encoding=replace(sizes.field.encoding, log2_table=8))
    config.pipeline.model.sizes = replace(sizes, gate=gate, field=field, candidates=candidates)
    config.save_config()
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    return trainer
