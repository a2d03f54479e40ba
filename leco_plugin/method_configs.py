"""The methods that `ns-train` finds. Any ns-* command imports this, so it stays light."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import torch
from nerfstudio.configs.base_config import MachineConfig, ViewerConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig
from nerfstudio.plugins.types import MethodSpecification

from leco_plugin.learning.schedule import RATES, ScheduleConfig
from leco_plugin.models.leco_config import FusedAdamConfig, LecoModelConfig
from leco_plugin.models.sizing.sizes import PAPER, automatic, sizes_for
from leco_plugin.scenes.data_manager import LecoDataManagerConfig
from leco_plugin.scenes.photographs import LecoPhotographsDataParserConfig
from leco_plugin.scenes.pixels.known_distances import KnownDistancePixelSamplerConfig
from leco_plugin.studio.commands import render_images_without_ffmpeg, show_one_line_in_ns_commands
from leco_plugin.studio.cooldown import CooldownSchedulerConfig
from leco_plugin.studio.processes import DataParallelTrainerConfig

show_one_line_in_ns_commands()
render_images_without_ffmpeg()


def best_device() -> Literal["cpu", "cuda"]:
    """`cuda` where there is one, else `cpu`: nobody should need a flag for that."""
    return "cuda" if torch.cuda.is_available() else "cpu"


ON_GPU = best_device() == "cuda"
STEPS = 30_000 if ON_GPU else 4_000

LEARNING = LecoModelConfig(
    sizes=automatic(sizes_for(best_device())),
    schedule=ScheduleConfig(learn_steps=2_000 if ON_GPU else 200, learn_share=0.1),
    eval_num_rays_per_chunk=1 << 15 if ON_GPU else 1 << 13,
)
"""The HMoE in sizes of this device, smaller where the scene is."""


def photographs(rays: int) -> LecoDataManagerConfig:
    """The reader of `leco-occupancy`, whose coordinates the occupancy is in."""
    return LecoDataManagerConfig(
        dataparser=LecoPhotographsDataParserConfig(),
        train_num_rays_per_batch=rays,
        eval_num_rays_per_batch=1024,
        pixel_sampler=KnownDistancePixelSamplerConfig(),
    )


def trainer(
    name: str,
    pipeline: VanillaPipelineConfig,
    rates: dict[str, float],
    steps: int = STEPS,
    mixed_precision: bool = False,
) -> DataParallelTrainerConfig:
    """A method: Adam at these rates, which fall to zero over the last quarter of a run.

    Our own models choose their precision themselves, on CPU and CUDA alike.
    """
    return DataParallelTrainerConfig(
        method_name=name,
        machine=MachineConfig(device_type=best_device()),
        max_num_iterations=steps,
        steps_per_save=500,
        steps_per_eval_batch=0,
        steps_per_eval_image=500,
        steps_per_eval_all_images=0,
        mixed_precision=mixed_precision,
        pipeline=pipeline,
        optimizers={
            group: {"optimizer": FusedAdamConfig(lr=rate), "scheduler": CooldownSchedulerConfig()}
            for group, rate in rates.items()
        },
        viewer=ViewerConfig(num_rays_per_chunk=1 << 12, quit_on_train_completion=True),
        vis="viewer+tensorboard",
    )


leco_occupancy = MethodSpecification(
    config=trainer(
        "leco-occupancy",
        VanillaPipelineConfig(datamanager=photographs(4096 if ON_GPU else 1024), model=LEARNING),
        RATES,
    ),
    description="Learned occupancy: learn it, freeze and calibrate it, go on guided by it.",
)

leco_occupancy_paper = MethodSpecification(
    config=trainer(
        "leco-occupancy-paper",
        VanillaPipelineConfig(
            datamanager=photographs(1024),
            model=replace(
                LEARNING,
                sizes=PAPER,
                schedule=ScheduleConfig(learn_steps=40_000, steps_per_check=500),
            ),
        ),
        dict.fromkeys(RATES, 5e-4),
        steps=540_000,
    ),
    description="The same in the sizes of the paper (8 experts of 7 x 256, 257 samples); for its "
    "losses too, --pipeline.model.gate-loss.form paper.",
)
