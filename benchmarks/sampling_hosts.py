"""Training steps of two guided hosts, with their sampling apart, for the sampling benchmark."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.models.instant_ngp import InstantNGPModelConfig
from sampling_scene import rays_into

from leco_plugin.hosts.guided import Host, set_up_host
from leco_plugin.models.field import HMoEField
from leco_plugin.models.rendering import Intervals, Rays, Routing, Scene, shade
from leco_plugin.models.sizing.sizes import PAPER
from leco_plugin.occupancy import gate_precision
from leco_plugin.samplers import nerfacc_cpu
from leco_plugin.samplers.estimator import LearnedOccupancyEstimator

Steps = tuple[Callable[[], Any], Callable[[], Any]]
"""What is timed: sampling alone, and a training step with its sampling."""


def ngp_like_step(estimator: LearnedOccupancyEstimator, n_rays: int = 1024) -> Steps:
    """nerfstudio's instant-ngp with its grid replaced.

    The density that the host asks to prune its samples belongs to the host, not to sampling.
    """
    space = estimator.occupancy.space
    origins, directions = rays_into(space, n_rays)
    box = torch.stack([space.center - space.half_extent, space.center + space.half_extent]).cpu()
    config = InstantNGPModelConfig(grid_resolution=8, grid_levels=1, background_color="white")
    nerfacc_cpu.install()
    model = set_up_host(config, Host, scene_box=SceneBox(box), num_train_data=1)
    model = model.to(estimator.device)
    model.sampler.occupancy_grid = estimator
    optimizer = torch.optim.Adam(model.get_param_groups()["fields"], lr=1e-2)
    image = torch.rand(n_rays, 3, device=estimator.device)

    def step() -> None:
        bundle = RayBundle(
            origins=origins,
            directions=directions,
            pixel_area=torch.ones_like(origins[:, :1]),
            camera_indices=torch.zeros_like(origins[:, :1], dtype=torch.int64),
        )
        loss = sum(model.get_loss_dict(model(bundle), {"image": image}).values())
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    def sample() -> None:
        estimator.sampling(
            origins,
            directions,
            near_plane=config.near_plane,
            far_plane=config.far_plane,
            render_step_size=config.render_step_size,
            cone_angle=config.cone_angle,
            stratified=True,
        )

    return sample, step


def switch_nerf_like_step(estimator: LearnedOccupancyEstimator, n_rays: int = 256) -> Steps:
    """A mixture of eight large experts (Switch-NeRF's sizes) on the kept samples."""
    occupancy = estimator.occupancy
    space = occupancy.space
    origins, directions = rays_into(space, n_rays)
    field = HMoEField(PAPER.field, num_images=1).to(estimator.device)
    optimizer = torch.optim.Adam(field.parameters(), lr=1e-3)
    image = torch.rand(n_rays, 3, device=estimator.device)
    step_size = float(space.half_extent) / 100.0
    t_mins = torch.zeros_like(origins[:, 0])
    rays = Rays(origins, directions, t_mins, t_mins + 4.0 * float(space.half_extent), None)

    def sample() -> Any:
        return estimator.sampling(origins, directions, render_step_size=step_size, stratified=True)

    def step() -> None:
        intervals = Intervals(*sample())
        scene = Scene(field, occupancy.gate, space, Routing(None, homogeneous=True))
        with gate_precision(estimator.device.type, occupancy.precision):
            shaded = shade(scene, rays, intervals, freeze_gate=True)
        loss = (shaded.rgb - image).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    return sample, step
