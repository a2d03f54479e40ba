"""Colour from features, direction and the appearance of an image."""

from __future__ import annotations

import pytest
import torch

from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.field import (
    APPEARANCE_SCALE,
    OPPONENT,
    ColorHead,
    FieldConfig,
    HMoEField,
    codes_nearby,
)
from leco_plugin.models.hmoe import HMoEConfig


def inputs(samples: int = 20, rays: int = 5) -> tuple[torch.Tensor, ...]:
    directions = torch.nn.functional.normalize(torch.randn(rays, 3), dim=-1)
    ray_indices = torch.randint(rays, (samples,)).sort().values
    return torch.randn(samples, 8), ray_indices, directions


def head(appearance_dim: int = 6) -> ColorHead:
    color = ColorHead(8, 16, 2, appearance_dim, num_images=3)
    if color.appearance is not None:
        torch.nn.init.normal_(color.appearance.weight, std=10.0)
    return color


@pytest.mark.parametrize("appearance_dim", [0, 6])
def test_the_sum_of_two_layers_is_the_layer_of_the_concatenation(appearance_dim: int) -> None:
    color, (features, ray_indices, directions) = head(appearance_dim), inputs()
    images = torch.tensor([0, 1, 2, 1, 0])
    of_rays = [color.direction_encoding(directions)]
    if color.appearance is not None:
        of_rays.append(APPEARANCE_SCALE * color.appearance(images))
    together = torch.cat([features, torch.cat(of_rays, dim=-1)[ray_indices]], dim=-1)
    weight = torch.cat([color.of_features.weight, color.of_ray.weight], dim=-1)
    hidden = torch.relu(together @ weight.T + color.of_features.bias)
    expected = torch.sigmoid(color.out(hidden) @ color.opponent)
    torch.testing.assert_close(color(features, ray_indices, directions, images), expected)


def test_the_image_decides_the_colour_and_rendering_takes_the_mean_code() -> None:
    color, (features, ray_indices, directions) = head(), inputs()
    first, second = (
        color(features, ray_indices, directions, torch.full((5,), image)) for image in (0, 1)
    )
    assert not torch.allclose(first, second, atol=1e-3)
    mean = color(features, ray_indices, directions, None)
    assert color.appearance is not None
    with torch.no_grad():
        color.appearance.weight[0] = color.appearance.weight.mean(dim=0)
        color.appearance.weight[1:] = color.appearance.weight[0]
    torch.testing.assert_close(
        color(features, ray_indices, directions, torch.zeros(5, dtype=torch.int64)), mean
    )


def test_a_view_takes_the_codes_of_the_photographs_nearby() -> None:
    places = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]], dtype=torch.float32)
    codes = torch.stack([places[:, 0], 5.0 - places[:, 0]], dim=1)  # as light drifts on a flight
    at, between, away = codes_nearby(
        codes, places, torch.tensor([[0.0, 0, 0], [1.5, 0, 0], [90, 0, 0]])
    )
    torch.testing.assert_close(at, torch.softmax(-((torch.arange(4) / 1.5) ** 2), 0) @ codes)
    torch.testing.assert_close(between, codes.mean(dim=0))
    torch.testing.assert_close(away, codes[3])
    moved = codes_nearby(codes, 100.0 * places, torch.tensor([[0.0, 0, 0]]))[0]
    torch.testing.assert_close(moved, at)  # whatever the units are


def test_neighbours_count_as_far_as_they_tell_each_others_codes() -> None:
    torch.manual_seed(0)
    places, view = torch.zeros(2000, 3), torch.tensor([[7.2, 0, 0]])
    places[:, 0] = torch.arange(2000.0)
    alike, mixed = torch.sin(places[:, :1] / 20.0), torch.randn(2000, 1)
    of_a_drift = codes_nearby(alike, places, view)
    torch.testing.assert_close(of_a_drift, torch.sin(view[:, :1] / 20.0), atol=0.02, rtol=0.0)
    of_chance = codes_nearby(mixed, places, view) - mixed.mean()
    nearest = torch.softmax(-((places - view).norm(dim=1) / 1.5).square(), dim=0) @ mixed
    assert float(of_chance.abs()) < 0.2 * float((nearest - mixed.mean()).abs())


@pytest.mark.parametrize("count", [1, 3])
def test_photographs_from_one_place_count_alike(count: int) -> None:
    codes = torch.randn(count, 4)
    found = codes_nearby(codes, torch.ones(count, 3), torch.randn(2, 3))
    torch.testing.assert_close(found, codes.mean(dim=0).expand(2, -1))


def test_rays_of_one_batch_have_the_codes_of_their_own_places() -> None:
    color, (features, ray_indices, directions) = head(), inputs()
    assert color.appearance is not None
    color.appearance = torch.nn.Embedding.from_pretrained(
        color.appearance.weight[[0, 0, 1, 1]].detach()
    )
    color.places = torch.tensor([[0.0, 0, 0], [1, 0, 0], [50, 0, 0], [51, 0, 0]])
    origins = color.places[[2, 0, 1, 1, 2]]
    found = color(features, ray_indices, directions, None, origins)
    for ray in range(5):
        mine = ray_indices == ray
        alone = color(
            features[mine], ray_indices[mine], directions, None, origins[ray].repeat(5, 1)
        )
        torch.testing.assert_close(found[mine], alone)
    assert not torch.allclose(found, color(features, ray_indices, directions, None), atol=1e-3)


def test_brightness_and_the_two_hues_are_orthonormal() -> None:
    torch.testing.assert_close(OPPONENT @ OPPONENT.T, torch.eye(3))
    torch.testing.assert_close(OPPONENT.sum(dim=1)[1:], torch.zeros(2))  # grey has no hue


def test_without_an_empty_expert_points_routed_to_it_have_no_density() -> None:
    experts = HMoEConfig(2, 8, 1, empty_expert="none")
    field = HMoEField(FieldConfig(EncodingConfig("hash", levels=2, log2_table=8), experts), 1)
    routes = torch.tensor([0, 1, 2, 0])
    sigmas, _ = field.density(torch.rand(4, 3), routes, torch.ones(4))
    assert torch.equal(sigmas > 0.0, routes > 0)


@pytest.mark.parametrize("apart", [(0.0,), (0.0, 0.05), (0.0,) * 6, (0.0, 0.05, 0.1, 0.05, 0.1)])
def test_codes_drift_smoothly_where_photographs_share_a_place(apart: tuple[float, ...]) -> None:
    stations = torch.arange(40.0).repeat_interleave(len(apart))
    places = torch.zeros(len(stations), 3)
    places[:, 0] = stations + torch.tensor(apart).repeat(40)
    film = torch.zeros(400, 3)
    film[:, 0] = torch.linspace(10.0, 30.0, 400)
    codes = codes_nearby(stations[:, None], places, film)[:, 0]
    steps = codes.diff()
    assert float(steps.max()) < 1.5 * float(steps.mean())
