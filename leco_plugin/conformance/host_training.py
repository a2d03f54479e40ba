"""The rules for a guided host over a run: steps, checkpoints, two processes, held-out images."""

from __future__ import annotations

import copy
import functools
import json
import random
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
import yaml  # type: ignore[import-untyped]
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.engine.callbacks import TrainingCallbackLocation as Location
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.models.base_model import Model
from PIL import Image
from torch import Tensor
from torch.nn.parallel import DistributedDataParallel

from leco_plugin.conformance import hosts
from leco_plugin.conformance.host_images import asked_and_sampled, rendered, sample_densely
from leco_plugin.conformance.hosts import HostCase
from leco_plugin.conformance.rules import checks, require
from leco_plugin.conformance.samplers import on_two_ranks, reloaded
from leco_plugin.conformance.scene import CENTRE, HALF, SLAB
from leco_plugin.hosts.seams import PACKED, PROPOSAL
from leco_plugin.log import first_of

GUIDE = "leco_guide."
"""How the names of what belongs to the guide of a host begin."""


@checks("samples-shift-in-training", "host")
def samples_shift_in_training(case: HostCase) -> None:
    model = case.shared().train()
    places = []
    for seed in (1, 2):
        torch.manual_seed(seed)
        places.append(asked_and_sampled(model)[0])
    alike = places[0].equal(places[1])
    require(not alike, "two training steps ask the field at the same places")


@checks("teaches-the-host-alone", "host")
def teaches_the_host_alone(case: HostCase) -> None:
    model: Any = case.shared()
    groups = model.get_param_groups()
    handed_out = {id(parameter) for group in groups.values() for parameter in group}
    gradients = gradients_of_a_step(model)
    named = dict(model.named_parameters())
    reached = [named[name] for name, gradient in gradients.items() if bool(gradient.any())]
    require(bool(reached), "no parameter of the host gets a gradient")
    learns = any(id(parameter) in handed_out for parameter in reached)
    require(learns, "no optimizer is handed a parameter of the host that gets a gradient")
    for name, gradient in gradients.items():
        require(bool(gradient.isfinite().all()), f"the gradient of {name} is not finite")
    for name, parameter in model.leco_guide.named_parameters():
        require(not parameter.requires_grad, f"{name} of the guide is no longer frozen")
        require(id(parameter) not in handed_out, f"{name} of the guide is handed to an optimizer")
    touched = [name for name in gradients if name.startswith(GUIDE)]
    require(not touched, f"{first_of(touched, 3)} of the guide get a gradient")


def gradients_of_a_step(model: Model) -> dict[str, Tensor]:
    """Gradients of the batch's loss by parameter, for parameters that it reaches."""
    torch.manual_seed(0)
    loss = hosts.loss_of(model.train(), hosts.bundle(), hosts.batch())
    require(loss.requires_grad, "the loss has no gradient")
    loss.backward()  # type: ignore[no-untyped-call]
    gradients = _gradients(model)
    model.zero_grad(set_to_none=True)
    return gradients


@checks("nothing-superfluous-is-left", "host")
def nothing_superfluous_is_left(case: HostCase) -> None:
    own, model = case.unguided(), case.shared()
    for adapter in (PACKED, PROPOSAL):
        require(not adapter.fits(model), f"the host still holds {adapter.description}")
    now = dict(model.named_parameters())
    with sample_densely(own):  # a grid that nobody has updated keeps nothing
        before = gradients_of_a_step(own)
    idle = before.keys() & now.keys() - gradients_of_a_step(model).keys()
    require(
        not idle,
        f"{first_of(sorted(idle), 3)} are trained with the host's own sampler, and get no gradient "
        "now",
    )
    state = model.state_dict().keys()
    gained = state - own.state_dict().keys()
    more = sorted(name for name in gained if not name.startswith(GUIDE))
    require(not more, f"the state dict has gained {first_of(more, 3)} beside the guide")
    held = {id(parameter) for parameter in now.values()}
    for name, group in model.get_param_groups().items():
        require(bool(group), f"the parameter group {name!r} is empty, which no optimizer takes")
        gone = sum(id(parameter) not in held for parameter in group)
        require(gone == 0, f"the parameter group {name!r} holds {gone} that the host no longer has")


ROUNDING = 1e-3
"""Share of a step, or of a gradient, by which sums in another order may differ."""


@checks("state-and-yaml-round-trip", "host")
def state_and_yaml_round_trip(case: HostCase) -> None:
    """A run folder is all that it takes: its config.yml, its checkpoint, and no other file."""
    model = case.shared()
    expected = rendered(model, hosts.bundle())
    with TemporaryDirectory() as folder:
        config = copy.deepcopy(case.config)
        config.pipeline.model.occupancy.path = Path(folder) / case.file.name  # type: ignore[attr-defined]
        case.occupancy(SLAB).save(config.pipeline.model.occupancy.path)  # type: ignore[attr-defined]
        written = yaml.dump(config)
    read: Any = yaml.load(written, Loader=yaml.Loader)
    restored = hosts.build(read.pipeline.model, seed=1)
    restored.update_to_step(1)
    restored.load_state_dict(reloaded(model.state_dict()), strict=True)
    for name, value in rendered(restored, hosts.bundle()).items():
        said = f"the output {name!r} of a model that was restored is not that of the one it is of"
        require(value.equal(expected[name]), said)


class Run:
    """A training run as nerfstudio's trainer makes it, of the same batch in every step."""

    def __init__(self, config: TrainerConfig, seed: int) -> None:
        self.model = hosts.build(config.pipeline.model, seed)
        self.begin(config, self.model)

    def begin(self, config: TrainerConfig, owner: Any) -> None:
        """Makes optimizers and callbacks of a model, or of a pipeline."""
        self.optimizers = Optimizers(copy.deepcopy(config.optimizers), owner.get_param_groups())
        self.callbacks = hosts.callbacks(owner, self.optimizers)

    def step(self, step: int) -> float:
        """Takes a step, with random numbers of its own; returns the loss."""
        torch.manual_seed(step)
        self.model.train()
        for callback in self.callbacks:
            callback.run_callback_at_location(step, Location.BEFORE_TRAIN_ITERATION)
        self.optimizers.zero_grad_all()
        loss = self.loss(step)
        loss.backward()  # type: ignore[no-untyped-call]
        self.optimizers.optimizer_step_all()
        for scheduler in self.optimizers.schedulers.values():
            scheduler.step()
        for callback in self.callbacks:
            callback.run_callback_at_location(step, Location.AFTER_TRAIN_ITERATION)
        return float(loss.detach())

    def loss(self, step: int) -> Tensor:
        return hosts.loss_of(self.model, hosts.bundle(), hosts.batch())

    def state(self) -> dict[str, Any]:
        """What a checkpoint holds."""
        held = self.optimizers
        return {
            "model": self.model.state_dict(),
            "optimizers": {name: each.state_dict() for name, each in held.optimizers.items()},
            "schedulers": {name: each.state_dict() for name, each in held.schedulers.items()},
        }

    def resume(self, state: dict[str, Any], step: int) -> None:
        """Goes on from the checkpoint of a step."""
        self.model.update_to_step(step)
        self.model.load_state_dict(state["model"], strict=True)
        self.optimizers.load_optimizers(state["optimizers"])
        self.optimizers.load_schedulers(state["schedulers"])

    def parameters(self) -> dict[str, Tensor]:
        return {name: p.detach().clone() for name, p in self.model.named_parameters()}


@checks("resumes-where-it-stopped", "host")
def resumes_where_it_stopped(case: HostCase) -> None:
    run, resumed = Run(case.config, seed=0), Run(case.config, seed=1)
    run.step(0)
    state, before = reloaded(run.state()), run.parameters()
    expected = run.step(1)
    resumed.resume(state, step=0)
    found = resumed.step(1)
    require(
        abs(found - expected) <= ROUNDING * abs(expected),
        f"the loss after resuming is {found:.6g}; uninterrupted it is {expected:.6g}",
    )
    after = resumed.parameters()
    for name, value in run.parameters().items():
        step, apart = (value - before[name]).norm(), (value - after[name]).norm()
        require(
            bool(apart <= ROUNDING * step),
            f"the first step after resuming moves {name} otherwise than without interruption",
        )


@checks("two-processes-step-alike", "host")
def two_processes_step_alike(case: HostCase) -> None:
    """Two ranks with half a batch each get the gradients of one process with all of it."""
    config = case.config.pipeline.model  # type: ignore[attr-defined]
    model = hosts.build(config)
    hosts.callbacks(model)
    for rank in range(2):
        _half_a_batch(model, rank).backward()  # type: ignore[no-untyped-call]
    alone = {name: gradient / 2.0 for name, gradient in _gradients(model).items()}
    one, other = on_two_ranks(functools.partial(gradients_of_rank, config), case.imports)
    for name, parameter in model.named_parameters():
        nothing = torch.zeros_like(parameter)
        first, second, expected = (found.get(name, nothing) for found in (one, other, alone))
        require(first.equal(second), f"the ranks' gradients of {name} differ")
        apart, length = (first - expected).norm(), expected.norm()
        require(
            bool(apart <= ROUNDING * length),
            f"the gradient of {name} differs by {float(apart):.2g} from that of one process, which "
            f"is {float(length):.2g} long",
        )


def gradients_of_rank(config: Any, rank: int) -> dict[str, Tensor]:
    """Gradients that a rank of data-parallel training gets from its half of the batch."""
    model = hosts.build(config, seed=rank)
    hosts.callbacks(model)
    parallel = DistributedDataParallel(model, find_unused_parameters=True)
    _half_a_batch(model, rank, parallel).backward()  # type: ignore[no-untyped-call]
    return _gradients(model)


def _half_a_batch(model: Any, rank: int, forward: Any = None) -> Tensor:
    """The loss of every second ray, in training, with the rank's own random numbers."""
    rendered(model, hosts.bundle()[rank::2])  # whatever is built at first use is built
    torch.manual_seed(rank)
    half = {name: values[rank::2] for name, values in hosts.batch().items()}
    return hosts.loss_of(model.train(), hosts.bundle()[rank::2], half, forward)


def _gradients(model: Any) -> dict[str, Tensor]:
    named = model.named_parameters()
    return {name: parameter.grad for name, parameter in named if parameter.grad is not None}


IMAGES, PIXELS, RAYS, STEPS = 16, 16, 64, 2
"""Images, pixels along each of their sides, rays of a batch, and steps of a run."""


class RunOnImages(Run):
    """A training run with the method's own pipeline and data manager."""

    def __init__(self, config: Any) -> None:
        self._seed(0)
        with hosts.quietly():
            self.pipeline = config.pipeline.setup(device="cpu", test_mode="val")
            self.pipeline.train()
            self.model = self.pipeline.model
        self.begin(config, self.pipeline)

    @staticmethod
    def _seed(seed: int) -> None:
        """nerfstudio draws pixels with numbers of all three."""
        random.seed(seed)
        np.random.seed(seed)  # noqa: NPY002
        torch.manual_seed(seed)

    def learned(self) -> dict[str, Tensor]:
        """Parameters after a few steps."""
        self._seed(0)
        with hosts.quietly():
            for step in range(STEPS):
                self.step(step)
        return self.parameters()

    def loss(self, step: int) -> Tensor:
        _, losses, _ = self.pipeline.get_train_loss_dict(step)
        return functools.reduce(torch.add, losses.values())

    def files(self, split: str) -> set[Path]:
        """Images of the data manager's `train_dataset` or `eval_dataset`."""
        dataset = getattr(self.pipeline.datamanager, f"{split}_dataset", None)
        return set() if dataset is None else {*map(Path, dataset.image_filenames)}


@checks("held-out-images-teach-nothing", "host")
def held_out_images_teach_nothing(case: HostCase) -> None:
    """With other held-out images, training steps lead to the same parameters. A method whose data
    manager reads no files is not asked."""
    if not hasattr(case.config.pipeline.datamanager, "dataparser"):
        return
    with TemporaryDirectory() as name:
        folder = Path(name)
        write_images(folder)
        config = reading(case.config, folder)
        run = RunOnImages(config)
        held_out, trained = run.files("eval"), run.files("train")
        both = len(held_out & trained)
        require(both == 0, f"{both} of {len(held_out)} held-out images are trained on")
        expected = run.learned()
        for file in held_out:
            Image.new("RGB", (PIXELS, PIXELS), "white").save(file)
        found = RunOnImages(config).learned()
    for name, value in expected.items():
        require(value.equal(found[name]), f"what {name} learns depends on held-out images")


def reading(config: Any, folder: Path) -> Any:
    """The config of a method, whose data manager reads a folder in nerfstudio's format."""
    config = copy.deepcopy(config)
    manager = config.pipeline.datamanager
    parser = manager.dataparser
    if not isinstance(parser, NerfstudioDataParserConfig):
        parser = NerfstudioDataParserConfig()
    still: dict[str, Any] = {"orientation_method": "none", "center_method": "none"}
    still |= {"auto_scale_poses": False, "scene_scale": 2.0 * (max(map(abs, CENTRE)) + HALF)}
    manager.dataparser = replace(parser, data=folder, **still)
    manager.data, manager.train_num_rays_per_batch = folder, RAYS
    return config


def write_images(folder: Path) -> None:
    """Images of the scene of the kit, from its cameras and from farther off, with their poses."""
    known = hosts.cameras()
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
