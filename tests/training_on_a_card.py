"""python training_on_a_card.py refusals | sampling | reading | without_float64, or
leco-occupancy | hosts FOLDER."""

from __future__ import annotations

import copy
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
import tiny_scene
import torch
import tyro
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.plugins.registry import discover_methods
from pretended_card import CARD, OnCard, pretended_card, waits
from small_hosts import NERFACTO, NGP, QUICK, RAYS, SWITCH_NERF, sizes
from small_learner import NoPixels, small_mixture
from tiny_run import tiny_config
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from leco_plugin import on_cpu
from leco_plugin.conformance.scene import SLAB, crossing
from leco_plugin.learning.calibration import CalibrationConfig
from leco_plugin.learning.held_out import HeldOut
from leco_plugin.learning.price_watch import Evidence
from leco_plugin.learning.quality import kept_of_seen
from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.gate import GateConfig
from leco_plugin.models.mixture import Mixture
from leco_plugin.models.rendering import Rays, Routing
from leco_plugin.models.sizing.sizes import Sizes
from leco_plugin.samplers import scan
from leco_plugin.samplers.estimator import LearnedOccupancyEstimator
from leco_plugin.scenes.frames import inverse

HOSTS = {
    "leco-ngp": [
        *sizes(NGP, "pipeline.model.host"),
        "--pipeline.target-num-samples=1024",
        "--pipeline.max-num-samples-per-ray=16",
    ],
    "leco-nerfacto": [*sizes(NERFACTO, "pipeline.model.host"), *RAYS],
    "leco-switch-nerf": [*sizes(SWITCH_NERF, "pipeline.model.host"), *RAYS],
}
LEARNING = [
    "schedule.learn-steps=10",
    "calibration.rays=64",
    "calibration.recheck-rays=32",
    "calibration.steps-per-recheck=4",
]


def refusals() -> None:
    """What a card refuses."""
    there, here = torch.ones(3, device=CARD), torch.ones(3)
    of_cpu, mixtures = torch.Generator(), list[Callable[[], Any]]()
    mixtures += [lambda: there + here, lambda: torch.stack([there, here]), there.numpy]
    mixtures += [lambda: here[there > 0.0], lambda: there.index_select(0, here.long())]
    mixtures += [lambda: torch.rand(3, device=CARD, generator=of_cpu)]
    for mixture in mixtures:
        with pytest.raises((RuntimeError, TypeError)):
            mixture()
        print("refused")
    assert (there.cpu() + here).tolist() == [2.0] * 3 and there[here > 0.0].device == there.device


def sampling() -> None:
    """A frozen gate asked on the card, and what it keeps of rays there."""
    rays = crossing()
    placed, gate = rays.to(torch.device(CARD)), SLAB.occupancy()

    def kept(estimator: LearnedOccupancyEstimator, where: Any, **options: Any) -> Any:
        along = {"t_min": where.t_min, "t_max": where.t_max, "render_step_size": 0.05}
        return estimator.sampling(where.origins, where.directions, **along, **options)

    asked = {"sigma_fn": lambda t_starts, t_ends, ray_indices: torch.ones_like(t_starts)}
    here = LearnedOccupancyEstimator(copy.deepcopy(gate))
    there = LearnedOccupancyEstimator(gate).to(CARD)
    for options in ({}, {"cone_angle": 0.01}, asked):
        ours, theirs = kept(there, placed, **options), kept(here, rays, **options)
        assert all(part.device == torch.device(CARD) for part in ours)
        same = all(torch.equal(one.cpu(), other) for one, other in zip(ours, theirs))
        print("same" if same else "other samples")
    positions = placed.at(torch.zeros(9, dtype=torch.long, device=CARD), placed.t_max[:9])
    print("same" if gate.to(CARD).occupied(positions).device == positions.device else "elsewhere")


def reading() -> None:
    """What the CPU knows of a mixture on the card, however it was written."""
    sizes = Sizes(candidates=8, gate=GateConfig(EncodingConfig(octaves=2), width=8, layers=1))
    here = Mixture(sizes, 1, "float32", Routing(None, False))
    mixture = copy.deepcopy(here).to(CARD)

    def known(of: Mixture) -> tuple[bool, bool, list[float]]:
        return of.is_frozen, of.skips, [*of.rule(), *of.rule(coarse=True)]

    def claim(change: Callable[[Mixture], Any]) -> None:
        for one in (here, mixture):
            change(one)
        read = known(mixture)
        waits.clear()
        assert known(mixture) == read == known(here) and not waits
        print("known")

    claim(lambda of: of.freeze(0.25, {}))
    claim(lambda of: of.threshold.zero_())
    claim(lambda of: of.steps.__setitem__(1, 0.5))
    before, other = copy.deepcopy(here.state_dict()), copy.deepcopy(mixture)
    claim(lambda of: of.reopen())
    assert other.is_frozen and not other.to("cpu").skips
    claim(lambda of: of.load_state_dict(before))
    with torch.inference_mode():
        claim(lambda of: of.cones.fill_(0.125))


class NoFloat64(TorchDispatchMode):
    """Refuses float64 on the card, as Apple's GPUs do."""

    def __torch_dispatch__(
        self, function: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        out = function(*args, **(kwargs or {}))
        if isinstance(out, OnCard) and out.dtype == torch.float64:
            raise TypeError(f"{function}: the card has no float64")
        return out


class WhitePixels(NoPixels):
    """Nine rays, and white pixels."""

    def held_out(self, mixture: Mixture, *_: Any) -> tuple[Rays, Tensor]:
        origins, directions = (
            part.to(CARD) for part in (self.survey.origins, self.survey.directions)
        )
        images = torch.zeros(9, dtype=torch.int64, device=CARD)
        return mixture.rays(origins, directions, images), torch.ones(9, 3, device=CARD)


def without_float64() -> None:
    """What is measured at freezing and after it, on a card without float64."""
    data: Any = WhitePixels()
    mixture = small_mixture().to(CARD)
    held_out = HeldOut(mixture, data, CalibrationConfig(), restarted=False)
    with (
        NoFloat64(),
        patch.object(on_cpu, "has_float64", lambda device: device.type == "cpu"),
        patch.object(scan, "has_float64", lambda device: device.type == "cpu"),
    ):
        measured, _, report = held_out.price()
        mixture.freeze(measured.threshold, report)
        for values in held_out.excesses(0).values():
            Evidence().with_rays(values, 9.0)
        held_out.unneeded(9, 0.1)
        kept_of_seen(mixture)
        inverse(torch.eye(3, 4, device=CARD))
    print("measured")


def waits_by_step(trainer: Any) -> dict[int, list[str]]:
    """Where each step that a trainer takes from now on waits for the card, in this package."""
    found: dict[int, list[str]] = {}

    def end(step: int) -> None:
        found[step] = [where for where in waits if where.startswith("leco_plugin")]

    at = TrainingCallbackLocation
    begin = TrainingCallback([at.BEFORE_TRAIN_ITERATION], lambda step: waits.clear())
    trainer.callbacks.insert(0, begin)
    trainer.callbacks.append(TrainingCallback([at.AFTER_TRAIN_ITERATION], end))
    return found


def say_waits(name: str, found: list[list[str]]) -> None:
    """Those of the step with the fewest: others save, or measure, too."""
    fewest = min(found, key=len)
    print(f"{name} waits {len(fewest)} times a step:", *sorted(fewest))


def trainer_of(config: Any, scene: Path) -> Any:
    """A trainer on the card, set up."""
    config.data = config.pipeline.datamanager.data = scene
    config.machine.device_type, config.mixed_precision = CARD.split(":")[0], False
    config.save_config()
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    return trainer


def render(trainer: Any) -> None:
    """A whole test photograph."""
    trainer.pipeline.eval()
    camera, batch = trainer.pipeline.datamanager.next_eval_image(0)
    with torch.no_grad():
        outputs = trainer.pipeline.model.get_outputs_for_camera(camera)
        trainer.pipeline.model.get_image_metrics_and_images(outputs, batch)
    assert outputs["rgb"].device == torch.device(CARD)


def leco_occupancy(folder: Path) -> None:
    """The method's whole life: learned, frozen, sharpened, killed, resumed and rendered."""
    scene = tiny_scene.write(folder / "scene")

    def configured(**changes: Any) -> Any:
        config = tiny_config(scene, folder / "runs", 16)
        model = config.pipeline.model
        gate = GateConfig(EncodingConfig(octaves=2), width=8, layers=1, scene_experts=2)
        model.sizes = replace(model.sizes, gate=gate)
        model.schedule = replace(model.schedule, learn_steps=10)
        rays = {"rays": 64, "camera_rays": 16, "recheck_rays": 32, "steps_per_recheck": 4}
        model.calibration = replace(model.calibration, **rays)
        model.sharpening = replace(model.sharpening, steps=3, least_steps=4, rays=64)
        config.max_num_iterations = 30
        for name, value in changes.items():
            setattr(config, name, value)
        return config

    trainer = trainer_of(configured(steps_per_save=20), scene)
    found = waits_by_step(trainer)
    trainer.train()
    say_waits("leco-occupancy, learning,", [found[step] for step in range(5, 9)])
    say_waits("leco-occupancy, guided,", [found[step] for step in range(15, 26)])
    assert trainer.pipeline.model.progress.sharpened_at > 0, "it was not sharpened"
    saved = trainer.checkpoint_dir
    resumed = trainer_of(configured(load_dir=saved, timestamp="resumed"), scene)
    assert bool(resumed.pipeline.model.mixture.frozen), "it was not frozen"
    render(resumed)
    print(f"frozen, sharpened, resumed and rendered on {CARD}")


def guided(name: str, scene: Path, runs: Path) -> None:
    """A host that learns its occupancy first."""
    learning = "pipeline.model.occupancy.learning"
    flags = [*HOSTS[name], *QUICK, *sizes(LEARNING, learning), "--max-num-iterations=12"]
    config: Any = tyro.cli(
        tyro.conf.FlagConversionOff[TrainerConfig],
        default=discover_methods()[0][name],
        args=[*flags, "--pipeline.model.occupancy.rays=64"],
    )
    config.output_dir = runs
    trainer = trainer_of(config, scene)
    found = waits_by_step(trainer)
    trainer.train()
    say_waits(name, [found[step] for step in range(5, 12)])
    render(trainer)
    print(f"{name} guided and rendered on {CARD}")


def main() -> None:
    """What the first argument names."""
    what, *folder = sys.argv[1:]
    with pretended_card():
        if not folder:
            for program in (refusals, sampling, reading, without_float64):
                if program.__name__ == what:
                    program()
        elif what == "leco-occupancy":
            leco_occupancy(Path(folder[0]))
        else:
            scene = tiny_scene.write(Path(folder[0]) / "scene")
            for name in HOSTS:
                guided(name, scene, Path(folder[0]))


if __name__ == "__main__":
    main()
