"""Photographs that teach an occupancy nothing, and vouch for it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.pixel_samplers import PixelSamplerConfig
from small_learner import small_mixture

from leco_plugin.learning.calibration import CalibrationConfig, Measured
from leco_plugin.learning.quality import price_in_words, views_in_words
from leco_plugin.learning.sharpening import Sharpened, SharpeningConfig
from leco_plugin.models.gate import Gate
from leco_plugin.occupancy import CAMERAS_THAT_VOUCH
from leco_plugin.scenes import learning_data
from leco_plugin.scenes.bounds import BoundsConfig
from leco_plugin.scenes.learning_data import LearningData
from leco_plugin.scenes.pixels.held_out_pixels import HeldOutPixelSampler


@pytest.fixture
def data(monkeypatch: pytest.MonkeyPatch) -> LearningData:
    """Forty photographs in memory."""
    monkeypatch.setattr(learning_data, "survey", lambda *_: None)
    sampler = HeldOutPixelSampler(PixelSamplerConfig(num_rays_per_batch=50))
    images = {"image": torch.zeros(40, 6, 7, 3), "image_idx": torch.arange(40)}
    manager: Any = SimpleNamespace(
        train_dataset=range(40),
        train_pixel_sampler=sampler,
        get_train_rays_per_batch=lambda: 50,
        iter_train_image_dataloader=iter(lambda: images, None),
        images=images,
    )
    return LearningData(manager, BoundsConfig(), None, None)


def test_they_are_spread_evenly_and_at_most_a_quarter(data: LearningData) -> None:
    assert data.vouching(10).tolist() == list(range(2, 40, 4))
    assert len(data.vouching(11)) == 0 and len(data.vouching(0)) == 0


def test_nothing_is_drawn_of_them_until_all_train(data: LearningData) -> None:
    sampler = data.manager.train_pixel_sampler
    data.prepare_batch(40.0, distances=False, set_aside=4)
    drawn = sampler.sample(dict(data.manager.images))["indices"][:, 0]
    assert not set(drawn.tolist()) & {5, 15, 25, 35} and len(drawn.unique()) == 36
    data.prepare_batch(40.0, distances=False)
    drawn = sampler.sample(dict(data.manager.images))["indices"][:, 0]
    assert {5, 15, 25, 35} <= set(drawn.tolist())


def test_rays_that_teach_a_small_gate_are_of_all_photographs(
    data: LearningData, monkeypatch: pytest.MonkeyPatch
) -> None:
    sampler = data.manager.train_pixel_sampler
    aside: list[object] = []
    data.prepare_batch(1.0, distances=False, set_aside=4)
    assert sampler.set_aside is not None

    def bundles(_: Any, count: int) -> Iterator[RayBundle]:
        aside.append(sampler.set_aside)
        images = torch.zeros(count + 1, 1, dtype=torch.int64)
        ahead = torch.tensor([[1.0, 0.0, 0.0]]).expand(count + 1, 3)
        yield RayBundle(torch.zeros(count + 1, 3), ahead, torch.ones(count + 1, 1), images)

    monkeypatch.setattr(learning_data, "training_bundles", bundles)
    assert len(data.training_rays(small_mixture(), 7).origins) == 7
    assert aside == [None]


@pytest.mark.parametrize("images", [[torch.zeros(6, 7, 3)] * 16, torch.zeros(16, 6, 7, 3)])
def test_partial_batches_set_no_pictures_aside(data: LearningData, images: Any) -> None:
    data.manager.images["image"] = images
    assert len(data.vouching(4)) == 0


def test_pictures_of_several_sizes_vouch_too(data: LearningData) -> None:
    pictures = [torch.full((6 + number % 3, 7, 3), float(number)) for number in range(40)]
    data.manager.images["image"], sampler = pictures, data.manager.train_pixel_sampler
    data.prepare_batch(40.0, distances=False, set_aside=4)
    batch = sampler.sample(dict(data.manager.images))
    assert sampler.set_aside is not None and len(batch["indices"]) == 2000
    counts = batch["indices"][:, 0].bincount(minlength=40)
    assert counts[[5, 15, 25, 35]].tolist() == [0] * 4
    assert counts[counts > 0].unique().tolist() == [55, 56]
    assert torch.equal(batch["image"][:, 0], batch["indices"][:, 0].float())
    found = sampler.sample_pictures(dict(data.manager.images), data.vouching(4), 20, seed=0)
    assert found["image"][:, 0].tolist() == [5.0] * 20 + [15.0] * 20 + [25.0] * 20 + [35.0] * 20


class Photographs(list[str]):
    """Test photographs of these names, of 4 x 5 pixels; the second is masked."""

    cameras = Cameras(torch.eye(4)[None, :3].repeat(3, 1, 1), 5.0, 5.0, 2.5, 2.0, 5, 4)

    @property
    def image_filenames(self) -> list[str]:
        return self

    def get_data(self, number: int) -> dict[str, torch.Tensor]:
        mask = torch.full((4, 5, 1), number != 1)
        return {"image": torch.zeros(4, 5, 3), "mask": mask}


@pytest.mark.parametrize(("last", "counts"), [("c", [7, 7]), ("d", [])])
def test_test_photographs_say_what_new_views_lose_unless_they_train(
    last: str, counts: list[int], data: LearningData
) -> None:
    data.manager.train_dataset = SimpleNamespace(image_filenames=["d", "e"])
    data.manager.eval_dataset = Photographs(["a", "b", last])
    found = data.of_tests(small_mixture(), 9, 7)
    assert [len(rays.origins) for rays in found] == counts
    assert all(rays.images is None for rays in found), "they have no codes of their own"
    again = data.of_tests(small_mixture(), 9, 7)
    assert all(torch.equal(a.directions, b.directions) for a, b in zip(found, again))
    del data.manager.eval_dataset
    assert data.of_tests(small_mixture(), 9, 7) == []


SAID = {"count": 9, "worst_surface_mass": 0.00123, "bound": 0.002, "confidence": 0.9}


def test_what_views_may_lose_and_skipping_costs_is_said_in_a_line_each() -> None:
    line = views_in_words({CAMERAS_THAT_VOUCH: SAID})
    assert "0.12%" in line and "0.20%, with 90%" in line
    line = views_in_words({CAMERAS_THAT_VOUCH: SAID | {"confidence": None}})
    assert "9 photographs lose at most 0.12%" in line and "may lose more" in line
    assert "may lose more" in views_in_words({}) == views_in_words({CAMERAS_THAT_VOUCH: None})
    report = {"empty_fraction": 0.85, "image_price_db": -1e-4, "lost_surface_mass": 2.05e-4}
    (line,) = price_in_words(report)
    assert "skips 85.0%" in line and "+0.000 dB and 0.02% of the surfaces" in line
    assert price_in_words(report | {"image_price_db": None}) == price_in_words({}) == []


def test_a_report_of_a_small_gate_has_what_views_lose_by_it() -> None:
    skipped = Measured(0.5, 0.0, 0.0, 0.0, 0.5)._asdict()
    before = {"params": 7, **skipped, CAMERAS_THAT_VOUCH: SAID | {"worst_surface_mass": 0.0005}}
    config = SharpeningConfig().gate
    sharpened = Sharpened(Gate(config), Measured(**skipped), Measured(**skipped), SAID)
    assert sharpened.report(before, config)[CAMERAS_THAT_VOUCH] == SAID
    unknown = sharpened._replace(promised=None).report(before, config)
    assert unknown == {**sharpened.report(before, config), CAMERAS_THAT_VOUCH: None}


@pytest.mark.parametrize(("times", "fits"), [(9.9, True), (10.1, False)])
@pytest.mark.parametrize("price", ["lost_surface_mass", "image_price_db"])
def test_no_error_excuses_ten_times_the_bound(price: str, times: float, fits: bool) -> None:
    config, sure = CalibrationConfig(), Measured(0.5, 0.0, 0.0, 0.0, 0.5, math.inf, math.inf)
    assert sure._replace(**{price: times * getattr(config, price)}).within(config) == fits
