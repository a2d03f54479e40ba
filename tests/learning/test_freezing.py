"""Claims about what the frozen gate is measured on."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.scene_box import SceneBox

from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.field import FieldConfig
from leco_plugin.learning.calibration import Measured
from leco_plugin.learning.freezing import advice_on
from leco_plugin.learning.held_out_rendering import (
    calibration_rays,
    dense_rendering,
    evaluating,
)
from leco_plugin.models.gate import GateConfig
from leco_plugin.models.leco_config import LecoModelConfig
from leco_plugin.models.sizing.sizes import Sizes
from leco_plugin.scenes.pixels.held_out_pixels import HeldOutPixelSampler, HeldOutPixelSamplerConfig

COUNT = 50


class Manager:
    """A data manager that says which of its rays it gave."""

    def __init__(self, keeps_pixels_back: bool) -> None:
        image = torch.rand(2, 20, 30, 3)
        self.images = {"image": image, "image_idx": torch.arange(2)}
        self.train_pixel_sampler = (
            HeldOutPixelSamplerConfig().setup(num_rays_per_batch=8) if keeps_pixels_back else None
        )
        self.iter_train_image_dataloader = iter([self.images])
        self.train_dataset = SimpleNamespace(cameras=Cameras())

    def next_train(self, step: int) -> tuple[Bundle, dict[str, torch.Tensor]]:
        indices = torch.zeros(COUNT, 3, dtype=torch.int64)
        return Bundle(indices), {"image": torch.zeros(COUNT, 3), "indices": indices}


class Cameras:
    """All of them at once, whose rays are pixels."""

    def to(self, device: str) -> Cameras:
        return self

    def generate_rays(self, camera_indices: torch.Tensor, coords: torch.Tensor) -> Bundle:
        return Bundle(torch.cat([camera_indices, (coords - 0.5).long()], dim=1))


class Bundle:
    """Rays that are the pixels they go through."""

    def __init__(self, indices: torch.Tensor) -> None:
        self.indices = indices

    def __getitem__(self, which: slice) -> Bundle:
        return Bundle(self.indices[which])

    def to(self, device: torch.device) -> torch.Tensor:
        return self.indices


def a_model() -> SimpleNamespace:
    return SimpleNamespace(
        config=SimpleNamespace(calibration=SimpleNamespace(rays=COUNT)),
        device=torch.device("cpu"),
        rays_of=lambda indices, with_images: indices,
    )


def test_the_threshold_is_measured_on_pixels_that_training_never_sees() -> None:
    manager = Manager(keeps_pixels_back=True)
    pixels, colours = calibration_rays(a_model(), manager)
    sampler = manager.train_pixel_sampler
    assert isinstance(sampler, HeldOutPixelSampler) and 5 < len(pixels) <= COUNT
    image, row, column = pixels.T
    assert torch.equal(colours, manager.images["image"][image, row, column])
    trained = sampler.sample(manager.images)["indices"]
    held_out = {tuple(pixel) for pixel in pixels.tolist()}
    assert not held_out & {tuple(pixel) for pixel in trained.tolist()}


def test_without_held_out_pixels_it_is_measured_on_training_rays() -> None:
    pixels, colours = calibration_rays(a_model(), Manager(keeps_pixels_back=False))
    assert len(pixels) == len(colours) == COUNT
    assert not colours.any()


@pytest.mark.parametrize(
    ("threshold", "skipped", "recoveries", "said"),
    [
        (0.0, 0.0, 0, "no threshold"),
        (0.04, 0.004, 0, "hardly anything is skipped, which is right for a scene full of fog"),
        (0.04, 0.004, 1, "hardly anything is skipped; its gate collapsed once before; it learned"),
        (0.0, 0.0, 2, "no threshold keeps the price within its bounds, so nothing is skipped; its"),
        (0.3, 0.8, 1, None),
    ],
)
def test_what_skips_next_to_nothing_comes_with_advice(threshold, skipped, recoveries, said) -> None:
    advice = advice_on(Measured(threshold, 1e-4, 1e-3, 0.01, skipped), 150, recoveries)
    assert (advice is None) == (said is None)
    if advice is not None:  # where that option is differs between methods
        assert advice.startswith(said)
        assert "it learned for 150 steps, and more usually help" in advice
        assert "--pipeline.model of leco-occupancy" in advice
        assert "--pipeline.model.occupancy.learning of guided methods" in advice


def test_prices_are_measured_in_the_appearance_of_each_image() -> None:
    torch.manual_seed(0)
    sizes = Sizes(
        gate=GateConfig(EncodingConfig(octaves=1), width=8, layers=1, scene_experts=2),
        field=FieldConfig(EncodingConfig(kind="hash", log2_table=8), appearance_dim=1),
        learn_candidates=8,
        candidates=16,
    )
    box = SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3]))
    model = LecoModelConfig(sizes=sizes).setup(scene_box=box, num_train_data=2)
    model.field.color.appearance.weight.data = torch.tensor([[500.0], [-500.0]])
    ahead = torch.tensor([[0.0, 0.0, 1.0]]).expand(2, 3)
    bundle = RayBundle(-0.5 * ahead, ahead, torch.ones(2, 1), torch.tensor([[0], [1]]))
    manager = SimpleNamespace(next_train=lambda step: (bundle, {"image": torch.rand(2, 3)}))
    rays, truth = calibration_rays(model, manager)
    with evaluating(model):
        (reference,) = dense_rendering(model, rays, truth).references
        of_the_mean = model.get_outputs(bundle)["rgb"]
    assert torch.equal(of_the_mean[0], of_the_mean[1])
    assert float((reference.rgb[0] - reference.rgb[1]).abs().max()) > 0.05
