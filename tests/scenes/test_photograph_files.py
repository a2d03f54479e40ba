"""Files that nerfstudio would read wrongly, or fail at, are converted or refused by name."""

from __future__ import annotations

import os
import struct
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar
from unicodedata import normalize

import numpy as np
import pytest
from PIL import Image, ImageOps
from rendered_survey import odd_exif
from scene_files import refused

from leco_plugin.scenes import photograph_files
from leco_plugin.scenes.photograph_files import (
    DerivedImages,
    check_images,
    check_kind,
    decode,
    find_file,
    header_of,
    is_plain,
    names_what_it_cannot_read,
)


class Dataset:
    """Of one image, as nerfstudio's, which fails at it."""

    image_filenames: ClassVar = [Path("scene/0.png")]

    def get_data(self, image_idx: int, image_type: str = "float32") -> str:
        if image_type == "uint8":
            raise FileNotFoundError(2, "No such file or directory", "scene/masks_2/0.png")
        if image_type == "struct":
            raise RuntimeError("encoder error")
        return f"image {image_idx}"


def test_what_cannot_be_read_with_an_image_is_named_beside_it() -> None:
    dataset = names_what_it_cannot_read(Dataset())
    assert dataset.get_data(0) == "image 0"
    with refused(r"scene/0\.png cannot be read .*masks_2/0\.png"):
        dataset.get_data(0, image_type="uint8")
    with refused(r"scene/0\.png cannot be read .*encoder error"):
        dataset.get_data(0, image_type="struct")


def write(path: Path, mode: str) -> Path:
    """An image of 8 x 6 in one of Pillow's modes."""
    values = np.arange(48, dtype=np.uint8).reshape(6, 8)
    if mode in ("I;16", "I", "F"):
        kind = {"I;16": np.uint16, "I": np.int32, "F": np.float32}[mode]
        Image.fromarray(values.astype(kind) * 100).save(path)
    else:
        Image.fromarray(np.stack([values, values * 2, values * 5], axis=-1)).convert(mode).save(
            path
        )
    return path


@pytest.mark.parametrize(
    ("mode", "ending", "plain"),
    [
        ("1", "png", "L"),
        ("P", "png", "RGB"),
        ("P", "gif", "RGB"),
        ("LA", "png", "RGBA"),
        ("CMYK", "jpg", "RGB"),
    ],
)
def test_modes_that_nerfstudio_takes_for_others_are_converted(
    mode: str, ending: str, plain: str, tmp_path: Path
) -> None:
    path = write(tmp_path / f"a.{ending}", mode)
    header = header_of(path)
    check_kind(path, header)
    assert not is_plain(header)
    found = decode(path, turn=False)
    assert found.mode == plain
    with Image.open(path) as image:
        expected = np.asarray(image.convert("RGBA" if plain == "RGBA" else "RGB"))
    np.testing.assert_array_equal(
        np.asarray(found.convert("RGBA" if plain == "RGBA" else "RGB")), expected
    )


@pytest.mark.parametrize("orientation", range(1, 9))
def test_an_image_is_turned_as_exif_says_whatever_else_that_says(
    orientation: int, tmp_path: Path
) -> None:
    """With a resolution as text, which Pillow cannot write."""
    path = write(tmp_path / "a.png", "RGB")
    sound = Image.Exif()
    sound[0x112] = orientation
    with Image.open(path) as image:
        image.save(path, exif=sound)
    with Image.open(path) as image:
        wanted = np.asarray(ImageOps.exif_transpose(image))
        image.save(path, exif=odd_exif((0x11A, 2, 4, b"300\0"), orientation=orientation))
    np.testing.assert_array_equal(np.asarray(decode(path, turn=True)), wanted)


@pytest.mark.parametrize("mode", ["L", "RGB", "RGBA"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_tiff_is_known_as_pillow_decodes_it_which_sets_it_upright(
    orientation: int, mode: str, tmp_path: Path
) -> None:
    """`leco poses` would give its photographs a lens of the other sides."""
    exif = Image.Exif()
    exif[0x112] = orientation
    with Image.open(write(tmp_path / "a.png", mode)) as image:
        image.save(tmp_path / "a.tif", exif=exif)
        image.save(tmp_path / "b.png", exif=exif)
    header, wanted = header_of(tmp_path / "a.tif"), np.asarray(decode(tmp_path / "b.png", True))
    assert header.orientation == 1
    assert header.size == ((6, 8) if orientation >= 5 else (8, 6))
    for turn in (True, False):
        np.testing.assert_array_equal(np.asarray(decode(tmp_path / "a.tif", turn)), wanted)
    with Image.open(tmp_path / "a.tif") as image:  # as nerfstudio does, which Pillow maps
        is_right = np.array_equal(np.asarray(image), wanted)
    assert is_right or not is_plain(header)


@pytest.mark.parametrize(("orientation", "size"), [(3, (8, 6)), (6, (6, 8))])
def test_a_pillow_that_gives_the_stored_sides_of_a_tiff_is_followed(
    orientation: int, size: tuple[int, int]
) -> None:
    """As Pillow 10.4 does until it decodes."""
    tags = {0x100: 8, 0x101: 6, 0x112: orientation}
    image: Any = SimpleNamespace(size=(8, 6), format="TIFF", getexif=lambda: tags)
    assert photograph_files._size_and_orientation(image) == (size, 1)


@pytest.mark.parametrize("mode", ["L", "RGB", "RGBA"])
def test_images_that_are_read_rightly_stay_as_they_are(mode: str, tmp_path: Path) -> None:
    path = write(tmp_path / "a.png", mode)
    check_kind(path, header_of(path))
    assert is_plain(header_of(path))


@pytest.mark.parametrize("mode", ["I;16", "I", "F"])
def test_deep_images_are_refused_by_name(mode: str, tmp_path: Path) -> None:
    path = write(tmp_path / "a.tiff", mode)
    with refused(f"a[.]tiff.*mode '{mode}'.*8 bits a channel"):
        check_kind(path, header_of(path))


def test_an_animation_is_refused_and_a_preview_is_not(tmp_path: Path) -> None:
    frames = [Image.new("RGB", (8, 6), (shade, 0, 0)) for shade in (0, 200)]
    frames[0].save(tmp_path / "a.gif", save_all=True, append_images=frames[1:])
    with refused(r"a\.gif holds more pictures than one"):
        check_kind(tmp_path / "a.gif", header_of(tmp_path / "a.gif"))
    frames[0].save(tmp_path / "a.jpg", format="MPO", save_all=True, append_images=frames[1:])
    check_kind(tmp_path / "a.jpg", header_of(tmp_path / "a.jpg"))


def test_names_as_windows_and_instant_ngp_write_them_are_found(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    path = write(tmp_path / "images" / "a.png", "RGB")
    for name in ("images/a.png", "images\\a.png", "images/a", "images\\a"):
        assert find_file(tmp_path / name) == path
        check_images([find_file(tmp_path / name)])
    apart = tmp_path / "é" / normalize("NFD", "ü")  # in a folder that is spelled otherwise
    apart.mkdir(parents=True)
    path = write(apart / normalize("NFD", "ö.png"), "RGB")
    assert find_file(tmp_path / "é" / "ü\\ö") == path
    with refused(r"1 of 1 image is not there.*written by Windows.*backslash"):
        check_images([find_file(tmp_path / "images\\b.png")])


@pytest.mark.parametrize(
    ("named", "there", "why"),
    [
        ("a.jpg", "a.JPG", "there is a.JPG, write its name like that"),
        ("a.jpg", "A.png", "there is A.png, write its name like that"),
        ("a", "a b.jpg", r"there is a b\.jpg, .* up to a blank: give its \.bin files, or names .*"),
        ("a.jpg", "b.jpg", "put it there, or leave its frame out"),
    ],
)
def test_a_photograph_that_is_missing_is_told_from_a_wrong_name(
    named: str, there: str, why: str, tmp_path: Path
) -> None:
    (tmp_path / there).touch()
    for check in (lambda path: check_images([path]), header_of):
        with refused(f"not there.*: {why}$"):
            check(tmp_path / named)


def test_a_link_that_leads_nowhere_and_a_name_that_is_too_long_are_missing(tmp_path: Path) -> None:
    link, long = tmp_path / "a.jpg", tmp_path / ("a" * 300)
    link.symlink_to("/nowhere/b.jpg")
    with refused("1 of 1 image is not there.*a.jpg: it is a link to /nowhere/b.jpg, which is not"):
        check_images([link])
    assert find_file(long) == long
    with refused("1 of 1 image is not there"):
        check_images([long])


def test_a_photograph_that_may_not_be_read_is_not_called_damaged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path, mode: str) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "open", refuse)
    with refused(r"a\.jpg: Permission denied: give yourself the right to read it"):
        header_of(tmp_path / "a.jpg")


def test_a_closed_folder_is_not_called_empty(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    with monkeypatch.context() as patched, refused(r"a\.jpg: Permission .*to enter its folder$"):
        patched.setattr(os, "stat", refuse)
        check_images([tmp_path / "a.jpg"])
    monkeypatch.setattr(os, "listdir", refuse)
    with refused(r"1 of 1 image is not there, .*a\.jpg: put it there"):
        check_images([tmp_path / "a.jpg"])


def test_a_smaller_picture_that_is_missing_has_a_way_around(tmp_path: Path) -> None:
    with refused(r"make it, 1/2 of .*--downscale-factor 1"):
        header_of(tmp_path / "images_2" / "a.png")
    with refused(r"flight_2/a\.png is not there: put it there") as caught:
        header_of(tmp_path / "flight_2" / "a.png")
    assert "downscale" not in str(caught.value)


def test_a_tiff_whose_second_directory_is_damaged_is_refused_by_name(tmp_path: Path) -> None:
    path = write(tmp_path / "a.tif", "RGB")
    data = bytearray(path.read_bytes())
    (at,) = struct.unpack_from("<I", data, 4)
    (entries,) = struct.unpack_from("<H", data, at)
    struct.pack_into("<I", data, at + 2 + 12 * entries, len(data))
    path.write_bytes(data + struct.pack("<HHHIII", 1, 258, 3, 1, 8, 0))
    with refused(r"a\.tif cannot be read as an image"):
        header_of(path)


@pytest.mark.parametrize("start", [b"v/1\x01", b"\0\0\0\x18ftypheic", b"#?RADIANCE\n", b"II*\0"])
def test_kinds_that_are_not_read_are_to_be_saved_as_others(start: bytes, tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(start + bytes(100))
    with refused(r"a\.png cannot be .*save it as JPEG or PNG with 8 bits"):
        header_of(path)


@pytest.fixture
def source(tmp_path: Path) -> Path:
    Image.effect_noise((20, 20), 90).save(tmp_path / "a.png")
    return tmp_path / "a.png"


def test_a_picture_is_made_once_for_each_recipe(source: Path, tmp_path: Path) -> None:
    made = []

    def make() -> Image.Image:
        made.append(1)
        return Image.new("L", (3, 3), 7)

    derived = DerivedImages(tmp_path / "cache")
    first = derived.get(source, "small", make)
    assert derived.get(source, "small", make) == first and len(made) == 1
    assert derived.get(source, "large", make) != first and len(made) == 2
    assert decode(first, turn=False).getpixel((0, 0)) == 7
    assert header_of(first).size == (3, 3) and header_of(first).mode == "L"


def test_a_changed_source_is_not_taken_for_the_old_one(source: Path, tmp_path: Path) -> None:
    derived = DerivedImages(tmp_path / "cache")
    old = derived.get(source, "copy", lambda: decode(source, turn=False))
    os.utime(source, ns=(1, 1))
    assert derived.get(source, "copy", lambda: decode(source, turn=False)) != old


def test_a_source_that_is_no_picture_leaves_nothing(source: Path, tmp_path: Path) -> None:
    source.write_bytes(source.read_bytes()[:-30])
    with refused(r"a\.png cannot be read "):
        DerivedImages(tmp_path / "cache").get(source, "copy", lambda: decode(source, turn=False))
    assert not (tmp_path / "cache").exists()


def test_a_source_with_the_longest_name_that_there_is_has_a_picture(tmp_path: Path) -> None:
    source = write(tmp_path / ("\u6d77" * 83 + ".png"), "RGB")
    path = DerivedImages(tmp_path / "cache").get(source, "copy", lambda: decode(source, turn=False))
    assert path.is_file()


def test_a_source_whose_name_is_not_of_utf_8_has_a_picture(tmp_path: Path) -> None:
    source = write(tmp_path / os.fsdecode(b"caf\xe9.png"), "RGB")
    path = DerivedImages(tmp_path / "cache").get(source, "copy", lambda: decode(source, turn=False))
    assert path.is_file()


def test_a_place_that_cannot_be_written_is_named_with_the_remedy(source: Path) -> None:
    with refused(r"cannot be written .*--cache"):
        DerivedImages(source / "cache").get(source, "copy", lambda: decode(source, turn=False))


def test_the_jpeg_of_a_drone_with_its_preview_is_a_picture(tmp_path: Path) -> None:
    path = tmp_path / "DJI_0001.JPG"
    small = Image.new("RGB", (4, 3))
    Image.new("RGB", (40, 30)).save(path, format="MPO", save_all=True, append_images=[small])
    assert header_of(path).size == (40, 30) and header_of(path).mode == "RGB"
    assert decode(path, turn=False).size == (40, 30)
