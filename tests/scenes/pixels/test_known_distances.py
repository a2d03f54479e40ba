"""A batch says which of its rays have a known distance, and says it of the right ones."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from leco_plugin.scenes.pixels.known_distances import (
    DISTANCE,
    KnownDistancePixelSampler,
    KnownDistancePixelSamplerConfig,
    SparsePixels,
)


def images() -> dict[str, Any]:
    """Three images whose colours are their pixels' places; their own numbers are 7, 8, 9."""
    places = torch.meshgrid(torch.arange(3), torch.arange(20), torch.arange(30), indexing="ij")
    return {"image": torch.stack(places, dim=-1).float(), "image_idx": torch.tensor([7, 8, 9])}


def known() -> SparsePixels:
    """Pixels of the images 6 to 9, whose distances tell them apart; image 6 is not loaded."""
    numbers = torch.arange(40)
    indices = torch.stack([6 + numbers % 4, numbers % 20, numbers % 30], dim=-1)
    return SparsePixels(indices, 1.0 + numbers.float())


def sampler(**options: Any) -> KnownDistancePixelSampler:
    made = KnownDistancePixelSamplerConfig(num_rays_per_batch=400, **options).setup()
    assert isinstance(made, KnownDistancePixelSampler)
    return made


def test_nothing_is_added_as_long_as_no_point_is_known() -> None:
    assert DISTANCE not in sampler().sample(images())


@pytest.mark.parametrize("kind", ["tensor", "list"])
def test_known_rays_have_the_colour_the_place_and_the_distance_of_their_pixel(kind: str) -> None:
    torch.manual_seed(0)
    made, batch = sampler(), images()
    made.sparse = known()
    if kind == "list":
        batch["image"] = list(batch["image"])
    pixels = made.sample(batch)
    found = pixels[DISTANCE]
    assert found.shape == (400,) and 50 < int((found > 0).sum()) <= 100
    for row in (found > 0).nonzero()[:, 0].tolist():
        number = round(float(found[row])) - 1
        expected = known().indices[number]
        assert expected[0] > 6
        assert torch.equal(pixels["indices"][row], expected)
        colour = torch.tensor([int(expected[0]) - 7, *expected[1:].tolist()]).float()
        assert torch.equal(pixels["image"][row].float(), colour)


def test_masked_pixels_are_left_out() -> None:
    torch.manual_seed(0)
    made, batch = sampler(), images()
    made.sparse = known()
    batch["mask"] = torch.ones(3, 20, 30, 1, dtype=torch.bool)
    batch["mask"][1] = False
    pixels = made.sample(batch)
    assert int((pixels[DISTANCE] > 0).sum()) > 20
    assert 8 not in pixels["indices"][:, 0].tolist()


def of_many_sizes() -> dict[str, Any]:
    """The images 7 and 8; 7 is narrower."""
    pictures = [torch.zeros(20, 12, 3), torch.zeros(20, 30, 3)]
    return {"image": pictures, "image_idx": torch.tensor([7, 8])}


def test_a_batch_of_many_sizes_may_hold_no_known_pixel() -> None:
    made, batch = sampler(), of_many_sizes()
    made.sparse = SparsePixels(torch.tensor([[6, 15, 25], [9, 15, 25]]), torch.ones(2))
    pixels = made.sample(batch)
    assert not bool(pixels[DISTANCE].any()) and pixels["image"].shape == (400, 3)


def test_a_pixel_is_looked_up_in_the_mask_of_its_own_image() -> None:
    torch.manual_seed(0)
    # nerfstudio's rejection sampling takes no masks of many sizes
    made, batch = sampler(rejection_sample_mask=False), of_many_sizes()
    batch["mask"] = [torch.ones(*picture.shape[:2], 1).bool() for picture in batch["image"]]
    # one pixel of an image that is not in the batch, and outside the first that is
    made.sparse = SparsePixels(torch.tensor([[6, 15, 25], [8, 15, 25]]), torch.tensor([1.0, 2.0]))
    pixels = made.sample(batch)
    assert set(pixels[DISTANCE].tolist()) == {0.0, 2.0}
