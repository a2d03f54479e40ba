"""Colour from features, direction and the appearance of an image."""

from __future__ import annotations

import pytest
import torch

from leco_plugin.models.field import APPEARANCE_SCALE, ColorHead


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
