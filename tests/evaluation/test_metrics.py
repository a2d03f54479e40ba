"""Claims about `leco_plugin.evaluation.metrics`."""

from __future__ import annotations

import json
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
import torchvision
from torchmetrics.functional.image import structural_similarity_index_measure
from torchmetrics.image import PeakSignalNoiseRatio

from leco_plugin.evaluation import metrics
from leco_plugin.evaluation.metrics import LPIPS_MINIMUM_SIDE, FigureUnavailable


@pytest.fixture(autouse=True)
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty folder where torch keeps downloaded weights, and no way to fetch any."""

    def refuse(url: str, *_: object, **__: object) -> None:
        raise AssertionError(f"{url} would have been downloaded")

    monkeypatch.setattr(torch.hub, "download_url_to_file", refuse)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    metrics.lpips_metric.cache_clear()
    yield tmp_path
    metrics.lpips_metric.cache_clear()


@pytest.fixture
def backbone(hub: Path) -> Path:
    """An AlexNet of random weights where the trained one would lie."""
    torch.manual_seed(0)
    path = hub / "checkpoints" / "alexnet-owt-7be5be79.pth"
    path.parent.mkdir()
    torch.save(torchvision.models.alexnet(weights=None).state_dict(), path)
    return path


def images(side: int = 40) -> tuple[torch.Tensor, torch.Tensor]:
    truth = torch.rand(side + 3, side, 3)
    return (truth + 0.1 * torch.randn_like(truth)).clamp(0, 1), truth


def as_metrics_take_it(image: torch.Tensor) -> torch.Tensor:
    return image.permute(2, 0, 1)[None]


def test_psnr_is_that_of_torchmetrics_and_of_equal_images_one_that_json_has() -> None:
    predicted, truth = images()
    expected = PeakSignalNoiseRatio(data_range=1.0)(predicted, truth)
    assert metrics.psnr(predicted, truth) == pytest.approx(float(expected), abs=1e-4)
    assert metrics.psnr(truth, truth) == 120.0


def test_ssim_is_that_of_nerfstudio_whatever_the_images_range_is() -> None:
    predicted, truth = (0.3 + 0.2 * image for image in images())
    expected = structural_similarity_index_measure(  # as nerfstudio's models call it
        as_metrics_take_it(predicted), as_metrics_take_it(truth)
    )
    assert metrics.ssim(predicted, truth) == pytest.approx(float(expected), abs=1e-6)
    assert metrics.ssim(predicted, truth) < 0.98
    assert metrics.ssim(truth, truth) == pytest.approx(1.0, abs=1e-5)


def test_flip_is_that_of_its_package_and_grows_with_the_error() -> None:
    evaluate = pytest.importorskip("flip_evaluator").evaluate
    predicted, truth = images()
    found = metrics.flip(predicted, truth)
    each_pixel, *_ = evaluate(truth.numpy(), predicted.numpy(), "LDR", applyMagma=False)
    assert found == pytest.approx(each_pixel.mean(), rel=1e-4)
    assert metrics.flip(truth, truth) == 0.0 < found < metrics.flip(1.0 - truth, truth)
    outside = 3.0 * predicted - 1.0  # what a screen shows of it is compared
    assert metrics.flip(outside, truth) == metrics.flip(outside.clamp(0, 1), truth) != 0.0
    assert metrics.flip(truth, outside) == metrics.flip(truth, outside.clamp(0, 1))


def test_without_its_package_flip_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    metrics.flip_evaluator.cache_clear()
    try:
        with pytest.warns(FigureUnavailable, match="pip install flip-evaluator") as caught:
            found = [metrics.image_metrics(*images(LPIPS_MINIMUM_SIDE - 1)) for _ in range(2)]
    finally:
        metrics.flip_evaluator.cache_clear()
    assert len(caught) == 1 and all(one.keys() == {"psnr", "ssim"} for one in found)


def test_lpips_is_that_of_torchmetrics(backbone: Path) -> None:
    predicted, truth = images()
    metric = metrics.lpips_metric("alex")
    assert metric is not None
    expected = type(metric)(net_type="alex", normalize=True)(
        as_metrics_take_it(predicted), as_metrics_take_it(truth)
    )
    assert metrics.lpips(predicted, truth) == pytest.approx(float(expected), rel=1e-5)
    outside = 3.0 * predicted - 1.0
    assert metrics.lpips(outside, truth) == metrics.lpips(outside.clamp(0, 1), truth)
    assert metrics.lpips(truth, outside) == metrics.lpips(truth, outside.clamp(0, 1))
    assert metrics.image_metrics(predicted, truth).keys() == {"psnr", "ssim", "flip", "lpips"}


def test_without_its_weights_lpips_is_left_out_with_one_warning_that_names_the_file() -> None:
    predicted, truth = images()
    with pytest.warns(FigureUnavailable, match=r"put .*alexnet.* at .*checkpoints") as caught:
        first = metrics.image_metrics(predicted, truth)
        second = metrics.image_metrics(predicted, truth)
    assert len(caught) == 1
    assert first.keys() == second.keys() == {"psnr", "ssim", "flip"}
    json.dumps(first, allow_nan=False)


def test_a_truncated_backbone_is_a_missing_one(backbone: Path) -> None:
    backbone.write_bytes(backbone.read_bytes()[:1000])
    predicted, truth = images()
    with pytest.warns(FigureUnavailable, match="LPIPS is left out"):
        assert metrics.lpips(predicted, truth) is None


def test_the_smallest_image_that_lpips_takes_is_known(backbone: Path) -> None:
    assert metrics.lpips(*images(LPIPS_MINIMUM_SIDE)) is not None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert metrics.lpips(*images(LPIPS_MINIMUM_SIDE - 1)) is None
