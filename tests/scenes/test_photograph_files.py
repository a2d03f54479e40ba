"""Files that nerfstudio would read wrongly, or fail at, are refused by name."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest
import torch
from PIL import Image

from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.photograph_files import (
    check_images,
    check_smaller_images,
    names_what_it_cannot_read,
)
from leco_plugin.scenes.photographs import LecoPhotographsDataParserConfig

META = {"w": 8, "h": 6}


class Dataset:
    """Of one image, as nerfstudio's, which fails at it."""

    image_filenames: ClassVar = [Path("scene/0.png")]

    def get_data(self, image_idx: int, image_type: str = "float32") -> str:
        if image_type == "uint8":
            raise FileNotFoundError(2, "No such file or directory", "scene/masks_2/0.png")
        return f"image {image_idx}"


def test_what_cannot_be_read_with_an_image_is_named_beside_it() -> None:
    dataset = names_what_it_cannot_read(Dataset())
    assert dataset.get_data(0) == "image 0"
    with pytest.raises(InputError, match=r"scene/0\.png cannot be read .*masks_2/0\.png"):
        dataset.get_data(0, image_type="uint8")


def images_of(folder: Path, *modes: str) -> list[dict[str, str]]:
    """Writes an image of each of Pillow's modes; returns their frames."""
    frames = []
    for number, mode in enumerate(modes):
        name = f"{number}.{'jpg' if mode == 'CMYK' else 'png'}"
        if mode == "I;16":
            Image.fromarray(np.full((6, 8), 40_000, dtype=np.uint16)).save(folder / name)
        else:
            Image.new(mode, (8, 6)).save(folder / name)
        frames.append({"file_path": name})
    return frames


@pytest.mark.parametrize("modes", [["RGB", "RGB"], ["RGBA", "RGBA"], ["L", "RGB", "L"]])
def test_images_that_are_read_rightly_are_accepted(modes: list[str], tmp_path: Path) -> None:
    check_images(META, images_of(tmp_path, *modes), tmp_path)


@pytest.mark.parametrize("mode", ["P", "I;16", "LA", "CMYK", "1"])
def test_an_image_that_would_be_read_wrongly_is_named(mode: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=f"1[.].*mode '{mode}'.*8 bits a channel") as caught:
        check_images(META, images_of(tmp_path, "RGB", mode), tmp_path)
    assert "\n" not in str(caught.value)


def test_some_transparent_images_among_others_are_named(tmp_path: Path) -> None:
    frames = images_of(tmp_path, "RGB", "RGBA", "L")
    with pytest.raises(InputError, match=r"1 of 3 images have transparency.*1\.png"):
        check_images(META, frames, tmp_path)


def test_smaller_images_are_there_and_of_their_size_but_for_rounding(tmp_path: Path) -> None:
    names = [frame["file_path"] for frame in images_of(tmp_path, "RGB", "RGB")]
    paths = [tmp_path / name for name in names]

    def cameras(width: int, height: int) -> SimpleNamespace:
        return SimpleNamespace(
            width=torch.tensor([[8], [width]]), height=torch.tensor([[6], [height]])
        )

    for width, height in ((8, 6), (7, 7)):
        check_smaller_images(paths, cameras(width, height))
    with pytest.raises(InputError, match=r"1\.png has 8 x 6 pixels.*are 16 x 6"):
        check_smaller_images(paths, cameras(16, 6))
    paths[1].unlink()
    with pytest.raises(InputError, match=r"1\.png is not there.*downscale-factor"):
        check_smaller_images(paths, cameras(8, 6))


@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_factor_without_its_folder_of_images_is_refused(tiny_scene: Path, tmp_path: Path) -> None:
    scene = Path(shutil.copytree(tiny_scene, tmp_path / "scene"))
    reader = LecoPhotographsDataParserConfig(data=scene, downscale_factor=2).setup()
    with pytest.raises(InputError, match=r"images_2/.*is not there"):
        reader.get_dataparser_outputs("train")
    (scene / "images_2").mkdir()
    for path in (scene / "images").iterdir():
        Image.new("RGB", (16, 16)).save(scene / "images_2" / path.name)
    assert len(reader.get_dataparser_outputs("train").image_filenames) == 7
