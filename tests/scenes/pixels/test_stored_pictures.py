"""Pixels read from files are those of the photographs."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.datasets.base_dataset import InputDataset
from nerfstudio.data.pixel_samplers import PixelSamplerConfig
from PIL import Image
from scene_files import refused

from leco_plugin.scenes.pixels.held_out_pixels import (
    HeldOutPixelSampler,
    Lattice,
    some_images,
)
from leco_plugin.scenes.pixels.stored_pictures import store_pictures

SIZES = [(30, 40), (24, 36), (50, 20)]


def write(folder: Path, masked: bool = False, channels: int = 3) -> InputDataset:
    """Noise in three sizes; masks keep the left half."""
    random = np.random.default_rng(0)
    images, masks = [], []
    for number, (height, width) in enumerate(SIZES):
        path = folder / f"{number}.png"
        noise = random.integers(0, 256, (height, width, channels), dtype=np.uint8)
        Image.fromarray(noise).save(path)
        images.append(path)
        mask = np.zeros((height, width), dtype=np.uint8)
        mask[:, : width // 2] = 255
        masks.append(folder / f"mask-{number}.png")
        Image.fromarray(mask).save(masks[-1])
    sizes = torch.tensor(SIZES)
    cameras = Cameras(
        torch.eye(4)[:3].repeat(3, 1, 1), 30.0, 30.0, 10.0, 10.0, sizes[:, 1], sizes[:, 0]
    )
    return InputDataset(
        DataparserOutputs(images, cameras, mask_filenames=masks if masked else None)
    )


def sampler(rays: int = 4000, **options: object) -> HeldOutPixelSampler:
    made = PixelSamplerConfig(HeldOutPixelSampler).setup(num_rays_per_batch=rays, **options)
    assert isinstance(made, HeldOutPixelSampler)
    return made


@pytest.mark.parametrize("channels", [3, 4])
def test_every_pixel_is_that_of_the_photograph(tmp_path: Path, channels: int) -> None:
    dataset = write(tmp_path, channels=channels)
    stored = store_pictures(dataset, tmp_path / "pixels")["image"]
    pixels = stored.draw(500)
    read = stored.read(pixels)
    images = [dataset.get_data(number)["image"] for number in range(3)]
    expected = torch.stack([images[i][r, c] for i, r, c in pixels.tolist()])
    torch.testing.assert_close(read, expected, atol=1e-6, rtol=0)


def test_pixels_are_drawn_evenly_over_pictures_of_different_sizes(tmp_path: Path) -> None:
    stored = store_pictures(write(tmp_path), tmp_path / "pixels")["image"]
    pixels = stored.draw(60_000)
    sizes = torch.tensor(SIZES)
    assert bool((pixels[:, 1:] < sizes[pixels[:, 0]]).all()) and int(pixels.min()) == 0
    shares = torch.bincount(pixels[:, 0]).float() / len(pixels)
    torch.testing.assert_close(shares, sizes.prod(-1) / sizes.prod(-1).sum(), atol=0.02, rtol=0)
    assert len(pixels.unique(dim=0)) == int(sizes.prod(-1).sum())


def test_a_batch_is_of_pixels_that_are_not_held_out_and_not_masked(tmp_path: Path) -> None:
    dataset = write(tmp_path, masked=True)
    batch = sampler().sample(store_pictures(dataset, tmp_path / "pixels"))
    indices = batch["indices"]
    assert batch["image"].shape == (4000, 3)
    pictures = [dataset.get_data(number)["image"] for number in range(3)]
    expected = torch.stack([pictures[i][r, c] for i, r, c in indices.tolist()])
    torch.testing.assert_close(batch["image"], expected, atol=1e-6, rtol=0)
    widths = torch.tensor(SIZES)[indices[:, 0], 1]
    assert not bool(Lattice().holds_out(indices).any())
    assert bool((indices[:, 2] < widths // 2).all())


def test_pixels_in_files_are_those_that_a_fisheye_shows(tmp_path: Path) -> None:
    stored = store_pictures(write(tmp_path), tmp_path / "pixels")
    made, sizes = sampler(fisheye_crop_radius=9.0), torch.tensor(SIZES)
    for pixels in (made.sample(stored)["indices"], made.sample_held_out(stored, 50, 0)["indices"]):
        offsets = pixels[:, 1:] + 0.5 - sizes[pixels[:, 0]] / 2
        assert len(pixels) > 5 and float(offsets.norm(dim=-1).max()) <= 9.0


def test_pixels_of_panoramas_in_files_are_drawn_by_solid_angle(tmp_path: Path) -> None:
    stored = store_pictures(write(tmp_path), tmp_path / "pixels")
    indices = sampler(60_000, is_equirectangular=True).sample(stored)["indices"]
    heights = torch.tensor(SIZES)[indices[:, 0], 0]
    polar = (indices[:, 1] + 0.5) / heights
    for low, high in ((0.0, 0.25), (0.25, 0.5), (0.5, 1.0)):
        share = ((polar >= low) & (polar < high)).float().mean()
        expected = 0.5 * (np.cos(np.pi * low) - np.cos(np.pi * high))
        assert float(share) == pytest.approx(expected, abs=0.03)


def test_held_out_pixels_are_found_in_files_and_in_images_read_for_it(tmp_path: Path) -> None:
    dataset = write(tmp_path, masked=True)
    for images in (store_pictures(dataset, tmp_path / "pixels"), some_images(dataset)):
        batch = sampler().sample_held_out(images, 200, seed=0)
        indices = batch["indices"]
        assert 10 < len(indices) <= 200 and bool(Lattice().holds_out(indices).all())
        pictures = [dataset.get_data(number)["image"] for number in range(3)]
        expected = torch.stack([pictures[i][r, c] for i, r, c in indices.tolist()])
        torch.testing.assert_close(batch["image"], expected, atol=1e-6, rtol=0)


def test_a_photograph_is_decoded_once_and_again_when_it_has_changed(tmp_path: Path) -> None:
    dataset, folder = write(tmp_path), tmp_path / "pixels"
    first = store_pictures(dataset, folder)["image"].files
    written = [path.stat().st_mtime_ns for path in first]
    again = store_pictures(dataset, folder)["image"].files
    assert again == first and [path.stat().st_mtime_ns for path in again] == written
    os.utime(tmp_path / "1.png", ns=(1, 1))
    changed = store_pictures(dataset, folder)["image"].files
    assert [one == other for one, other in zip(first, changed)] == [True, False, True]


def test_what_cannot_be_stored_is_said_in_one_line(tmp_path: Path) -> None:
    dataset = write(tmp_path)
    (tmp_path / "file").write_text("")
    with refused(r"--pipeline\.datamanager\.pixels"):
        store_pictures(dataset, tmp_path / "file" / "pixels")
    dataset.cameras.width[1] += 1
    with refused(r"1\.png has 36 x 24 pixels, its camera 37 x 24"):
        store_pictures(dataset, tmp_path / "pixels")


def test_a_damaged_file_is_noticed(tmp_path: Path) -> None:
    dataset = write(tmp_path)
    stored = store_pictures(dataset, tmp_path / "pixels")["image"]
    stored.files[0].write_bytes(b"short")
    with refused("damaged"):
        store_pictures(dataset, tmp_path / "pixels")


def test_a_file_cut_off_while_a_run_goes_on_is_one_line(tmp_path: Path) -> None:
    stored = store_pictures(write(tmp_path), tmp_path / "pixels")["image"]
    stored.files[1].write_bytes(stored.files[1].read_bytes()[:-2])
    assert stored.read(torch.tensor([[0, 29, 39]])).shape == (1, 3)
    with refused("is cut off"):
        stored.read(torch.tensor([[1, 23, 35]]))
