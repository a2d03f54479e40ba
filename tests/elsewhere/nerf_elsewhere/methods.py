"""The methods that `ns-train` finds."""

from __future__ import annotations

from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManagerConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.models.base_model import ModelConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig
from nerfstudio.pipelines.dynamic_batch import DynamicBatchPipelineConfig
from nerfstudio.plugins.types import MethodSpecification

from nerf_elsewhere.packed import PackedModelConfig
from nerf_elsewhere.places import PlacesModelConfig
from nerf_elsewhere.proposal import ProposalModelConfig


def _photographs() -> VanillaDataManagerConfig:
    return VanillaDataManagerConfig(
        dataparser=NerfstudioDataParserConfig(),
        train_num_rays_per_batch=128,
        eval_num_rays_per_batch=128,
    )


def _method(name: str, pipeline: VanillaPipelineConfig, groups: list[str]) -> MethodSpecification:
    return MethodSpecification(
        config=TrainerConfig(
            method_name=name,
            max_num_iterations=20,
            pipeline=pipeline,
            optimizers={
                group: {
                    "optimizer": AdamOptimizerConfig(lr=1e-2),
                    "scheduler": ExponentialDecaySchedulerConfig(lr_final=1e-3, max_steps=1000),
                }
                for group in groups
            },
            viewer=ViewerConfig(quit_on_train_completion=True),
            vis="tensorboard",
        ),
        description=f"A host of another package: {name}.",
    )


def _plain(model: ModelConfig) -> VanillaPipelineConfig:
    return VanillaPipelineConfig(datamanager=_photographs(), model=model)


packed = _method(
    "elsewhere-packed",
    DynamicBatchPipelineConfig(
        datamanager=_photographs(),
        model=PackedModelConfig(),
        target_num_samples=1 << 11,
        max_num_samples_per_ray=16,
    ),
    ["everything"],
)
proposal = _method("elsewhere-proposal", _plain(ProposalModelConfig()), ["scouts", "matter"])
places = _method("elsewhere-places", _plain(PlacesModelConfig()), ["matter"])
