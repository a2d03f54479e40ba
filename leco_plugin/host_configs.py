"""Guided hosts as methods of `ns-train`, each with sizes that fit the device."""

from __future__ import annotations

from dataclasses import replace

from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.models.base_model import ModelConfig
from nerfstudio.models.instant_ngp import InstantNGPModelConfig
from nerfstudio.models.nerfacto import NerfactoModelConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig
from nerfstudio.plugins.types import MethodSpecification

from leco_plugin.hosts.guided import GuidedModelConfig
from leco_plugin.method_configs import ON_GPU, STEPS, best_device, photographs, trainer
from leco_plugin.models.switch.field import SwitchNerfModelConfig, switch_sizes_for
from leco_plugin.studio.dynamic_batch import ClampedDynamicBatchPipelineConfig
from leco_plugin.swap import learned_first, with_sampler_swapped


def guided(host: ModelConfig) -> GuidedModelConfig:
    """The host, guided by an occupancy from a file or learned first."""
    return GuidedModelConfig(host=host, occupancy=learned_first())


def learning_first(config: TrainerConfig, name: str) -> TrainerConfig:
    """Another method like `leco-ngp`, on the device that is here: its model guided by an occupancy
    that a run learns first, or by `--pipeline.model.occupancy.path`. `config` is not changed.

    Raises:
        InputError: its model learns or has an occupancy already.
    """
    made = with_sampler_swapped(config, None)
    machine = replace(made.machine, device_type=best_device())
    return replace(made, method_name=name, machine=machine)


def ngp_host() -> InstantNGPModelConfig:
    """Instant-NGP as nerfstudio has it; on a CPU with a smaller table and longer steps."""
    if ON_GPU:
        return InstantNGPModelConfig(eval_num_rays_per_chunk=8192)
    return InstantNGPModelConfig(
        eval_num_rays_per_chunk=2048,
        log2_hashmap_size=16,
        max_res=1024,
        cone_angle=1 / 64,
        grid_resolution=64,
    )


def nerfacto_host() -> NerfactoModelConfig:
    """Nerfacto as nerfstudio has it; on a CPU with a smaller table and fewer samples."""
    if ON_GPU:
        return NerfactoModelConfig(eval_num_rays_per_chunk=1 << 15, average_init_density=0.01)
    return NerfactoModelConfig(
        eval_num_rays_per_chunk=2048,
        average_init_density=0.01,
        implementation="torch",
        num_levels=8,
        max_res=1024,
        log2_hashmap_size=16,
        num_proposal_samples_per_ray=(128, 64),
        num_nerf_samples_per_ray=32,
        camera_optimizer=CameraOptimizerConfig(mode="off"),
    )


leco_ngp = MethodSpecification(
    config=trainer(
        "leco-ngp",
        ClampedDynamicBatchPipelineConfig(
            datamanager=photographs(4096 if ON_GPU else 512),
            model=guided(ngp_host()),
            target_num_samples=1 << 18 if ON_GPU else 1 << 14,
            max_num_samples_per_ray=1024 if ON_GPU else 32,
        ),
        {"fields": 1e-2},
        mixed_precision=ON_GPU,
    ),
    description="Instant-NGP, guided by learned occupancy instead of its occupancy grid.",
)

leco_nerfacto = MethodSpecification(
    config=trainer(
        "leco-nerfacto",
        VanillaPipelineConfig(
            datamanager=photographs(4096 if ON_GPU else 512), model=guided(nerfacto_host())
        ),
        {"fields": 1e-2, "proposal_networks": 1e-2, "camera_opt": 1e-3},
        mixed_precision=ON_GPU,
    ),
    description="Nerfacto, guided by learned occupancy instead of its proposal networks.",
)


def _switch_nerf(name: str, model: ModelConfig) -> TrainerConfig:
    """Switch-NeRF's batches, rates and steps."""
    return trainer(
        name,
        VanillaPipelineConfig(datamanager=photographs(1024 if ON_GPU else 512), model=model),
        {"fields": 5e-4 if ON_GPU else 5e-3},
        steps=500_000 if ON_GPU else STEPS,
    )


switch_nerf_host = SwitchNerfModelConfig(sizes=switch_sizes_for(best_device()))

switch_nerf = MethodSpecification(
    config=_switch_nerf("switch-nerf", switch_nerf_host),
    description="Switch-NeRF, unguided: coarse and fine samples, a gate among equal experts.",
)

leco_switch_nerf = MethodSpecification(
    config=_switch_nerf("leco-switch-nerf", guided(switch_nerf_host)),
    description="Switch-NeRF, guided by learned occupancy instead of coarse and fine samples.",
)

mega_nerf_host = replace(
    switch_nerf_host,
    sizes=replace(
        switch_nerf_host.sizes, field=replace(switch_nerf_host.sizes.field, routing="nearest")
    ),
    balance=0.0,
)

leco_mega_nerf = MethodSpecification(
    config=_switch_nerf("leco-mega-nerf", guided(mega_nerf_host)),
    description="Mega-NeRF's fixed shares of the ground, guided by learned occupancy.",
)
