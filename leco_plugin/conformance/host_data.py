"""The rule for a host and its data manager: images that are held out teach it nothing."""

from __future__ import annotations

import copy
import json
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from PIL import Image
from torch import Tensor

from leco_plugin.conformance.host_training import Run
from leco_plugin.conformance.hosts import HostCase, cameras, quietly
from leco_plugin.conformance.rules import checks, require
from leco_plugin.conformance.scene import CENTRE, HALF

IMAGES, PIXELS, RAYS, STEPS = 16, 16, 64, 2
"""Images, pixels along each of their sides, rays of a batch, and steps of a run."""


class RunOnImages(Run):
    """A training run with the method's own pipeline and data manager."""

    def __init__(self, config: Any) -> None:
        from nerfstudio.engine.callbacks import TrainingCallbackAttributes
        from nerfstudio.engine.optimizers import Optimizers

        torch.manual_seed(0)
        with quietly():
            self.pipeline = config.pipeline.setup(device="cpu", test_mode="val")
            self.pipeline.train()
            self.model = self.pipeline.model
            groups = self.pipeline.get_param_groups()
            self.optimizers = Optimizers(copy.deepcopy(config.optimizers), groups)
            attributes = TrainingCallbackAttributes(self.optimizers, None, self.pipeline, None)
            self.callbacks = self.pipeline.get_training_callbacks(attributes)

    def loss(self, step: int) -> Tensor:
        _, losses, _ = self.pipeline.get_train_loss_dict(step)
        return torch.stack([loss.sum() for loss in losses.values()]).sum()

    def files(self, split: str) -> set[Path]:
        """Images of the data manager's `train_dataset` or `eval_dataset`."""
        dataset = getattr(self.pipeline.datamanager, f"{split}_dataset", None)
        return set() if dataset is None else {*map(Path, dataset.image_filenames)}


@checks("held-out-images-teach-nothing", "host")
def held_out_images_teach_nothing(case: HostCase) -> None:
    """After other held-out images the parameters are the same."""
    with TemporaryDirectory() as folder:
        write_images(Path(folder))
        config = reading(case.config, Path(folder))
        learned: list[dict[str, Tensor]] = []
        for brightness in (0, 255):
            run = RunOnImages(config)
            held_out = run.files("eval")
            both = held_out & run.files("train")
            require(not both, f"{len(both)} of {len(held_out)} held-out images are trained on")
            if not learned:  # the first run's own loader may have read them already
                _paint(held_out, brightness)
                run = RunOnImages(config)
            for step in range(STEPS):
                run.step(step)
            learned.append(run.parameters())
            _paint(held_out, 255)
    for name, value in learned[0].items():
        require(
            value.equal(learned[1][name]),
            f"other held-out images, and {STEPS} training steps leave another {name}",
        )


def reading(config: Any, folder: Path) -> Any:
    """The config of a method, whose data manager reads a folder in nerfstudio's format."""
    from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

    config = copy.deepcopy(config)
    manager = config.pipeline.datamanager
    parser = manager.dataparser
    if not isinstance(parser, NerfstudioDataParserConfig):
        parser = NerfstudioDataParserConfig()
    still: dict[str, Any] = {"orientation_method": "none", "center_method": "none"}
    reach = 2.0 * (max(map(abs, CENTRE)) + HALF)
    manager.dataparser = replace(
        parser, data=folder, auto_scale_poses=False, scene_scale=reach, **still
    )
    manager.data, manager.train_num_rays_per_batch = folder, RAYS
    return config


def write_images(folder: Path) -> None:
    """Images of the scene of the kit, from its cameras and from farther off, with their poses."""
    known = cameras()
    corner, frames = torch.tensor([[0.0, 0.0, 0.0, 1.0]]), []
    for number in range(IMAGES):
        pose = known.camera_to_worlds[number % len(known)].clone()
        pose[:, 3] += 0.1 * number * pose[:, 2]
        name = f"{number:02d}.png"
        shade = 15 * number
        Image.new("RGB", (PIXELS, PIXELS), (shade, 255 - shade, 128)).save(folder / name)
        matrix = torch.cat([pose, corner]).tolist()
        frames.append({"file_path": name, "transform_matrix": matrix})
    focal = float(known.fx[0]) * PIXELS / float(known.width[0])
    lens = {"fl_x": focal, "fl_y": focal, "cx": PIXELS / 2, "cy": PIXELS / 2}
    scene = {**lens, "w": PIXELS, "h": PIXELS, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(scene))


def _paint(files: set[Path], brightness: int) -> None:
    for file in files:
        Image.new("RGB", (PIXELS, PIXELS), (brightness,) * 3).save(file)
