"""Pictures and masks in the size and the part that the protocol asks for, or refused by name."""

from __future__ import annotations

import dataclasses
import zipfile
from pathlib import Path

import mega_nerf_scene
import numpy as np
import pytest
import torch
from mega_nerf_scene import pack, write_mask, zipped
from PIL import Image
from PIL.PngImagePlugin import PngImageFile
from scene_files import refused

from leco_plugin.scenes.mega_nerf_files import Frame, read_scene
from leco_plugin.scenes.mega_nerf_outputs import mask_of, picture_of, read_mask, scaled
from leco_plugin.scenes.photograph_files import DerivedImages


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return mega_nerf_scene.write(tmp_path_factory.mktemp("scenes") / "scene", masks=True)


@pytest.fixture(scope="module")
def frame(scene: Path) -> Frame:
    return read_scene(scene).frames[2]


@pytest.fixture
def derived(tmp_path: Path) -> DerivedImages:
    return DerivedImages(tmp_path / "cache")


def pixels(path: Path | None) -> np.ndarray:
    assert path is not None
    return np.array(Image.open(path))


def test_a_picture_of_the_right_size_is_the_file_itself(
    frame: Frame, derived: DerivedImages
) -> None:
    assert picture_of(frame, 1, False, derived) == frame.image
    assert not derived.folder.exists()


def test_no_pixel_is_decoded_before_a_picture_is_made(
    scene: Path, derived: DerivedImages, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To look for an orientation Pillow decodes a PNG: of a large scene that takes minutes."""
    masks = scene / "masks"
    frames = read_scene(scene).frames
    made = [mask_of(frame, 1, False, masks, derived) for frame in frames]
    monkeypatch.setattr(PngImageFile, "load", lambda image: pytest.fail("decoded"))
    assert len(read_scene(scene).frames) == len(frames)
    for frame, mask in zip(frames, made):
        assert picture_of(frame, 1, False, derived) == frame.image
        assert mask_of(frame, 1, False, masks, derived) == mask


def test_a_smaller_picture_is_resized_by_lanczos(frame: Frame, derived: DerivedImages) -> None:
    small = pixels(picture_of(frame, 4, False, derived))
    whole = Image.fromarray(mega_nerf_scene.image(2))
    np.testing.assert_array_equal(small, np.array(whole.resize((6, 4), Image.Resampling.LANCZOS)))
    half = pixels(picture_of(frame, 4, True, derived))
    np.testing.assert_array_equal(half, small[:, 3:])


def test_the_right_half_of_an_odd_width_is_the_larger_one(
    frame: Frame, derived: DerivedImages
) -> None:
    assert pixels(picture_of(frame, 8, True, derived)).shape == (2, 2, 3)  # of 3 columns


def test_other_kinds_of_pixels_become_colours(
    frame: Frame, derived: DerivedImages, tmp_path: Path
) -> None:
    whole = Image.fromarray(mega_nerf_scene.image(2))
    for mode, channels in (("P", 3), ("LA", 4), ("CMYK", 3)):
        path = tmp_path / f"{mode}.{'jpg' if mode == 'CMYK' else 'png'}"
        whole.convert(mode).save(path)
        other = dataclasses.replace(frame, image=path)
        assert pixels(picture_of(other, 1, False, derived)).shape == (16, 24, channels)


def test_factors_that_do_not_divide_or_enlarge_are_refused(frame: Frame) -> None:
    with refused("scale factor of 5 does not divide"):
        scaled(frame, 5)
    small = dataclasses.replace(frame, image_size=(6, 4))
    assert scaled(small, 4) == (6, 4)
    with refused(r"fewer than the 12 x 8 .* larger scale factor"):
        scaled(small, 2)


def test_masks_are_unpacked_resized_and_cut(
    scene: Path, frame: Frame, derived: DerivedImages
) -> None:
    keep = mega_nerf_scene.mask(2)
    whole = pixels(mask_of(frame, 1, False, scene / "masks", derived))
    np.testing.assert_array_equal(whole, 255 * keep)
    left = pixels(mask_of(frame, 1, True, scene / "masks", derived))
    np.testing.assert_array_equal(left[:, :12], whole[:, :12])
    assert not left[:, 12:].any()
    small = pixels(mask_of(frame, 2, False, scene / "masks", derived))
    assert small.shape == (8, 12) and set(np.unique(small)) == {0, 255}


def test_without_masks_only_halves_are_cut(frame: Frame, derived: DerivedImages) -> None:
    assert pixels(mask_of(frame, 1, False, None, derived)).all()
    left = pixels(mask_of(frame, 8, True, None, derived))
    assert left[:, :1].all() and not left[:, 1:].any()


def test_a_mask_that_keeps_nothing_is_none(scene: Path, derived: DerivedImages) -> None:
    frame = read_scene(scene).frames[4]
    for _ in range(2):  # the second time from its file
        assert mask_of(frame, 1, False, scene / "masks", derived) is None


def test_a_missing_mask_is_named(frame: Frame, derived: DerivedImages, tmp_path: Path) -> None:
    with refused(r"000002\.pt: each picture needs a mask"):
        mask_of(frame, 1, False, tmp_path, derived)


KEEP = np.random.default_rng(0).random((6, 9)) < 0.5


def test_a_mask_comes_back_as_it_was_written(tmp_path: Path) -> None:
    write_mask(tmp_path, "a", KEEP)
    np.testing.assert_array_equal(read_mask(tmp_path / "a.pt", 9, 6), KEEP)


def test_a_mask_of_another_size_is_named(tmp_path: Path) -> None:
    write_mask(tmp_path, "a", KEEP)
    with refused(r"a\.pt is a mask of 9 x 6 pixels, its picture has 6 x 9"):
        read_mask(tmp_path / "a.pt", 6, 9)


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        (torch.ones(6, 9), "a tensor of float32, 6 x 9"),
        (torch.ones(6, 9, 1, dtype=torch.bool), "a tensor of bool, 6 x 9 x 1"),
        ({"mask": torch.ones(6, 9, dtype=torch.bool)}, "a value of type dict"),
    ],
)
def test_what_is_no_mask_is_named(value: object, reason: str, tmp_path: Path) -> None:
    with refused(reason):
        read_mask(pack(tmp_path / "a.pt", value), 9, 6)


def test_a_zip_without_the_mask_and_a_bare_pt_are_named(tmp_path: Path) -> None:
    pack(tmp_path / "a.pt", torch.from_numpy(KEEP), "b.pt")
    torch.save(torch.from_numpy(KEEP), tmp_path / "c.pt")
    for name in "ac":
        with refused(f"is a zip without {name}.pt"):
            read_mask(tmp_path / f"{name}.pt", 9, 6)


def test_a_zip_bomb_is_not_unpacked(tmp_path: Path) -> None:
    (tmp_path / "a.pt").write_bytes(zipped(bytes(60_000_000), "a.pt", zipfile.ZIP_DEFLATED))
    assert (tmp_path / "a.pt").stat().st_size < 100_000
    with refused(r"a\.pt unpacks to more than"):
        read_mask(tmp_path / "a.pt", 300, 200)


def test_other_compressions_and_large_files_are_refused(tmp_path: Path) -> None:
    pack(tmp_path / "a.pt", torch.from_numpy(KEEP), compression=zipfile.ZIP_BZIP2)
    with refused("does not use"):
        read_mask(tmp_path / "a.pt", 9, 6)
    (tmp_path / "a.pt").write_bytes(bytes(1 << 20))
    with refused("needs no more than"):
        read_mask(tmp_path / "a.pt", 9, 6)


def test_no_mask_and_a_damaged_one_are_named(tmp_path: Path) -> None:
    with refused("no file"):
        read_mask(tmp_path / "a.pt", 9, 6)
    (tmp_path / "a.pt").write_bytes(b"PK\x03\x04")
    with refused("is not a zip with a mask"):
        read_mask(tmp_path / "a.pt", 9, 6)
