"""A batch says which of its rays have a known distance, and says it of the right ones."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.pixel_samplers import PixelSamplerConfig
from scene_files import refused

from leco_plugin.scenes.bounds import FEWEST_POINTS
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.pixels.held_out_pixels import Lattice
from leco_plugin.scenes.pixels.known_distances import (
    DISTANCE,
    KnownDistancePixelSampler,
    KnownDistancePixelSamplerConfig,
    SparsePixels,
    batches_of,
    hidden,
    refuse_odd_batches,
    sparse_pixels,
)

WIDTH, HEIGHT = 160, 120


def cameras(distortion: list[float] | None = None, kind=CameraType.PERSPECTIVE) -> Cameras:
    """Two cameras ten units up, looking down, one unit apart."""
    poses = torch.eye(4)[:3].repeat(2, 1, 1)
    poses[:, 2, 3], poses[1, 0, 3] = 10.0, 1.0
    return Cameras(
        poses,
        *(torch.full((2, 1), value) for value in (140.0, 150.0, 79.0, 61.0)),
        width=torch.full((2, 1), WIDTH),
        height=torch.full((2, 1), HEIGHT),
        distortion_params=None if distortion is None else torch.tensor([distortion] * 2),
        camera_type=kind,
    )


def ground(count: int = 400) -> torch.Tensor:
    places = torch.rand(count, 2, generator=torch.Generator().manual_seed(0)) * 8 - 4
    return torch.cat([places, torch.zeros(count, 1)], dim=-1)


@pytest.mark.parametrize("distortion", [None, [0.05, -0.02, 0.0, 0.0, 0.003, -0.002]])
def test_the_ray_of_a_pixel_leads_to_its_point(distortion: list[float] | None) -> None:
    made, points = cameras(distortion), ground()
    found = sparse_pixels(made, points, Lattice())
    assert len(found.distances) > 300 and set(found.indices[:, 0].tolist()) == {0, 1}
    for image in (0, 1):
        of_image = found.indices[:, 0] == image
        coords = found.indices[of_image, 1:] + 0.5
        rays = made.generate_rays(camera_indices=image, coords=coords)
        ends = rays.origins + rays.directions * found.distances[of_image, None]
        pixel = 10.0 / 140.0
        assert float(torch.cdist(ends, points).amin(dim=1).max()) < pixel


def test_held_out_pixels_have_no_distance() -> None:
    found = sparse_pixels(cameras(), ground(20_000), Lattice())
    assert len(found.distances) > 1000
    assert not bool(Lattice().holds_out(found.indices).any())


def test_a_point_behind_a_roof_is_not_seen() -> None:
    roof = ground(400) / 4 + torch.tensor([0.0, 0.0, 4.0])
    found = sparse_pixels(cameras(), torch.cat([ground(), roof]), Lattice())
    offsets = (found.indices[:, 1:] - torch.tensor([61, 79])).abs()
    middle = (found.indices[:, 0] == 0) & (offsets.amax(dim=-1) < 15)
    assert bool(middle.any())
    assert float(found.distances[middle].max()) < 7.0


def test_points_behind_the_camera_other_lenses_and_few_points_give_nothing() -> None:
    behind = ground() + torch.tensor([0.0, 0.0, 20.0])
    assert len(sparse_pixels(cameras(), behind, Lattice()).distances) == 0
    assert len(sparse_pixels(cameras(kind=CameraType.FISHEYE), ground(), Lattice()).distances) == 0
    assert len(sparse_pixels(cameras(), ground(FEWEST_POINTS - 1), Lattice()).distances) == 0


def test_only_plainly_nearer_neighbours_hide_a_point() -> None:
    others = torch.cartesian_prod(torch.arange(60, 120, 4), torch.arange(0, 160, 8))
    pixels = torch.cat([torch.tensor([[5, 5], [5, 6], [6, 5], [5, 150]]), others])
    lengths = torch.full((len(pixels),), 2.0)
    lengths[0], lengths[2] = 1.0, 1.05
    assert hidden(pixels, lengths, HEIGHT, WIDTH).tolist()[:4] == [False, True, False, False]
    assert not bool(hidden(pixels, lengths, HEIGHT, WIDTH)[4:].any())


@pytest.mark.parametrize(("height", "width"), [(40, 95), (95, 40), (31, 31)])
def test_what_hides_a_point_is_nearer_in_its_cell_or_in_one_beside_it(
    height: int, width: int
) -> None:
    generator = torch.Generator().manual_seed(3)
    places = torch.rand(300, 2, generator=generator) * torch.tensor([height, width])
    pixels, lengths = places.long(), 1.0 + 9.0 * torch.rand(300, generator=generator)
    cells = pixels // round((2.0 * height * width / 300) ** 0.5)
    beside = (cells[:, None] - cells[None]).abs().amax(dim=-1) <= 1
    nearest = lengths.expand(300, 300).where(beside, torch.inf).amin(dim=1)
    assert hidden(pixels, lengths, height, width).equal(nearest < 0.9 * lengths)


def test_large_clouds_are_thinned_the_same_way_each_time(monkeypatch) -> None:
    from leco_plugin.scenes.pixels import known_distances as module

    monkeypatch.setattr(module, "MOST_POINTS", 200)
    monkeypatch.setattr(module, "MOST_PIXELS", 60)
    first, second = (sparse_pixels(cameras(), ground(), Lattice()) for _ in range(2))
    assert len(first.distances) == 60
    assert torch.equal(first.indices, second.indices)


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


@pytest.mark.parametrize(("share", "rays"), [(0.0, 400), (0.25, 1)])
def test_a_batch_whose_share_is_no_whole_pixel_has_no_known_distance(
    share: float, rays: int
) -> None:
    made = sampler(known_share=share)
    made.sparse, made.num_rays_per_batch = known(), rays
    pixels = made.sample(images())
    assert pixels[DISTANCE].tolist() == [0.0] * rays == [0.0] * len(pixels["image"])


@pytest.mark.parametrize("share", [-0.1, 1.1, math.nan])
def test_a_share_beyond_a_batch_is_refused_in_a_line(share: float) -> None:
    with refused(r"known-share is .*; it must be from 0 to 1"):
        sampler(known_share=share)


def test_masked_pixels_are_left_out() -> None:
    torch.manual_seed(0)
    made, batch = sampler(), images()
    made.sparse = known()
    batch["mask"] = torch.ones(3, 20, 30, 1, dtype=torch.bool)
    batch["mask"][1] = False
    pixels = made.sample(batch)
    assert int((pixels[DISTANCE] > 0).sum()) > 20
    assert 8 not in pixels["indices"][:, 0].tolist()


def test_pictures_that_are_set_aside_teach_by_no_distance_either() -> None:
    torch.manual_seed(0)
    made = sampler()
    made.sparse, made.set_aside = known(), torch.arange(10) == 8
    pixels = made.sample(images())
    assert int((pixels[DISTANCE] > 0).sum()) > 20
    assert 8 not in pixels["indices"][:, 0].tolist()


def of_many_sizes() -> dict[str, Any]:
    """The images 7 and 8; 7 is narrower."""
    pictures = [torch.zeros(20, 12, 3), torch.zeros(20, 30, 3)]
    return {"image": pictures, "image_idx": torch.tensor([7, 8])}


def test_nerfstudios_sampler_can_draw_any_batch_of_pictures_of_many_sizes() -> None:
    batch, plain = of_many_sizes(), PixelSamplerConfig().setup()
    dataset = SimpleNamespace(cameras=cameras())
    manager = SimpleNamespace(train_pixel_sampler=plain, train_dataset=dataset)
    with batches_of(45, manager):
        assert plain.num_rays_per_batch == 45
    dataset.cameras.height[1] += 3
    with batches_of(45, manager):
        assert len(plain.sample(batch)["indices"]) == 46
    plain.set_num_rays_per_batch(45)
    with pytest.raises(InputError, match=r"train-num-rays-per-batch is 45, .* give 46$"):
        refuse_odd_batches(manager)
    plain.set_num_rays_per_batch(44)
    refuse_odd_batches(manager)
    with batches_of(44, manager):
        assert len(plain.sample(batch)["indices"]) == 44
    manager.train_pixel_sampler = sampler()
    with batches_of(45, manager):
        assert len(manager.train_pixel_sampler.sample(batch)["indices"]) == 45


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


@pytest.mark.parametrize("k1", [0.05, -0.15, -0.25, -0.4])
def test_points_that_a_lens_folds_back_into_the_image_have_no_distance(k1: float) -> None:
    made = cameras([k1, 0.0, 0.0, 0.0, 0.0, 0.0])
    places = torch.rand(20_000, 2, generator=torch.Generator().manual_seed(0)) * 80 - 40
    found = sparse_pixels(made, torch.cat([places, torch.zeros(20_000, 1)], dim=-1), Lattice())
    assert len(found.distances) > 100
    for image in (0, 1):
        mine = found.indices[:, 0] == image
        rays = made.generate_rays(camera_indices=image, coords=found.indices[mine, 1:] + 0.5)
        to_ground = -rays.origins[:, 2] / rays.directions[:, 2]
        torch.testing.assert_close(found.distances[mine], to_ground, rtol=0.05, atol=0.0)
