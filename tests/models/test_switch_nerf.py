"""A Switch-NeRF that nerfstudio can train, and whose sampling one call replaces."""

from __future__ import annotations

import copy
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import ball_occupancy
import pytest
import torch
import yaml
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.engine.callbacks import TrainingCallbackAttributes
from torch import Tensor

from leco_plugin.host_configs import switch_nerf
from leco_plugin.models.switch.field import SwitchFieldConfig, SwitchNerfModelConfig, SwitchSizes
from leco_plugin.models.switch_nerf import SwitchNerfModel
from leco_plugin.samplers.base import DenseEstimator
from leco_plugin.samplers.estimator import LearnedOccupancyEstimator
from leco_plugin.samplers.grid import OccupancyGridEstimator
from leco_plugin.scenes.bounds import SceneBounds
from leco_plugin.scenes.input_error import InputError
from leco_plugin.space import SpaceKind

TINY = SwitchSizes(
    field=SwitchFieldConfig(
        octaves=4, experts=3, width=16, layers=3, skip=1, color_width=16, appearance_dim=4
    ),
    coarse=12,
    fine=12,
    candidates=24,
    grid_resolution=12,
)
SAMPLINGS = ("coarse-fine", "occupancy-grid")
BOX = SceneBounds("box", torch.zeros(3), 1.0, 0.1, 4.0, torch.tensor([-1.0] * 3 + [1.0] * 3), "")
NO_WALLS = torch.tensor([-1e6] * 3 + [1e6] * 3)
UNBOUNDED = SceneBounds("contraction", torch.zeros(3), 1.0, 0.1, 20.0, NO_WALLS, "")


def new_model(bounds: SceneBounds = BOX, **options: Any) -> SwitchNerfModel:
    torch.manual_seed(0)
    config = SwitchNerfModelConfig(sizes=TINY, **options)
    box = SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3]))
    model: SwitchNerfModel = config.setup(scene_box=box, num_train_data=3)
    model.set_bounds(bounds, 2.0)
    return model


def bundle(count: int = 10, away: bool = False) -> RayBundle:
    """Rays from beside the box into it, or away from it."""
    generator = torch.Generator().manual_seed(1)
    origins = torch.tensor([[-2.0, 0.0, 0.0]]).repeat(count, 1)
    directions = torch.randn(count, 3, generator=generator) * 0.2 + torch.tensor(
        [-1.0 if away else 1.0, 0.0, 0.0]
    )
    directions = torch.nn.functional.normalize(directions, dim=-1)
    images = torch.arange(count)[:, None] % 3
    return RayBundle(origins, directions, torch.ones(count, 1), camera_indices=images)


def updated(model: SwitchNerfModel) -> SwitchNerfModel:
    """The model after its callback has run once, as before the first training step."""
    model.update_estimator(step=0)
    return model


def loss_of(model: SwitchNerfModel, rays: RayBundle) -> Tensor:
    outputs = model(rays)
    batch = {"image": torch.rand(len(rays), 3)}
    return sum(model.get_loss_dict(outputs, batch).values(), torch.zeros(()))


class KeepsNothing(DenseEstimator):
    def questions(self):
        return lambda positions: torch.zeros(len(positions), dtype=torch.bool), None


@pytest.mark.parametrize("bounds", [BOX, UNBOUNDED], ids=["box", "unbounded"])
@pytest.mark.parametrize("sampling", SAMPLINGS)
@pytest.mark.parametrize("count", [0, 1, 10])
def test_rays_become_pixels_and_losses_reach_every_part(sampling, bounds, count) -> None:
    model = updated(new_model(bounds, sampling=sampling))
    outputs = model(bundle(count))
    for name, width in {"rgb": 3, "depth": 1, "accumulation": 1, "samples_per_ray": 1}.items():
        assert outputs[name].shape == (count, width)
        assert outputs[name].dtype == torch.float32 and bool(outputs[name].isfinite().all())
    if count == 0:  # no mean of nothing
        return
    losses = model.get_loss_dict(outputs, {"image": torch.rand(count, 3)})
    assert losses.keys() == {"rgb_loss", "gate_loss"}
    sum(losses.values()).backward()
    gradients = {name: p.grad for name, p in model.field.named_parameters()}
    for part in (
        "projection.weight",
        "gate.head.weight",
        "density_head.weight",
        "color.out.weight",
    ):
        gradient = gradients[part]
        assert gradient is not None and bool(gradient.isfinite().all() and gradient.any())
    model.eval()
    assert model(bundle(count))["expert"].shape == (count, 1)


@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_evaluation_is_deterministic_and_training_is_stratified_and_noisy(sampling) -> None:
    model = updated(new_model(sampling=sampling))
    assert not torch.equal(model(bundle())["rgb"], model(bundle())["rgb"])
    model.eval()
    torch.manual_seed(5)
    first = model(bundle())
    torch.rand(3)
    second = model(bundle())
    for name in ("rgb", "depth", "accumulation", "samples_per_ray", "expert"):
        assert torch.equal(first[name], second[name])


@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_in_half_precision_losses_and_pixels_stay_float32(sampling) -> None:
    full = updated(new_model(sampling=sampling)).eval()
    half = copy.deepcopy(full)
    full.precision, half.precision = "float32", "bfloat16"
    torch.testing.assert_close(half(bundle())["rgb"], full(bundle())["rgb"], atol=0.05, rtol=0)
    outputs = half.train()(bundle())
    losses = half.get_loss_dict(outputs, {"image": torch.rand(10, 3)})
    assert outputs["rgb"].dtype == torch.float32
    assert all(loss.dtype == torch.float32 for loss in losses.values())
    sum(losses.values()).backward()
    gradients = [p.grad for p in half.field.parameters() if p.grad is not None]
    assert all(bool(gradient.isfinite().all()) for gradient in gradients)


@pytest.mark.parametrize("training", [False, True])
def test_noise_and_limited_places_are_for_training(training: bool) -> None:
    model = new_model(capacity_factor=1.0, sigma_noise=0.7).train(training)
    asked = []
    model.field.register_forward_pre_hook(lambda module, inputs: asked.append(inputs[1:]))
    model(bundle())
    assert asked == [(0.7, 1.0) if training else (0.0, None)] * 2


def test_the_training_image_decides_the_colour_and_evaluation_does_not_know_it() -> None:
    model = new_model(sigma_noise=0.0)
    assert model.field.color.appearance is not None
    torch.nn.init.normal_(model.field.color.appearance.weight, std=20.0)
    first, other = bundle(), bundle()
    other.camera_indices = (first.camera_indices + 1) % 3
    pixels = []
    for rays in (first, other):
        torch.manual_seed(2)
        pixels.append(model(rays)["rgb"])
    assert not torch.allclose(*pixels, atol=1e-3)
    model.eval()
    assert torch.equal(model(first)["rgb"], model(other)["rgb"])


def test_rays_without_samples_have_the_backdrops_colour_and_finite_gradients() -> None:
    model = new_model()
    model.sample_with(KeepsNothing())
    outputs = model(bundle())
    assert not bool(outputs["accumulation"].any())
    assert bool((outputs["samples_per_ray"] == 1.0).all())
    torch.testing.assert_close(outputs["depth"][:, 0], outputs["rays"].t_maxs)
    loss_of(model, bundle()).backward()
    gradients = [p.grad for p in model.parameters() if p.grad is not None]
    assert gradients and all(bool(gradient.isfinite().all()) for gradient in gradients)


@pytest.mark.parametrize("estimator", [None, KeepsNothing, DenseEstimator])
def test_rays_that_miss_the_scene_learn_a_sky_and_meet_nothing(estimator) -> None:
    model = new_model()
    model.sample_with(None if estimator is None else estimator())
    outputs = model(bundle(away=True))
    assert not bool(outputs["accumulation"].any())
    torch.testing.assert_close(outputs["depth"], torch.full((10, 1), 4.0))
    outputs["rgb"].sum().backward()
    gradient = model.field.color.out.weight.grad
    assert gradient is not None and bool(gradient.isfinite().all() and gradient.any())


def test_any_estimator_takes_the_place_of_the_own_sampling_and_gives_it_back() -> None:
    model = new_model().eval()
    own = model(bundle())
    model.sample_with(DenseEstimator())
    assert model.occupancy_grid is not None and not model.occupancy_grid.training
    dense = model(bundle())
    torch.testing.assert_close(own["rgb"], dense["rgb"], atol=0.05, rtol=0)
    assert len(own["samples_per_ray"].unique()) == 1 < len(dense["samples_per_ray"].unique())
    assert [len(group) for group in model.get_param_groups().values()] == [
        len(list(model.field.parameters()))
    ]
    model.sample_with(None)
    assert torch.equal(model(bundle())["rgb"], own["rgb"])


def test_a_learned_occupancy_guides_it_and_gets_no_gradient() -> None:
    occupancy = copy.deepcopy(ball_occupancy.ball())
    centre = torch.tensor(ball_occupancy.CENTRE)
    bounds = SceneBounds("box", centre, 2.0, 0.1, 6.0, NO_WALLS, "")
    model = new_model(bounds)
    model.sample_with(LearnedOccupancyEstimator(occupancy, cache_bytes=0).requires_grad_(False))
    rays = bundle()
    rays.origins = rays.origins + centre
    outputs = updated(model)(rays)
    sum(model.get_loss_dict(outputs, {"image": torch.rand(10, 3)}).values()).backward()
    assert 1.0 < float(outputs["samples_per_ray"].mean()) < 24.0
    assert all(p.grad is None for p in model.occupancy_grid.parameters())
    assert model.field.density_head.weight.grad is not None


def test_pruning_leaves_out_of_training_what_an_opaque_surface_hides() -> None:
    shaded = []
    for early_stop_eps in (0.0, 1e-4):
        model = new_model(early_stop_eps=early_stop_eps)
        model.sample_with(DenseEstimator())
        torch.nn.init.constant_(model.field.density_head.bias, 1e4)
        shaded.append(model(bundle())["samples_per_ray"].max())
        assert float(model.eval()(bundle())["samples_per_ray"].max()) > 3.0
    assert float(shaded[1]) <= 3.0 < float(shaded[0])


@pytest.mark.parametrize("bounds", [BOX, UNBOUNDED], ids=["box", "unbounded"])
@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_a_checkpoint_brings_back_the_same_pixels(sampling, bounds, tmp_path: Path) -> None:
    model = updated(new_model(bounds, sampling=sampling))
    torch.save(model.state_dict(), tmp_path / "state.pt")
    torch.manual_seed(9)
    config = SwitchNerfModelConfig(sizes=TINY, sampling=sampling)
    box = SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3]))
    other: SwitchNerfModel = config.setup(scene_box=box, num_train_data=3)
    other.load_state_dict(torch.load(tmp_path / "state.pt"))
    model.eval()
    other.eval()
    for name in ("rgb", "depth", "accumulation", "expert"):
        assert torch.equal(model(bundle())[name], other(bundle())[name])
    if isinstance(other.occupancy_grid, OccupancyGridEstimator):
        assert other.occupancy_grid.levels == (1 if bounds is BOX else 4)
        assert bool(other.occupancy_grid.binaries.any())
    assert bool(other.region.known)


@pytest.mark.parametrize("kind", ["box", "contraction"])
def test_a_density_is_that_of_the_scenes_units(kind: SpaceKind) -> None:
    model = new_model(SceneBounds(kind, torch.zeros(3), 4.0, 0.1, 4.0, NO_WALLS, ""))
    positions = torch.rand(6, 3) * 8 - 4
    model.precision = "float32"
    mapped = positions / (4.0 if kind == "box" else 8.0)
    asked = model.field(mapped).sigmas[:, None] / 4.0
    torch.testing.assert_close(model.density_fn(positions), asked)
    step = float(model.step if kind == "box" else model.cone * 4.0)
    torch.testing.assert_close(model.opacity_of_a_step(positions), asked * step)


@pytest.mark.parametrize("range_", [{"near": 0.0}, {"near": 1e4}, {"far": 1e-4}])
def test_an_empty_range_of_rays_is_refused(range_: dict[str, float]) -> None:
    poses = torch.eye(4)[:3].repeat(3, 1, 1)
    poses[:, :, 3] = torch.eye(3)
    dataset = SimpleNamespace(cameras=Cameras(poses, 20.0, 20.0, 8.0, 8.0, 16, 16), metadata={})
    pipeline = SimpleNamespace(datamanager=SimpleNamespace(train_dataset=dataset))
    attributes = TrainingCallbackAttributes(None, None, pipeline, None)  # type: ignore[arg-type]
    model = new_model(**range_)
    model.region.known.fill_(False)
    with pytest.raises(InputError, match="0 < near < far"):
        model.get_training_callbacks(attributes)


def test_a_loss_that_is_not_finite_names_its_cause() -> None:
    model = new_model()
    with pytest.raises(FloatingPointError, match="training image"):
        model.get_loss_dict(model(bundle()), {"image": torch.full((10, 3), torch.nan)})


def test_colours_come_with_what_was_met_as_their_alpha() -> None:
    model = new_model().eval()
    outputs = model(bundle())
    outputs["accumulation"][0] = 1.0  # an untrained field meets next to nothing
    rgba = model.get_rgba_image(outputs)
    assert torch.equal(rgba[:, :3], outputs["rgb"])
    assert torch.equal(rgba[:, 3:], outputs["accumulation"])


def test_the_method_survives_yaml() -> None:
    config = copy.deepcopy(switch_nerf.config)
    assert yaml.load(yaml.dump(config), Loader=yaml.Loader) == config
    assert config.method_name == "switch-nerf"


@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_the_method_learns_saves_and_is_evaluated(sampling, tiny_scene: Path, tmp_path) -> None:
    config = copy.deepcopy(switch_nerf.config)
    config.pipeline.datamanager.data = tiny_scene
    config.pipeline.datamanager.train_num_rays_per_batch = 256
    config.pipeline.model = SwitchNerfModelConfig(sizes=TINY, sampling=sampling)
    config.output_dir, config.vis = tmp_path, "tensorboard"
    config.logging.local_writer.enable = False
    config.set_timestamp()
    config.save_config()
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    attributes = TrainingCallbackAttributes(
        optimizers=trainer.optimizers,
        grad_scaler=trainer.grad_scaler,
        pipeline=trainer.pipeline,
        trainer=trainer,
    )
    callbacks = trainer.pipeline.get_training_callbacks(attributes)
    torch.manual_seed(0)
    losses = []
    for step in range(25):
        for callback in callbacks:
            callback.run_callback(step)
        losses.append(float(trainer.train_iteration(step)[0].detach()))
    assert sum(losses[-5:]) < 0.75 * sum(losses[:5])
    trainer.save_checkpoint(24)
    stored = yaml.load((config.get_base_dir() / "config.yml").read_text(), Loader=yaml.Loader)
    pipeline = stored.pipeline.setup(device="cpu", test_mode="test")
    checkpoint = torch.load(stored.get_checkpoint_dir() / "step-000000024.ckpt")
    pipeline.load_pipeline(checkpoint["pipeline"], checkpoint["step"])
    pipeline.eval()
    figures = pipeline.get_average_eval_image_metrics()
    assert figures["psnr"] > 8.0 and -1.0 <= figures["ssim"] <= 1.0
