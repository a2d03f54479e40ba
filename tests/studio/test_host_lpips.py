"""Claims about `leco_plugin.studio.host_models`."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from nerfstudio.models.base_model import ModelConfig
from nerfstudio.models.nerfacto import NerfactoModelConfig
from nerfstudio.models.vanilla_nerf import NeRFModel, VanillaModelConfig
from small_hosts import what_a_model_gets
from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

from leco_plugin.evaluation import metrics
from leco_plugin.hosts.guided import Host, set_up_host
from leco_plugin.studio import host_models
from leco_plugin.studio.host_models import LazyLpipsNetwork, lazy_lpips


@pytest.fixture(autouse=True)
def _no_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    def refuse(url: str, *_: object, **__: object) -> None:
        raise ConnectionError(f"no network for {url}")

    monkeypatch.setattr(torch.hub, "download_url_to_file", refuse)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    metrics.lpips_metric.cache_clear()
    yield
    metrics.lpips_metric.cache_clear()


def nerfacto() -> ModelConfig:
    return NerfactoModelConfig(implementation="torch", log2_hashmap_size=8, num_levels=2)


def vanilla_nerf() -> ModelConfig:
    return VanillaModelConfig(_target=NeRFModel)


@pytest.mark.parametrize("host", [nerfacto, vanilla_nerf])
def test_a_built_in_method_needs_a_network_by_itself_and_none_here(host) -> None:
    with pytest.raises(ConnectionError):
        host().setup(**what_a_model_gets())
    model = set_up_host(host(), Host, **what_a_model_gets())
    assert not any("lpips" in name for name in model.state_dict())


def test_a_host_without_lpips_weights_gives_metrics_that_are_json() -> None:
    model = set_up_host(nerfacto(), Host, **what_a_model_gets())
    side = 40
    outputs = {"rgb": torch.rand(side, side, 3), "accumulation": torch.rand(side, side, 1)}
    depths = ["depth", *(f"prop_depth_{level}" for level in range(2))]
    outputs |= {name: torch.rand(side, side, 1) for name in depths}
    figures, pictures = model.get_image_metrics_and_images(
        outputs, {"image": torch.rand(side, side, 3)}
    )
    assert {"psnr", "ssim"} <= figures.keys()
    assert not any("lpips" in name for name in figures)
    json.dumps(figures, allow_nan=False)
    assert "img" in pictures


@pytest.mark.parametrize(("side", "distance"), [(31, 0.25), (30, math.nan)])
def test_a_network_that_is_at_hand_is_asked_about_pictures_that_are_large_enough(
    side: int, distance: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    metric = SimpleNamespace(
        to=lambda device: metric, net=lambda first, _: torch.full((len(first), 1, 1, 1), 0.25)
    )
    monkeypatch.setattr(host_models, "lpips_metric", lambda backbone: metric)
    pictures = torch.rand(2, 3, side, 50)
    found = LazyLpipsNetwork()(pictures, pictures)
    torch.testing.assert_close(found, torch.full((2, 1, 1, 1), distance), equal_nan=True)


def test_a_metric_imported_before_is_lazy_too_and_eager_again_after() -> None:
    with lazy_lpips():
        metric = LearnedPerceptualImagePatchSimilarity(normalize=True)
    assert isinstance(metric.net, LazyLpipsNetwork)
    assert math.isnan(metric(torch.rand(1, 3, 40, 40), torch.rand(1, 3, 40, 40)))
    with pytest.raises(ConnectionError):
        LearnedPerceptualImagePatchSimilarity(normalize=True)
