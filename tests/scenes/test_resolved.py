"""How small a thing photographs resolve: against pictures that were made coarser."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from leco_plugin.scenes.resolved import (
    SIDES,
    UNSEEN,
    errors_when_coarser,
    pixels_resolved,
    side_with_error,
)


class Pictures:
    """A dataset of pictures, which counts how often one is opened."""

    def __init__(self, *images: Tensor) -> None:
        self.images, self.opened = images, 0

    def __len__(self) -> int:
        return len(self.images)

    def get_data(self, index: int) -> dict[str, Any]:
        self.opened += 1
        return {"image": self.images[index]}


def noise(side: int = 96, seed: int = 0) -> Tensor:
    """[side, side, 3], another value in each pixel."""
    return torch.rand(side, side, 3, generator=torch.Generator().manual_seed(seed))


def smooth(period: float, side: int = 192) -> Tensor:
    """Waves of so many pixels."""
    across = torch.arange(side) * (2 * torch.pi / period)
    wave = 0.5 + 0.25 * (across.sin()[:, None] + across.cos()[None, :])
    return wave[:, :, None].expand(-1, -1, 3)


def test_noise_is_seen_pixel_by_pixel() -> None:
    assert pixels_resolved(Pictures(noise())) == 1.0


def test_what_is_all_of_one_colour_shows_the_largest_things() -> None:
    assert pixels_resolved(Pictures(torch.full((96, 96, 3), 0.3))) == SIDES[-1]


def test_waves_twice_as_long_are_resolved_by_pixels_twice_as_large() -> None:
    one, two = (pixels_resolved(Pictures(smooth(period))) for period in (24.0, 48.0))
    assert one > 1.5
    assert two == pytest.approx(2.0 * one, rel=0.15)


def test_an_enlarged_picture_shows_no_more() -> None:
    waves = smooth(20.0, 96)
    larger = functional.interpolate(waves.movedim(-1, 0)[None], scale_factor=2, mode="bilinear")[
        0
    ].movedim(0, -1)
    before, after = (pixels_resolved(Pictures(one)) for one in (waves, larger))
    assert after == pytest.approx(2.0 * before, rel=0.15)


def test_at_the_side_that_is_found_a_picture_has_lost_what_may_go_unseen() -> None:
    """Between powers of two by a line; at one of them, exactly."""
    errors = errors_when_coarser(smooth(40.0))
    for side, error in zip(SIDES, errors):
        scaled = [UNSEEN / error * each for each in errors]
        assert side_with_error(scaled) == pytest.approx(side, rel=1e-3)


def test_what_a_picture_hides_by_its_opacity_is_black() -> None:
    hidden = torch.cat([noise(), torch.zeros(96, 96, 1)], dim=-1)
    assert pixels_resolved(Pictures(hidden)) == SIDES[-1]


def test_it_opens_some_pictures_only() -> None:
    many = Pictures(*[noise(64, seed) for seed in range(50)])
    assert pixels_resolved(many) == 1.0 and many.opened == 16


def test_pictures_too_small_to_be_made_coarser_are_taken_as_they_are() -> None:
    assert pixels_resolved(Pictures(torch.full((20, 20, 3), 0.5))) == 1.0
    assert pixels_resolved(Pictures()) == 1.0
