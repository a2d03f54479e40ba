"""A derived picture is made once, anew when its source changes, and never half."""

import os
from pathlib import Path

import pytest
from PIL import Image

from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.photograph_files import DerivedImages, open_image


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
    assert open_image(first).getpixel((0, 0)) == 7
    header = open_image(first, pixels=False)
    assert header.size == (3, 3) and header.mode == "L"


def test_a_changed_source_is_not_taken_for_the_old_one(source: Path, tmp_path: Path) -> None:
    derived = DerivedImages(tmp_path / "cache")
    old = derived.get(source, "copy", lambda: open_image(source))
    os.utime(source, ns=(1, 1))
    assert derived.get(source, "copy", lambda: open_image(source)) != old


def test_a_source_that_is_no_picture_leaves_nothing(source: Path, tmp_path: Path) -> None:
    source.write_bytes(source.read_bytes()[:-30])
    with pytest.raises(InputError, match=r"a\.png cannot be read as a picture") as caught:
        DerivedImages(tmp_path / "cache").get(source, "copy", lambda: open_image(source))
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "cache").exists()


def test_a_place_that_cannot_be_written_is_named_with_the_remedy(source: Path) -> None:
    with pytest.raises(InputError, match=r"cannot be written .*--cache"):
        DerivedImages(source / "cache").get(source, "copy", lambda: open_image(source))


def test_the_jpeg_of_a_drone_with_its_preview_is_a_picture(tmp_path: Path) -> None:
    path = tmp_path / "DJI_0001.JPG"
    small = Image.new("RGB", (4, 3))
    Image.new("RGB", (40, 30)).save(path, format="MPO", save_all=True, append_images=[small])
    header = open_image(path, pixels=False)
    assert header.size == (40, 30) and header.mode == "RGB"
    assert open_image(path).size == (40, 30)
