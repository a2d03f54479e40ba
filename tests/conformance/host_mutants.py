"""Guided methods that are broken in one way each, and the rule that must say so.

They stand in a distribution of their own (`mutant_plugin.py`), as methods, samplers and adapters of
another package would.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from conformance.estimator_mutants import rank
from conformance.shading_mutants import (
    AsksAsItIs,
    AsksThereToo,
    DropsOneRay,
    FillsUp,
    NearHalf,
    SamplesElsewhere,
    ShadesElsewhere,
    ShadesEverySecond,
    ShadesItsBoxOnly,
    ThinsOneRay,
)
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.datamanagers.base_datamanager import (
    DataManagerConfig,
    VanillaDataManagerConfig,
)
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.models.base_model import Model, ModelConfig
from nerfstudio.models.instant_ngp import InstantNGPModelConfig, NGPModel
from nerfstudio.models.nerfacto import NerfactoModel, NerfactoModelConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig
from nerfstudio.plugins.types import MethodSpecification
from torch import Tensor, nn

from leco_plugin.hosts.guide import Guide
from leco_plugin.hosts.guided import GuidedModelConfig
from leco_plugin.hosts.guided_start import OccupancyConfig
from leco_plugin.hosts.seams import HostAdapter
from leco_plugin.hosts.stand_ins import GuidedEstimator
from leco_plugin.samplers import nerfacc_cpu
from leco_plugin.samplers.marching import Samples
from leco_plugin.samplers.registry import SamplerSpec

PACKED = InstantNGPModelConfig(
    log2_hashmap_size=8,
    max_res=64,
    grid_resolution=8,
    grid_levels=1,
    render_step_size=0.05,
    cone_angle=0.0,
    background_color="white",
)
SCOUT = {"hidden_dim": 8, "log2_hashmap_size": 8, "num_levels": 2, "max_res": 32}
PROPOSAL = NerfactoModelConfig(
    implementation="torch",
    num_levels=2,
    max_res=64,
    log2_hashmap_size=8,
    hidden_dim=16,
    hidden_dim_color=16,
    proposal_net_args_list=[SCOUT, SCOUT],
    num_proposal_samples_per_ray=(24, 16),
    num_nerf_samples_per_ray=32,
)


def packed(
    model: type = NGPModel, sampler: str = "Sound", config: ModelConfig = PACKED
) -> GuidedModelConfig:
    """A small packed host, guided."""
    host = replace(config, _target=model)
    return GuidedModelConfig(host=host, occupancy=OccupancyConfig(sampler=sampler))


def proposal(model: type = NerfactoModel, sampler: str = "SoundProposal") -> GuidedModelConfig:
    """A small proposal host, guided."""
    host = replace(PROPOSAL, _target=model)
    return GuidedModelConfig(host=host, occupancy=OccupancyConfig(sampler=sampler))


class FlatAccumulation(NGPModel):
    def get_outputs(self, ray_bundle: RayBundle) -> dict[str, Any]:
        outputs = super().get_outputs(ray_bundle)
        return outputs | ({} if self.training else {"accumulation": outputs["accumulation"][:, 0]})


class TwoChannels(NGPModel):
    """Of which no picture can be made."""

    def get_outputs(self, ray_bundle: RayBundle) -> dict[str, Any]:
        outputs = super().get_outputs(ray_bundle)
        return outputs | {"flow": outputs["rgb"][:, :2]}


class CountsInImages(NGPModel):
    """Renders in a way of its own, and integers among the rest."""

    def get_outputs_for_camera(self, camera: Any, obb_box: Any = None) -> dict[str, Any]:
        images = super().get_outputs_for_camera(camera, obb_box)
        return images | {"counts": images["num_samples_per_ray"].long()}


class Grainy(NerfactoModel):
    def get_outputs(self, ray_bundle: RayBundle) -> dict[str, Any]:
        outputs = super().get_outputs(ray_bundle)
        grain = 1e-4 * torch.rand_like(outputs["rgb"]) * (not self.training)
        return outputs | {"rgb": outputs["rgb"] + grain}


class NeverShaken(NGPModel):
    """Keeps its sampler in evaluation, say to save the first pass over the densities."""

    def get_outputs(self, ray_bundle: RayBundle) -> dict[str, Any]:
        self.sampler.eval()
        return super().get_outputs(ray_bundle)


class LearnsNothing(NGPModel):
    def get_loss_dict(self, *args: Any, **options: Any) -> dict[str, Tensor]:
        return {name: 0.0 * loss for name, loss in super().get_loss_dict(*args, **options).items()}


class HandsOutItsDummy(NGPModel):
    """Has in its optimizer only what nerfstudio gives to models without parameters."""

    def get_param_groups(self) -> dict[str, list[nn.Parameter]]:
        return {"fields": [self.device_indicator_param]}


class Thaws(NerfactoModel):
    """Has everything trained that it holds."""

    def get_param_groups(self) -> dict[str, list[nn.Parameter]]:
        self.requires_grad_(True)
        return super().get_param_groups()


class KeepsScouts(NerfactoModel):
    """Comes with an adapter that forgets the proposal networks."""


class KeepsGrid(NGPModel):
    """Comes with an adapter that exchanges the grid in one of its two places."""


class HandsOutTheGone(NerfactoModel):
    """Has in an optimizer the proposal networks that it was built with."""

    def populate_modules(self) -> None:
        super().populate_modules()
        self.scouts = [*self.proposal_networks.parameters()]

    def get_param_groups(self) -> dict[str, list[nn.Parameter]]:
        return super().get_param_groups() | {"proposal_networks": self.scouts}


class GuidedTwice(NGPModel):
    """Comes with an adapter that has the gate in the checkpoint twice."""


class DividesByOpacity(NGPModel):
    def get_outputs(self, ray_bundle: RayBundle) -> dict[str, Any]:
        outputs = super().get_outputs(ray_bundle)
        return outputs | {"depth": outputs["depth"] / outputs["accumulation"]}


class SeemsOpaque(NGPModel):
    """Says of a ray that has met nothing that it ended at something."""

    def get_outputs(self, ray_bundle: RayBundle) -> dict[str, Any]:
        outputs = super().get_outputs(ray_bundle)
        met = outputs["accumulation"]
        return outputs | {"accumulation": met.where(met > 0.0, 1.0)}


class ForgetsBackground(NGPModel):
    def get_outputs(self, ray_bundle: RayBundle) -> dict[str, Any]:
        outputs = super().get_outputs(ray_bundle)
        return outputs | {"rgb": outputs["rgb"] * (outputs["accumulation"] > 0.0)}


class Measures(NGPModel):
    """In a unit that it makes up when it is built."""

    def populate_modules(self) -> None:
        super().populate_modules()
        self.unit = float(1.0 + torch.rand(()))

    def get_outputs(self, ray_bundle: RayBundle) -> dict[str, Any]:
        outputs = super().get_outputs(ray_bundle)
        return outputs | {"depth": self.unit * outputs["depth"]}


@dataclass
class WithFunction(InstantNGPModelConfig):
    """A config that no file can hold"""

    activation: Callable[[Any], Any] = field(default_factory=lambda: lambda value: value)


class CountsSteps(NerfactoModel):
    """Weighs its losses by a number that no checkpoint has."""

    steps = 0

    def get_loss_dict(self, *args: Any, **options: Any) -> dict[str, Tensor]:
        self.steps += 1
        losses = super().get_loss_dict(*args, **options)
        return {name: self.steps * loss for name, loss in losses.items()}


class AddsItsSteps(CountsSteps):
    """Tells a loss that grows by such a number, and learns as it should."""

    def get_loss_dict(self, *args: Any, **options: Any) -> dict[str, Tensor]:
        self.steps += 1
        losses = NerfactoModel.get_loss_dict(self, *args, **options)
        return {name: self.steps + loss for name, loss in losses.items()}


class PeeksAtHeldOut(NerfactoModel):
    """Weighs its losses by the first held-out image."""

    weight: Any = 1.0

    def get_training_callbacks(self, training_callback_attributes: Any) -> Any:
        manager = getattr(training_callback_attributes.pipeline, "datamanager", None)
        if getattr(manager, "eval_dataset", None) is not None:
            self.weight = 1.0 + manager.eval_dataset[0]["image"].mean()
        return super().get_training_callbacks(training_callback_attributes)

    def get_loss_dict(self, *args: Any, **options: Any) -> dict[str, Tensor]:
        losses = super().get_loss_dict(*args, **options)
        return {name: self.weight * loss for name, loss in losses.items()}


class LearnsOnFirstRank(NGPModel):
    def get_loss_dict(self, *args: Any, **options: Any) -> dict[str, Tensor]:
        losses = super().get_loss_dict(*args, **options)
        return {name: (rank() == 0) * loss for name, loss in losses.items()}


class GivesNumbers(NerfactoModel):
    """Has a loss that is a plain number for the moment, which nerfstudio's trainer adds."""

    def get_loss_dict(self, *args: Any, **options: Any) -> dict[str, Any]:
        return {**super().get_loss_dict(*args, **options), "regularisation": 0.0}


SOUND = {
    "SoundHost": packed(),
    "SoundProposalHost": proposal(),
    "GivesNumbers": proposal(GivesNumbers),
}
"""What all others are but for one thing, and hosts that keep all rules in another way."""
HOST_MUTANTS: dict[str, dict[str, GuidedModelConfig]] = {
    "outputs-can-be-drawn": {
        "FlatAccumulation": packed(FlatAccumulation),
        "TwoChannels": packed(TwoChannels),
        "CountsInImages": packed(CountsInImages),
    },
    "same-image-in-eval": {"Grainy": proposal(Grainy)},
    "samples-shift-in-training": {"NeverShakenHost": packed(NeverShaken)},
    "teaches-the-host-alone": {
        "LearnsNothing": packed(LearnsNothing),
        "HandsOutItsDummy": packed(HandsOutItsDummy),
        "Thaws": proposal(Thaws),
    },
    "nothing-superfluous-is-left": {
        "KeepsScouts": proposal(KeepsScouts),
        "KeepsGrid": packed(KeepsGrid),
        "GuidedTwice": packed(GuidedTwice),
        "HandsOutTheGone": proposal(HandsOutTheGone),
    },
    "shades-only-what-is-kept": {
        "FillsUp": packed(FillsUp),
        "SamplesElsewhere": packed(SamplesElsewhere),
        "ShadesEverySecond": packed(ShadesEverySecond),
        "ShadesItsBoxOnly": packed(ShadesItsBoxOnly, config=replace(PACKED, cone_angle=0.01)),
        "ShadesElsewhere": packed(ShadesElsewhere),
        "AsksThereToo": packed(AsksThereToo),
        "AsksAsItIs": packed(AsksAsItIs),
        "DropsOneRayHost": packed(sampler="DropsOneRay"),
        "UniformHost": proposal(sampler="Uniform"),
    },
    "state-and-yaml-round-trip": {
        "Measures": packed(Measures),
        "WithFunction": packed(config=WithFunction(**vars(PACKED))),
    },
    "empty-rays-show-background": {
        "DividesByOpacity": packed(DividesByOpacity),
        "ForgetsBackground": packed(ForgetsBackground),
        "SeemsOpaque": packed(SeemsOpaque),
    },
    "guided-by-everything-is-dense": {
        "ThinsOneRayHost": packed(sampler="ThinsOneRay"),
        "NearHalfHost": proposal(sampler="NearHalf"),
    },
    "held-out-images-teach-nothing": {"PeeksAtHeldOut": proposal(PeeksAtHeldOut)},
    "resumes-where-it-stopped": {
        "CountsSteps": proposal(CountsSteps),
        "AddsItsSteps": proposal(AddsItsSteps),
    },
    "two-processes-step-alike": {"LearnsOnFirstRank": packed(LearnsOnFirstRank)},
}
"""By the rule that must fail, methods by name."""
ALSO = {"DropsOneRayHost": {"guided-by-everything-is-dense"}}
"""What else cannot hold for a mutant."""
METHODS = {
    **SOUND,
    "Unguided": PACKED,
    **{name: model for family in HOST_MUTANTS.values() for name, model in family.items()},
}
SAMPLERS = {
    "DropsOneRay": SamplerSpec("", estimator=DropsOneRay, needs_occupancy=True),
    "ThinsOneRay": SamplerSpec("", estimator=ThinsOneRay, needs_occupancy=True),
    "NearHalf": SamplerSpec("", proposal=NearHalf, needs_occupancy=True),
}


def _exchange_sampler_only(host: Any, guide: Guide) -> None:
    old = host.proposal_sampler
    host.proposal_sampler = guide.proposal(
        num_samples=old.num_nerf_samples_per_ray, initial_sampler=old.initial_sampler
    )


def _exchange_once(host: Any, guide: Guide) -> None:
    nerfacc_cpu.install()
    host.sampler.occupancy_grid = guide.estimator(host.scene_aabb.detach())


class WithoutFrame(GuidedEstimator):
    def sampling(self, rays_o: Tensor, rays_d: Tensor, *args: Any, **options: Any) -> Samples:
        sampler: Any = self.sampler
        return sampler.sampling(rays_o, rays_d, *args, **options)


def _exchange_without_frame(host: Any, guide: Guide) -> None:
    nerfacc_cpu.install()
    host.occupancy_grid = host.sampler.occupancy_grid = WithoutFrame(guide, None)


def _exchange_and_hold(host: Any, guide: Guide) -> None:
    _exchange_once(host, guide)
    host.occupancy_grid = host.sampler.occupancy_grid
    host.my_guide = guide


def _adapter(kind: type[Model], swap: Callable[[Any, Guide], None]) -> HostAdapter:
    return HostAdapter(kind.__name__, lambda host: isinstance(host, kind), swap)


ADAPTERS = {
    "forgets_scouts": _adapter(KeepsScouts, _exchange_sampler_only),
    "forgets_grid": _adapter(KeepsGrid, _exchange_once),
    "guides_twice": _adapter(GuidedTwice, _exchange_and_hold),
    "asks_as_it_is": _adapter(AsksAsItIs, _exchange_without_frame),
}


READ_FILES = "PeeksAtHeldOut", "GivesNumbers"


def _method(name: str, model: ModelConfig) -> MethodSpecification:
    rate = {
        "optimizer": AdamOptimizerConfig(lr=1e-2),
        "scheduler": ExponentialDecaySchedulerConfig(lr_final=1e-3, max_steps=100),
    }
    # others read no files, which takes a second each
    data = VanillaDataManagerConfig() if name in READ_FILES else DataManagerConfig()
    config = TrainerConfig(
        method_name=name,
        pipeline=VanillaPipelineConfig(model=model, datamanager=data),
        optimizers={group: rate for group in ("fields", "proposal_networks", "camera_opt")},
    )
    return MethodSpecification(config, name)


def __getattr__(name: str) -> Any:
    """Entry points name what they mean in lower case, adapters as they are called."""
    for title, model in METHODS.items():
        if title.lower() == name:
            return _method(title, model)
    found = {**{title.lower(): spec for title, spec in SAMPLERS.items()}, **ADAPTERS}
    if name not in found:
        raise AttributeError(name)
    return found[name]
