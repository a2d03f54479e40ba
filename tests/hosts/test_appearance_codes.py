"""Claims about the codes that hosts give their photographs."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.field_components.embedding import Embedding
from nerfstudio.models.instant_ngp import InstantNGPModelConfig, NGPModel
from nerfstudio.models.nerfacto import NerfactoModelConfig
from small_hosts import what_a_model_gets
from torch import nn

from leco_plugin.hosts.appearance import SmallCodes, show_from
from leco_plugin.hosts.guided import GuidedModelConfig
from leco_plugin.hosts.guided_start import OccupancyConfig
from leco_plugin.models.field import codes_nearby
from leco_plugin.scenes.survey import CAMERAS
from leco_plugin.swap import registered, swapped_config

NGP = {"log2_hashmap_size": 8, "max_res": 64, "grid_resolution": 16, "grid_levels": 2}
HOSTS = {
    "instant-ngp": InstantNGPModelConfig(**NGP),
    "nerfacto": NerfactoModelConfig(
        implementation="torch", num_levels=2, log2_hashmap_size=8, max_res=64
    ),
}


PAIRS = torch.tensor([0.0, 1.0, 50.0, 51.0])
"""Where photographs are taken two by two, so that neighbours tell each other's codes."""


def built(host: Any, codes: Any = "small", sampler: str = "own", **given: Any) -> Any:
    config = GuidedModelConfig(host=host, occupancy=OccupancyConfig(sampler=sampler), codes=codes)
    return config.setup(**what_a_model_gets() | given)


@pytest.mark.parametrize("name", HOSTS)
@pytest.mark.parametrize("sampler", ["own", "learned-occupancy"])
def test_photographs_and_other_views_look_alike_before_the_first_step(
    name: str, sampler: str
) -> None:
    codes = built(HOSTS[name], sampler=sampler).field.embedding_appearance
    of_all = codes(torch.tensor([0, 1]))
    assert torch.equal(of_all, torch.zeros(2, 32)) and torch.equal(codes.mean(), torch.zeros(32))


@pytest.mark.parametrize("name", HOSTS)
def test_own_codes_are_left_as_nerfstudio_has_them(name: str) -> None:
    codes = built(HOSTS[name], "own").field.embedding_appearance
    assert type(codes) is Embedding
    assert 0.5 < float(codes(torch.tensor([0, 1])).detach().std()) < 1.5


def test_codes_part_slowly_and_their_mean_is_scaled_alike() -> None:
    small = SmallCodes(4, 8)
    nn.init.normal_(small.embedding.weight, mean=3.0)
    codes, raw = small(torch.arange(4)), small.embedding.weight
    assert torch.allclose(codes, 0.1 * raw) and torch.allclose(small.mean(), codes.mean(dim=0))


@pytest.mark.parametrize("name", HOSTS)
@torch.no_grad()
def test_a_view_is_shown_in_the_light_of_the_photographs_nearby(name: str) -> None:
    cameras = Cameras(torch.eye(4)[:3].repeat(4, 1, 1), 10.0, 10.0, 2.0, 2.0)
    cameras.camera_to_worlds[:, 0, 3] = PAIRS
    host = built(HOSTS[name], metadata={CAMERAS: cameras}, num_train_data=4).eval()
    codes = host.field.embedding_appearance
    nn.init.normal_(codes.embedding.weight, std=30.0)
    codes.embedding.weight[1::2] = codes.embedding.weight[::2]
    table = codes.embedding.weight
    for one in (0, 3):
        host.get_outputs_for_camera(cameras[one : one + 1])
        expected = codes_nearby(table, cameras.camera_to_worlds[:, :, 3], codes.origin)[0]
        assert torch.equal(codes.origin, cameras.camera_to_worlds[one : one + 1, :, 3])
        torch.testing.assert_close(codes.mean(), 0.1 * expected)
        assert not torch.allclose(codes.mean(), 0.1 * table.mean(dim=0), atol=0.1)
    assert host.field.use_average_appearance_embedding  # or nobody would ask for `mean`
    with suppress(AssertionError):  # nerfstudio's, of a field that is asked nothing
        host.train()(cameras[0].generate_rays(0).flatten()[:4])
    assert codes.origin is None  # each ray of training has a photograph


def test_a_checkpoint_has_the_names_of_nerfstudio() -> None:
    host = HOSTS["instant-ngp"]
    assert built(host).state_dict().keys() == built(host, "own").state_dict().keys()


@pytest.mark.parametrize("name", ["leco-ngp", "leco-nerfacto"])
def test_guided_methods_and_swapped_ones_begin_with_small_codes(name: str) -> None:
    ours: Any = registered(name)
    assert ours.pipeline.model.codes == "small"
    other: Any = swapped_config("nerfacto", None)
    assert other.pipeline.model.codes == "small"
    own: Any = swapped_config("nerfacto", None, codes="own")
    assert own.pipeline.model.codes == "own"


def test_the_flag_of_instant_ngp_is_still_inverted() -> None:
    """Once nerfstudio mends it, Instant-NGP has no codes by default: then docs/hosts.md, and charts
    of Instant-NGP with codes, are to be made anew."""
    without: Any = built(InstantNGPModelConfig(**NGP, use_appearance_embedding=True), "own")
    assert without.field.embedding_appearance is None
    assert InstantNGPModelConfig().use_appearance_embedding is False
    assert isinstance(built(HOSTS["instant-ngp"], "own").field.embedding_appearance, Embedding)


class Elsewhere(NGPModel):
    """Of another package, with a table of its own beside nerfstudio's."""

    def populate_modules(self) -> None:
        super().populate_modules()
        self.moods = nn.Embedding(self.num_train_data, 4)
        self.words = nn.Embedding(50, 4)


def test_a_host_of_another_package_gets_a_line_about_what_was_done_and_what_not(
    capsys: pytest.CaptureFixture[str],
) -> None:
    config = InstantNGPModelConfig(_target=Elsewhere, **NGP)
    host = built(config)
    said = " ".join(capsys.readouterr().out.split())
    assert "field.embedding_appearance" in said and "--codes own" in said
    assert "moods begins with a random code" in said and "words" not in said
    assert float(host.moods.weight.detach().std()) > 0.1
    built(config, "own")
    built(HOSTS["instant-ngp"])
    assert "codes" not in capsys.readouterr().out


def test_rays_of_several_views_at_once_have_the_mean_code() -> None:
    small = SmallCodes(4, 8)
    small.embedding.weight = nn.Parameter(30.0 * torch.randn(2, 8).repeat_interleave(2, dim=0))
    small.places = torch.zeros(4, 3)
    small.places[:, 0] = PAIRS
    mean = 0.1 * small.embedding.weight.mean(dim=0)
    show_from(small, small.places[:1].expand(5, 3))
    assert not torch.allclose(small.mean(), mean, atol=0.1)
    show_from(small, small.places)
    torch.testing.assert_close(small.mean(), mean)
