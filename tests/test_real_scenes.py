"""Real photographs need no flag: bounds, orientation and sizes come from them."""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from leco_plugin.host_configs import switch_nerf
from leco_plugin.learning.calibration import CalibrationConfig
from leco_plugin.learning.dense import evaluating
from leco_plugin.learning.freezing import FILE_NAME
from leco_plugin.method_configs import leco_occupancy
from leco_plugin.occupancy import Occupancy
from leco_plugin.scenes.learning_data import held_out_bundle
from leco_plugin.studio.host_models import run_training

pytestmark = [pytest.mark.scenes, pytest.mark.slow]

LEAST = 0.3
"""dB that some 20 steps of 128 rays gain on 512 pixels which are the same before and after: of 23
runs, each with a seed of its own, the least was 0.9 (`banana`, which begins at 18.5 dB)."""
KINDS = {"brighton_beach": "box", "caliterra": "box", "banana": "box", "fox": "contraction"}

OUTPUTS = {"rgb", "depth", "accumulation", "occupancy", "expert", "samples_per_ray"}


@torch.no_grad()
def psnr_on(trainer: Any, rays: RayBundle, truth: Tensor) -> float:
    """Of those pixels, dB."""
    model = trainer.pipeline.model
    with evaluating(model):
        rgb = model.get_outputs(rays.to(model.device))["rgb"].cpu()
    return -10.0 * math.log10(float((rgb - truth[:, :3]).square().mean()))


def assert_renders(trainer: Any) -> None:
    """A test photograph, at a twelfth of its size, in every output."""
    model, dataset = trainer.pipeline.model, trainer.pipeline.datamanager.eval_dataset
    camera = copy.deepcopy(dataset.cameras[0:1])
    camera.rescale_output_resolution(1 / 12)
    shape = int(camera.height), int(camera.width)
    model.eval()
    outputs = model.get_outputs_for_camera(camera.to(model.device))
    assert outputs.keys() >= OUTPUTS
    for output in OUTPUTS:
        assert outputs[output].shape[:2] == shape
        assert bool(outputs[output].isfinite().all())
    assert float(outputs["samples_per_ray"].mean()) >= 1.0


def trained(method: Any, scene: Path, outputs: Path, steps: int, **options: Any) -> Any:
    """The trainer of a short run of a method without a flag of the scene, which it has learned.

    Args:
        options: of the model.
    """
    config = copy.deepcopy(method.config)
    config.pipeline.datamanager.data = scene
    config.pipeline.datamanager.train_num_rays_per_batch = 128
    config.pipeline.model = replace(config.pipeline.model, **options)
    config.output_dir, config.vis, config.max_num_iterations = outputs, "tensorboard", steps
    config.steps_per_eval_image = 0
    config.logging.local_writer.enable = False
    config.set_timestamp()
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    pixels = held_out_bundle(trainer.pipeline.datamanager, 512)
    untrained = psnr_on(trainer, *pixels)
    run_training(trainer)
    assert psnr_on(trainer, *pixels) > untrained + LEAST
    return trainer


@pytest.mark.parametrize("name", KINDS)
def test_a_scene_trains_freezes_and_renders_without_a_flag(
    name: str, scenes: Path, tmp_path: Path
) -> None:
    options = {"calibration": CalibrationConfig(rays=64)}
    trainer = trained(leco_occupancy, scenes / name, tmp_path, 24, **options)
    mixture = trainer.pipeline.model.mixture
    assert bool(mixture.frozen) and mixture.region.space.kind == KINDS[name]
    assert_renders(trainer)
    occupancy = Occupancy.load(trainer.base_dir / FILE_NAME)
    assert occupancy.report["held_out"]
    values = occupancy.query(torch.rand(100, 3) - 0.5)
    assert bool(((values >= 0) & (values <= 1)).all())


def case_of(name: str, sampling: str) -> Any:
    """A case of the next test: two run by default, a box and a contraction, each with one sampling.
    The test of `leco-occupancy` reads the other boxes."""
    by_default = (name, sampling) in {("caliterra", "occupancy-grid"), ("fox", "coarse-fine")}
    return pytest.param(name, sampling, marks=[] if by_default else pytest.mark.long)


@pytest.mark.parametrize(
    ("name", "sampling"),
    [case_of(name, sampling) for name in KINDS for sampling in ("coarse-fine", "occupancy-grid")],
)
def test_switch_nerf_trains_and_renders_without_a_flag(
    name: str, sampling: str, scenes: Path, tmp_path: Path
) -> None:
    trainer = trained(switch_nerf, scenes / name, tmp_path, 20, sampling=sampling)
    assert trainer.pipeline.model.region.space.kind == KINDS[name]
