"""Hosts in sizes for tests: ours, two of nerfstudio, three of the package in `tests/elsewhere`."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import torch
import tyro
from nerfstudio.configs.method_configs import all_methods
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManagerConfig
from nerfstudio.data.datamanagers.parallel_datamanager import ParallelDataManagerConfig
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipeline

from leco_plugin.hosts.guided import GuidedModelConfig
from leco_plugin.hosts.guided_start import OccupancyConfig

QUICK = ["--steps-per-eval-image=0", "--vis=tensorboard", "--logging.local-writer.enable=False"]
RAYS = [
    "--pipeline.datamanager.train-num-rays-per-batch=128",
    "--pipeline.datamanager.eval-num-rays-per-batch=128",
]
NGP = [
    "log2-hashmap-size=8",
    "max-res=64",
    "grid-resolution=16",
    "grid-levels=2",
    "cone-angle=0.02",
    "near-plane=0.2",
    "far-plane=8",
]
NERFACTO = [
    "implementation=torch",
    "num-levels=2",
    "max-res=64",
    "log2-hashmap-size=8",
    "hidden-dim=16",
    "hidden-dim-color=16",
    "num-nerf-samples-per-ray=12",
    "num-proposal-samples-per-ray 24 16",
]

SWITCH_NERF = [
    "sizes.field.octaves=4",
    "sizes.field.experts=2",
    "sizes.field.width=16",
    "sizes.field.layers=2",
    "sizes.field.skip=1",
    "sizes.field.color-width=16",
    "sizes.field.appearance-dim=4",
    "sizes.candidates=24",
    "sizes.coarse=12",
    "sizes.fine=12",
]


def what_a_model_gets() -> dict[str, Any]:
    """What nerfstudio gives a model when it builds it, for two images in a cube."""
    box = SceneBox(aabb=torch.tensor([[-1.0, -1, -1], [1, 1, 1]]))
    return {"scene_box": box, "num_train_data": 2, "metadata": {}, "device": "cpu"}


def sizes(of_model: list[str], where: str = "pipeline.model") -> list[str]:
    """Flags of a model that is at `where` in the config."""
    return " ".join(f"--{where}.{flag}" for flag in of_model).split()


SMALL: dict[str, list[str]] = {
    "instant-ngp": [
        *sizes(NGP),
        "--pipeline.target-num-samples=2048",
        "--pipeline.max-num-samples-per-ray=16",
    ],
    "nerfacto": [*sizes(NERFACTO), *RAYS],
    "switch-nerf": [*sizes(SWITCH_NERF), *RAYS],
    "elsewhere-packed": [],
    "elsewhere-proposal": [],
    "elsewhere-places": [],
}
"""Flags of each host with which a step takes some milliseconds."""


def small(name: str) -> TrainerConfig:
    """The method of that name in its size for tests."""
    if name.startswith("elsewhere-"):
        methods = importlib.import_module("nerf_elsewhere.methods")
        registered = getattr(methods, name.removeprefix("elsewhere-")).config
    else:
        registered = all_methods[name]
    config = tyro.cli(
        tyro.conf.FlagConversionOff[TrainerConfig],
        default=registered,
        args=[*SMALL[name], "--machine.device-type=cpu"],
    )
    manager: Any = config.pipeline.datamanager
    if isinstance(manager, ParallelDataManagerConfig):
        # its processes take longer to start than everything else here
        config.pipeline.datamanager = VanillaDataManagerConfig(
            dataparser=manager.dataparser,
            train_num_rays_per_batch=manager.train_num_rays_per_batch,
            eval_num_rays_per_batch=manager.eval_num_rays_per_batch,
        )
    return config


def pipeline_of(config: TrainerConfig, scene: Path) -> VanillaPipeline:
    """The pipeline of a method with its data and its model, in this process."""
    config.pipeline.datamanager.data = scene
    made: Any = config.pipeline.setup(device="cpu", test_mode="val")
    assert isinstance(made, VanillaPipeline)
    return made


def unswapped(name: str, scene: Path) -> VanillaPipeline:
    """The pipeline of a host that keeps its own sampler, on any machine."""
    config = small(name)
    pipeline: Any = config.pipeline
    pipeline.model = GuidedModelConfig(
        host=pipeline.model, occupancy=OccupancyConfig(sampler="own")
    )
    return pipeline_of(config, scene)
