"""Claims about what the frozen gate is measured on."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.pixel_samplers import PixelSamplerConfig
from small_learner import SMALLEST, NoPixels, small_mixture

from leco_plugin.learning import held_out as module
from leco_plugin.learning.calibration import THRESHOLDS, CalibrationConfig, lost_by_each, measure
from leco_plugin.learning.dense import dense_reference, dense_rendering, evaluating
from leco_plugin.learning.held_out import HeldOut
from leco_plugin.learning.quality import FIELD, ONE_COLOUR
from leco_plugin.learning.sharpening import SharpeningConfig
from leco_plugin.models.objective import GateLossConfig
from leco_plugin.occupancy import TESTS_LOSE
from leco_plugin.scenes import learning_data
from leco_plugin.scenes.learning_data import count_held_out, held_out_bundle, held_out_rays
from leco_plugin.scenes.pixels.held_out_pixels import HeldOutPixelSampler

COUNT = 50


class Pixels:
    """A data manager whose rays are the pixels [R, 3] that they go through."""

    def __init__(self, keeps_pixels_back: bool) -> None:
        image = torch.rand(2, 20, 30, 3)
        self.images = {"image": image, "image_idx": torch.arange(2)}
        self.train_pixel_sampler = (
            PixelSamplerConfig(HeldOutPixelSampler).setup(num_rays_per_batch=8)
            if keeps_pixels_back
            else None
        )
        self.iter_train_image_dataloader = iter([self.images])
        cameras = SimpleNamespace(to=lambda device: cameras, generate_rays=self.generate_rays)
        self.train_dataset = SimpleNamespace(cameras=cameras)

    def generate_rays(self, camera_indices: torch.Tensor, coords: torch.Tensor) -> torch.Tensor:
        return torch.cat([camera_indices, (coords - 0.5).long()], dim=1)

    def next_train(self, step: int) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        indices = torch.zeros(2 * COUNT, 3, dtype=torch.int64)
        return indices, {"image": torch.zeros(2 * COUNT, 3), "indices": indices}


def test_the_threshold_is_measured_on_pixels_that_training_never_sees() -> None:
    manager = Pixels(keeps_pixels_back=True)
    pixels, colours = held_out_bundle(manager, COUNT)
    sampler = manager.train_pixel_sampler
    assert isinstance(sampler, HeldOutPixelSampler) and 5 < len(pixels) <= COUNT
    image, row, column = pixels.T
    assert torch.equal(colours, manager.images["image"][image, row, column])
    trained = sampler.sample(manager.images)["indices"]
    held_out = {tuple(pixel) for pixel in pixels.tolist()}
    assert not held_out & {tuple(pixel) for pixel in trained.tolist()}


def test_what_calibrates_is_not_what_checks() -> None:
    manager = Pixels(keeps_pixels_back=True)
    lattice = manager.train_pixel_sampler.lattice
    calibrates, _ = held_out_bundle(manager, COUNT)
    checks, _ = held_out_bundle(Pixels(keeps_pixels_back=True), COUNT, share="recheck")
    assert bool(lattice.is_of(calibrates, "calibration").all())
    assert len(calibrates) > len(checks) > 0 and bool(lattice.is_of(checks, "recheck").all())
    assert count_held_out(Pixels(keeps_pixels_back=True), COUNT) == len(checks)


class Asked(Exception):
    """For which pixels."""


CONFIG = CalibrationConfig(rays=70, recheck_rays=7)
ASKED: dict[str, tuple[Callable[[HeldOut], Any], tuple[Any, ...]]] = {
    "freezing": (lambda pixels: pixels.price(), (70, 0, "calibration")),
    "dropping experts": (lambda pixels: pixels.unneeded(9, 0.1), (9, 0, "calibration")),
    "checking": (lambda pixels: pixels.excesses(5), (7, 5, "recheck")),
    "lowering": (lambda pixels: pixels.lower(0.3, 4), (70, 4, "all")),
}


@pytest.mark.parametrize("why", ASKED)
def test_each_measurement_has_pixels_of_its_own(why: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def asked(manager: Any, *which: Any) -> None:
        raise Asked(which)

    measure, expected = ASKED[why]
    data: Any = NoPixels()
    data.held_out = lambda mixture, *which: held_out_rays(mixture, None, *which)
    monkeypatch.setattr(learning_data, "held_out_bundle", asked)
    with pytest.raises(Asked) as found:
        measure(HeldOut(small_mixture(), data, CONFIG, restarted=False))
    assert found.value.args == (expected,)
    with pytest.raises(Asked) as found:
        held_out_rays(small_mixture(), None, 3)
    assert found.value.args == ((3, 0, "calibration"),)


def test_without_held_out_pixels_it_is_measured_on_training_rays() -> None:
    pixels, colours = held_out_bundle(Pixels(keeps_pixels_back=False), COUNT)
    assert len(pixels) == len(colours) == COUNT
    assert not colours.any()


def test_prices_are_measured_in_the_appearance_of_each_image() -> None:
    torch.manual_seed(0)
    field = replace(SMALLEST.field, appearance_dim=1)
    mixture = small_mixture(replace(SMALLEST, field=field, candidates=16))
    mixture.field.color.appearance.weight.data = torch.tensor([[500.0], [-500.0]])
    ahead = torch.tensor([[0.0, 0.0, 1.0]]).expand(2, 3)
    bundle = RayBundle(-0.5 * ahead, ahead, torch.ones(2, 1), torch.tensor([[0], [1]]))
    manager = SimpleNamespace(next_train=lambda step: (bundle, {"image": torch.rand(2, 3)}))
    rays, truth = held_out_rays(mixture, manager, 2)
    with evaluating(mixture), torch.no_grad():
        (reference,) = dense_rendering(mixture, rays, truth, 2).references
        unknown = mixture.rays(bundle.origins, bundle.directions, None)
        intervals = mixture.with_backdrops(unknown, mixture.candidates(unknown))
        of_the_mean = mixture.shade(unknown, intervals).rgb
    torch.testing.assert_close(of_the_mean[0], of_the_mean[1], atol=1e-6, rtol=0.0)
    assert float((reference.rgb[0] - reference.rgb[1]).abs().max()) > 0.05


def test_a_report_has_the_psnr_of_the_field_and_of_one_colour_on_the_rays_of_calibration() -> None:
    torch.manual_seed(0)
    mixture, truth, data = small_mixture(), torch.rand(9, 3), NoPixels()
    rays = mixture.rays(data.survey.origins, data.survey.directions, None)
    data.held_out = lambda *_: (rays, truth)  # type: ignore[method-assign]
    config = CalibrationConfig(rays_at_once=4)
    *_, report = HeldOut(mixture, data, config, restarted=False).price()  # type: ignore[arg-type]
    with evaluating(mixture), torch.no_grad():
        shown = dense_reference(mixture, rays).rgb
    for name, colours in ((FIELD, shown.clamp(0.0, 1.0)), (ONE_COLOUR, truth.mean(dim=0))):
        error = float((colours - truth).square().mean())
        assert report[name] == pytest.approx(-10.0 * math.log10(error), abs=1e-3)
    assert report["calibration_rays"] == 9
    assert (report["near"], report["far"], report["aabb"]) == (0.5, 2.0, [-100.0] * 3 + [100.0] * 3)
    assert (report["step_size"], report["cone_angle"]) == mixture.rule()


@pytest.mark.parametrize(
    ("calibrated", "careful"),
    [(0.4, 0.1), (0.002, THRESHOLDS[-1]), (THRESHOLDS[-1], THRESHOLDS[-1]), (0.0, 0.0)],
)
def test_a_careful_price_is_that_of_a_quarter_of_the_threshold(
    calibrated: float, careful: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the report says is what is skipped then. It is none below those that are tried."""
    torch.manual_seed(0)
    mixture, truth, data = small_mixture(), torch.rand(9, 3), NoPixels()
    rays = mixture.rays(data.survey.origins, data.survey.directions, None)
    data.held_out = lambda *_: (rays, truth)  # type: ignore[method-assign]
    data.of_tests = lambda *_: [rays]  # type: ignore[method-assign]
    monkeypatch.setattr(module, "calibrate", lambda given, *_, **__: measure(given, calibrated))
    config = CalibrationConfig()
    held_out = HeldOut(mixture, data, config, restarted=False)  # type: ignore[arg-type]
    measured, within, report = held_out.price(careful=True)
    with evaluating(mixture), torch.no_grad():
        rendering = dense_rendering(mixture, rays, truth, config.rays_at_once)
        assert measured == measure(rendering, careful)
        assert within == measure(rendering, calibrated)
        assert report[TESTS_LOSE] == lost_by_each([dense_reference(mixture, rays)], careful)
    assert report["threshold"] == careful
    assert TESTS_LOSE not in held_out.price()[2], "no small gate follows that would add to it"


def test_all_photographs_teach_the_small_gate() -> None:
    def training_rays(mixture: Any, count: int) -> None:
        raise Asked(count)

    data: Any = NoPixels()
    data.training_rays = training_rays
    config = CalibrationConfig(cameras=5)
    with pytest.raises(Asked) as found:
        HeldOut(small_mixture(), data, config, restarted=False).sharpened(
            GateLossConfig(), SharpeningConfig(rays=123)
        )
    assert found.value.args == (123,)


def test_of_a_restarted_field_lost_surfaces_never_count_as_too_much() -> None:
    torch.manual_seed(0)
    mixture, data = small_mixture(), NoPixels()
    mixture.freeze(0.9, {})
    rays = mixture.rays(data.survey.origins, data.survey.directions, None)
    data.held_out = lambda *_: (rays, torch.rand(9, 3))  # type: ignore[method-assign]
    config = CalibrationConfig(lost_surface_mass=0.0)

    def excess(restarted: bool) -> torch.Tensor:
        held_out = HeldOut(mixture, data, config, restarted)  # type: ignore[arg-type]
        return held_out.excesses(0)["lost surface mass"]

    assert (excess(restarted=False) > 0.0).any() and (excess(restarted=True) <= 0.0).all()


@pytest.mark.parametrize(("so_far", "asked"), [({TESTS_LOSE: [0.0]}, ["a test"]), ({}, [])])
def test_test_photographs_are_asked_of_a_small_gate_if_they_were_of_the_first(
    so_far: dict[str, Any], asked: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    mixture, data, given = small_mixture(), NoPixels(), []
    mixture.freeze(0.5, so_far)
    data.training_rays = data.held_out = lambda *_: None  # type: ignore
    data.of_tests = lambda *_: ["a test"]  # type: ignore[method-assign]
    monkeypatch.setattr(module, "sharpen", lambda *every: given.append(every[4]))
    HeldOut(mixture, data, CONFIG, restarted=False).sharpened(  # type: ignore[arg-type]
        GateLossConfig(), SharpeningConfig()
    )
    assert given == [asked]
