"""Claims about a host whose sampler was swapped: what it keeps, and what is gone from it."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from ball_occupancy import ball_of_the_tiny_scene
from nerfacc import OccGridEstimator
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.engine.callbacks import TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.fields.density_fields import HashMLPDensityField
from nerfstudio.model_components.ray_samplers import ProposalNetworkSampler
from nerfstudio.model_components.renderers import background_color_override_context
from nerfstudio.models.base_model import Model
from nerfstudio.models.instant_ngp import NGPModel
from small_hosts import SMALL, pipeline_of, small, unswapped
from torch import Tensor, nn

from leco_plugin.conformance.hosts import bundle, model_arguments
from leco_plugin.hosts.guide import Guide
from leco_plugin.hosts.guided import GuidedModelConfig
from leco_plugin.hosts.stand_ins import GuidedEstimator
from leco_plugin.occupancy import BACKDROP_PRICE
from leco_plugin.samplers import estimator
from leco_plugin.swap import with_sampler_swapped

SUPERFLUOUS = {
    "instant-ngp": ("occupancy_grid.", "sampler.occupancy_grid."),
    "nerfacto": ("proposal_networks.",),
    "switch-nerf": (),
    "elsewhere-packed": ("gatekeeper.", "walker.occupancy_grid."),
    "elsewhere-proposal": ("far_scout.", "near_scout."),
    "elsewhere-places": (),
}
"""What a frozen gate stands for in each host's state."""
PROPOSAL_LOSS = {"nerfacto": {"interlevel_loss"}, "elsewhere-proposal": {"scout_loss"}}
PROPOSAL_GROUP = {"nerfacto": {"proposal_networks"}, "elsewhere-proposal": {"scouts"}}
SEED = 0
BEFORE = TrainingCallbackLocation.BEFORE_TRAIN_ITERATION


@dataclass
class Pair:
    """A host with its own sampler, and the same host guided."""

    name: str
    own: Any
    guided: Any

    def steps(self) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """The losses of one training step of each."""
        return tuple(p.get_train_loss_dict(0)[1] for p in (self.own, self.guided))  # type: ignore[return-value]


@pytest.fixture(scope="module")
def short() -> Iterator[None]:
    """The gate is asked directly: building its cell cache would take longer than all that is done
    here."""

    def refuse(*arguments: object, **options: object) -> None:
        raise ValueError("a test is short")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(estimator, "build_cache", refuse)
        yield


@pytest.fixture(scope="module", params=SMALL)
def pair(
    request: pytest.FixtureRequest,
    short: None,
    elsewhere: Path,
    tiny_scene: Path,
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[Pair]:
    name = request.param
    file = tmp_path_factory.mktemp("occupancy") / "occupancy.safetensors"
    ball_of_the_tiny_scene().save(file)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(elsewhere)
        torch.manual_seed(SEED)
        own = unswapped(name, tiny_scene)
        torch.manual_seed(SEED)
        guided: Any = pipeline_of(with_sampler_swapped(small(name), file), tiny_scene)
        for pipeline in (own, guided):
            pipeline.train()
            attributes = TrainingCallbackAttributes(None, None, pipeline, None)  # type: ignore[arg-type]
            for callback in pipeline.get_training_callbacks(attributes):
                callback.run_callback_at_location(0, BEFORE)
        yield Pair(name, own, guided)


class HasAGuide(NGPModel):
    """Calls something of its own a guide."""

    def populate_modules(self) -> None:
        super().populate_modules()
        self.guide = nn.Linear(2, 2)


MAGENTA = torch.tensor([1.0, 0.0, 1.0])


def test_a_crop_that_rays_do_not_meet_leaves_the_background(pair: Pair) -> None:
    """Behind the cameras of any host, and beyond the far plane of hosts that end there."""
    renders_as_nerfstudio = hasattr(pair.guided.model, "renderer_rgb")
    ends = pair.name not in ("nerfacto", "elsewhere-proposal", "elsewhere-places")
    camera = pair.guided.datamanager.eval_dataset.cameras[:1]
    origin, back = camera.camera_to_worlds[0, :, 3], camera.camera_to_worlds[0, :, 2]
    pair.guided.eval()
    for away in (50.0, -50.0) if ends else (50.0,):
        middle = (origin + away * back).tolist()
        box = OrientedBox.from_params(tuple(middle), (0.0, 0.0, 0.0), (4.0, 4.0, 4.0))
        with background_color_override_context(MAGENTA):
            outputs = pair.guided.model.get_outputs_for_camera(camera, obb_box=box)
        assert float(outputs["accumulation"].max()) == 0.0
        if renders_as_nerfstudio:
            torch.testing.assert_close(outputs["rgb"], MAGENTA.expand_as(outputs["rgb"]))
    pair.guided.train()


def test_a_backdrop_that_no_training_ray_saw_is_black_and_one_that_some_saw_stays(
    pair: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No camera looks up; all see the distance beyond the floor."""
    model = pair.guided.model
    guide = model.leco_guide
    monkeypatch.setitem(guide.the_occupancy().report, BACKDROP_PRICE, 9.0)
    pair.guided.eval()
    photographed = pair.guided.datamanager.train_dataset.cameras[:1]
    up = copy.copy(photographed)
    up.camera_to_worlds = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))[None, :3]
    outputs = model.get_outputs_for_camera(up)
    assert float(outputs["rgb"].max()) == float(outputs["accumulation"].max()) == 0.0
    here = model.get_outputs_for_camera(photographed)["rgb"]
    every = torch.full_like(guide.backdrops.limits, 2.0)
    monkeypatch.setattr(guide.backdrops, "limits", every)
    torch.testing.assert_close(model.get_outputs_for_camera(photographed)["rgb"], here)
    assert float(model.get_outputs_for_camera(up)["rgb"].max()) > 0.0
    pair.guided.train()


def test_what_guides_a_host_takes_the_place_of_nothing_that_it_has() -> None:
    config: Any = with_sampler_swapped(small("instant-ngp"), Path("none")).pipeline
    host = replace(config.model.host, _target=HasAGuide)
    model = replace(config.model, host=host).setup(**model_arguments())
    assert isinstance(model.guide, nn.Linear)
    assert isinstance(model.leco_guide, Guide)


@pytest.mark.parametrize("sampler", ["own", "dense"])
def test_a_host_renders_as_many_rays_at_a_time_as_are_asked_for(sampler: str) -> None:
    config: Any = with_sampler_swapped(small("instant-ngp"), Path("none")).pipeline.model
    config.occupancy.sampler = sampler
    of_host = config.host.eval_num_rays_per_chunk
    for asked, expected in ((7, 7), (None, of_host)):
        config.eval_num_rays_per_chunk = asked
        made = config.setup(**model_arguments())
        assert made.config.eval_num_rays_per_chunk == expected
    assert config.host.eval_num_rays_per_chunk == of_host


class TakesABatch(NGPModel):
    """May be told the batch that its rays are of."""

    def forward(self, ray_bundle: Any, batch: Any = None, *, scale: float = 1.0) -> dict[str, Any]:
        return super().forward(ray_bundle) | {"batch": batch, "scale": scale}


@pytest.mark.parametrize("sampler", ["own", "dense"])
def test_what_a_hosts_forward_takes_beside_rays_reaches_it(sampler: str) -> None:
    config: Any = with_sampler_swapped(small("instant-ngp"), Path("none")).pipeline
    host = replace(config.model.host, _target=TakesABatch)
    occupancy = replace(config.model.occupancy, sampler=sampler)
    model = replace(config.model, host=host, occupancy=occupancy).setup(**model_arguments()).eval()
    with torch.no_grad():
        outputs = model(bundle(), {"image": 3}, scale=2.0)
    assert outputs["batch"] == {"image": 3} and outputs["scale"] == 2.0


def bundle_of(pipeline: Any) -> Any:
    """Rays of a whole camera, [H, W]."""
    cameras = pipeline.datamanager.train_dataset.cameras
    return cameras.generate_rays(camera_indices=0, keep_shape=True)


def kinds(outputs: dict[str, Any]) -> dict[str, Any]:
    """Names of outputs, and the shapes of those that are images."""
    return {n: v.shape[1:] if isinstance(v, Tensor) else type(v) for n, v in outputs.items()}


def test_the_host_keeps_its_class_and_its_outputs(pair: Pair) -> None:
    own, guided = pair.own.model, pair.guided.model
    native = type(own).__bases__[-1]
    assert isinstance(guided, native) and type(guided).__name__ == native.__name__
    assert type(guided.config) is type(own.config)
    batch, _ = pair.guided.datamanager.next_train(0)
    assert kinds(guided(batch)) == kinds(own(batch))
    pair.guided.eval(), pair.own.eval()
    with torch.no_grad():
        rays = bundle_of(pair.own)
        found, expected = (m.get_outputs_for_camera_ray_bundle(rays) for m in (guided, own))
    pair.guided.train(), pair.own.train()
    assert {n: v.shape for n, v in found.items()} == {n: v.shape for n, v in expected.items()}
    assert all(bool(image.isfinite().all()) for image in found.values())


def test_every_image_is_one_that_ns_render_can_draw(pair: Pair) -> None:
    pair.guided.eval()
    with torch.no_grad():
        images = pair.guided.model.get_outputs_for_camera_ray_bundle(bundle_of(pair.guided))
    pair.guided.train()
    assert all(image.is_floating_point() for image in images.values())


def test_what_the_gate_makes_superfluous_is_gone(pair: Pair) -> None:
    own, guided = pair.own.model, pair.guided.model
    before, after = set(own.state_dict()), set(guided.state_dict())
    superfluous = {name for name in before if name.startswith(SUPERFLUOUS[pair.name] or "-")}
    assert bool(superfluous) == bool(SUPERFLUOUS[pair.name])
    assert before - after == superfluous
    assert all(name.startswith("leco_guide.") for name in after - before)
    parts = (OccGridEstimator, ProposalNetworkSampler, HashMLPDensityField)
    assert not any(isinstance(module, parts) for module in guided.modules())
    trained = {name for name, p in own.named_parameters() if p.requires_grad}
    kept = {name for name, p in guided.named_parameters() if p.requires_grad}
    assert kept == trained - superfluous


def test_what_is_trained_is_the_host_without_its_sampling(pair: Pair) -> None:
    own, guided = pair.own.model, pair.guided.model
    groups = guided.get_param_groups()
    assert groups.keys() == own.get_param_groups().keys() - PROPOSAL_GROUP.get(pair.name, set())
    assert all(groups.values())
    gate = {id(parameter) for parameter in guided.leco_guide.parameters()}
    assert gate
    handed_out = [id(parameter) for group in groups.values() for parameter in group]
    assert not gate & set(handed_out)
    names = {id(parameter): name for name, parameter in guided.named_parameters()}
    needed = {id(p) for p in guided.parameters() if p.requires_grad and p.numel()}
    assert needed <= set(handed_out) <= set(names)


def test_a_step_teaches_the_host_and_not_the_gate(pair: Pair) -> None:
    before = {n: p.clone() for n, p in pair.guided.model.leco_guide.named_parameters()}
    own, guided = pair.steps()
    assert guided.keys() == own.keys() - PROPOSAL_LOSS.get(pair.name, set())
    assert all(bool(loss.isfinite()) for loss in guided.values())
    pair.guided.zero_grad()
    torch.stack(list(guided.values())).sum().backward()
    grads = {n: p.grad for n, p in pair.guided.model.named_parameters() if p.grad is not None}
    assert grads and all(bool(grad.isfinite().all()) for grad in grads.values())
    assert any(bool(grad.any()) for grad in grads.values())
    assert not any(name.startswith("leco_guide.") for name in grads)
    after = dict(pair.guided.model.leco_guide.named_parameters())
    assert before.keys() == after.keys()
    assert all(torch.equal(before[name], after[name]) for name in before)


def test_a_batch_that_meets_nothing_is_trained_on(pair: Pair) -> None:
    rays, batch = pair.guided.datamanager.next_train(0)
    rays.directions = torch.tensor([0.0, 0.0, 1.0]).expand_as(rays.directions)  # up, past the ball
    model = pair.guided.model
    outputs = model(rays)
    metrics = model.get_metrics_dict(outputs, batch)
    losses = model.get_loss_dict(outputs, batch, metrics)
    pair.guided.zero_grad()
    torch.stack(list(losses.values())).sum().backward()
    grads = [p.grad for p in model.parameters() if p.grad is not None]
    assert all(bool(grad.isfinite().all()) for grad in grads)


def kept_share(pipeline: Any, occupancy: Any) -> float:
    """Share of the samples shaded for one camera that lie where the occupancy keeps something."""
    shaded: list[Tensor] = []
    field = getattr(pipeline.model, "field", None) or pipeline.model.matter
    get_density = field.get_density

    def watched(samples: Any) -> Any:
        shaded.append(samples.frustums.get_positions().reshape(-1, 3))
        return get_density(samples)

    field.get_density = watched
    pipeline.eval()
    with torch.no_grad():
        pipeline.model(bundle_of(pipeline).flatten())
    pipeline.train()
    del field.get_density
    return float(occupancy(torch.cat(shaded)).float().mean())


def test_it_shades_where_the_occupancy_keeps_something(pair: Pair) -> None:
    if pair.name == "switch-nerf":
        pytest.skip("its backdrops are shaded whatever an occupancy says: see test_switch_nerf")
    guide = pair.guided.model.leco_guide
    turn, shift = guide.frame.split([3, 1], dim=1)

    def occupied(positions: Tensor) -> Tensor:
        return guide.followed().occupied(positions @ turn.T + shift[:, 0])

    found, before = kept_share(pair.guided, occupied), kept_share(pair.own, occupied)
    packed = any(isinstance(module, GuidedEstimator) for module in pair.guided.model.modules())
    assert found == 1.0 if packed else found > 1.5 * before > 0.0


def test_a_config_says_everything_in_yaml(pair: Pair, tmp_path: Path) -> None:
    config = with_sampler_swapped(small(pair.name), tmp_path / "occupancy.safetensors")
    again = yaml.load(yaml.dump(config), Loader=yaml.Loader)
    assert again == config
    assert isinstance(again.pipeline.model, GuidedModelConfig)
    assert type(again.pipeline.model.host) is type(small(pair.name).pipeline.model)


def test_a_state_brings_its_own_gate(pair: Pair, tiny_scene: Path) -> None:
    nowhere = Path("no/such/occupancy.safetensors")
    empty: Any = pipeline_of(with_sampler_swapped(small(pair.name), nowhere), tiny_scene)
    model: Model = empty.model
    with pytest.raises(RuntimeError, match="has no occupancy yet"):
        empty.get_train_loss_dict(0)
    empty.load_state_dict(pair.guided.state_dict())
    positions = torch.rand(500, 3) - 0.5
    assert torch.equal(
        model.leco_guide.the_occupancy().query(positions),
        pair.guided.model.leco_guide.the_occupancy().query(positions),
    )
    assert torch.equal(model.leco_guide.frame, pair.guided.model.leco_guide.frame)
    assert model.get_param_groups().keys() == pair.guided.model.get_param_groups().keys()
    assert all(
        len(group) == len(pair.guided.model.get_param_groups()[name])
        for name, group in model.get_param_groups().items()
    )
    empty.get_train_loss_dict(0)
