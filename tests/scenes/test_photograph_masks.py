"""A mask shows the same pixels, whichever program wrote it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from nerfstudio.data.utils.data_utils import get_image_mask_tensor_from_path
from PIL import Image
from scene_files import refused

from leco_plugin.scenes import photograph_files
from leco_plugin.scenes.photograph_files import DerivedImages, convert_masks

SEEN = np.zeros((16, 24), dtype=bool)
SEEN[4:12, 6:18] = True
WHITE = Image.fromarray(SEEN.astype(np.uint8) * 255)


def palette(white: int) -> Image.Image:
    """With white as one of its two numbers."""
    image = Image.fromarray((white == SEEN).astype(np.uint8))
    image.putpalette([255 * (white == 0)] * 3 + [255 * (white == 1)] * 3)
    return image


def alpha(mode: str) -> Image.Image:
    """White, and transparent where it hides."""
    image = Image.new(mode, WHITE.size, "white")
    image.putalpha(WHITE)
    return image


WAYS = {
    "grey": (WHITE, "png"),
    "of 0 and 1": (Image.fromarray(SEEN.astype(np.uint8)), "png"),
    "one bit": (WHITE.convert("1"), "png"),
    "palette, white first": (palette(0), "png"),
    "palette, black first": (palette(1), "png"),
    "RGB": (WHITE.convert("RGB"), "png"),
    "opaque RGBA": (WHITE.convert("RGBA"), "png"),
    "transparent": (alpha("RGBA"), "png"),
    "grey and transparent": (alpha("LA"), "png"),
    "16 bits": (Image.fromarray(SEEN.astype(np.uint16) * 65535), "png"),
    "32 bits": (Image.fromarray(SEEN.astype(np.int32)), "tiff"),
    "floats": (Image.fromarray(SEEN.astype(np.float32)), "tiff"),
    "jpeg": (WHITE, "jpg"),
    "CMYK": (WHITE.convert("CMYK"), "tiff"),
    "coloured jpeg": (WHITE.convert("RGB"), "jpg"),
    "of twice the size": (WHITE.resize((48, 32), Image.Resampling.NEAREST), "png"),
}


def read(path: Path, size: tuple[int, int] = (24, 16)) -> np.ndarray:
    """What nerfstudio takes for seen of the file that it is given."""
    derived = DerivedImages(path.parent / "cache")
    (made,) = convert_masks([path], [Path("a.jpg")], [size], derived, speak=False)
    seen: np.ndarray = get_image_mask_tensor_from_path(made)[..., 0].numpy()
    return seen


@pytest.mark.parametrize("way", WAYS)
def test_the_same_pixels_are_seen(way: str, tmp_path: Path) -> None:
    image, ending = WAYS[way]
    path = tmp_path / f"a.{ending}"
    image.save(path, **({"quality": 60} if ending == "jpg" else {}))
    np.testing.assert_array_equal(read(path), SEEN)
    assert (tmp_path / "cache").exists() is (way not in ("grey", "of 0 and 1"))


@pytest.mark.parametrize("mode", ["L", "RGBA"])
def test_a_mask_that_lies_on_its_side_is_set_upright(mode: str, tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x112] = 6
    turned = WHITE.transpose(Image.Transpose.ROTATE_90).convert(mode)
    turned.save(tmp_path / "a.tif", exif=exif)
    np.testing.assert_array_equal(read(tmp_path / "a.tif"), SEEN)


def test_a_smaller_mask_is_made_of_the_one_of_full_size(tmp_path: Path) -> None:
    for place in ("masks", "masks_3/of_one"):
        (tmp_path / place).mkdir(parents=True)
        WHITE.save(tmp_path / place / "b.png")
    (tmp_path / "masks_3/of_one/b.png").unlink()
    (tmp_path / "masks/of_one").mkdir()
    WHITE.save(tmp_path / "masks/of_one/b.jpg.png")
    for name in ("masks_2/b.png", "masks_2/of_one/b.png"):
        derived = DerivedImages(tmp_path / "cache")
        made = convert_masks([tmp_path / name], [Path("b.jpg")], [(12, 8)], derived, False)
        seen = get_image_mask_tensor_from_path(made[0])[..., 0].numpy()
        np.testing.assert_array_equal(seen, SEEN[::2, ::2])


def test_a_mask_of_another_scene_is_not_taken_for_one_of_full_size(tmp_path: Path) -> None:
    """As of `yard`, which lies beside `yard_2`."""
    (tmp_path / "yard/masks").mkdir(parents=True)
    WHITE.save(tmp_path / "yard/masks/b.png")
    scene, derived = tmp_path / "yard_2", DerivedImages(tmp_path / "cache")
    with refused("yard_2/masks/b.png is not there"):
        convert_masks([scene / "masks/b.png"], [scene / "b.jpg"], [(24, 16)], derived, False)


def test_progress_is_shown_for_each_mask(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shares: list[float] = []

    @contextmanager
    def bar(what: str) -> Iterator[Callable[[float], None]]:
        yield shares.append

    monkeypatch.setattr(photograph_files, "bar", bar)
    masks = [tmp_path / "a.png", tmp_path / "b.png"]
    for path in masks:
        WHITE.save(path)
    convert_masks(masks, masks, 2 * [WHITE.size], DerivedImages(tmp_path / "cache"), False)
    assert shares == [0.5, 1.0]


COLOURS = Image.fromarray(np.stack([SEEN * 255, SEEN * 0, SEEN * 0], axis=-1).astype(np.uint8))
BAD = {
    "colours": (COLOURS, "has colours.*black.*white"),
    "another size": (
        WHITE.resize((10, 10)),
        "has 10 x 10 pixels, its image 24 x 16: save it as large",
    ),
    "all black": (Image.new("L", (24, 16)), "leave no pixel"),
}


@pytest.mark.parametrize("name", BAD)
def test_the_mask_is_named(name: str, tmp_path: Path) -> None:
    image, message = BAD[name]
    image.save(tmp_path / "m.tiff")
    with refused(f"mask.*{message}|{message}.*mask") as caught:
        read(tmp_path / "m.tiff")
    assert "m.tiff" in str(caught.value)


def test_a_missing_mask_is_named_and_not_its_photograph(tmp_path: Path) -> None:
    with refused(r"the mask .*masks_2/c\.png is not there"):
        read(tmp_path / "masks_2" / "c.png")


@pytest.mark.parametrize(
    ("size", "fits"),
    [((72, 48), True), ((74, 47), True), ((69, 51), True), ((76, 48), False), ((72, 52), False)],
)
def test_a_mask_of_a_whole_number_of_times_the_size_may_be_rounded(
    size: tuple[int, int], fits: bool, tmp_path: Path
) -> None:
    """By a pixel of the photograph: three of the mask."""
    WHITE.resize(size, Image.Resampling.NEAREST).save(tmp_path / "a.png")
    if fits:
        assert read(tmp_path / "a.png").shape == (16, 24)
    else:
        with refused("save it as large as its image, or a whole number"):
            read(tmp_path / "a.png")


@pytest.mark.parametrize(("lightest", "seen"), [(128, [0, 0, 1, 1]), (127, [0, 1, 1, 1])])
def test_greys_from_the_middle_on_are_seen_where_there_are_so_light_ones(
    lightest: int, seen: list[int], tmp_path: Path
) -> None:
    greys = np.array([[0, 60, lightest, 128 if lightest == 128 else 127]], np.uint8)
    Image.fromarray(greys).save(tmp_path / "a.png")
    assert read(tmp_path / "a.png", (4, 1)).tolist() == [[bool(each) for each in seen]]


def test_greys_beside_an_opacity_are_those_of_a_mask_without_one(tmp_path: Path) -> None:
    greys = np.arange(100, 160, dtype=np.uint8)[None]
    Image.fromarray(greys).convert("LA").save(tmp_path / "a.png")
    assert (read(tmp_path / "a.png", (60, 1)) == (greys >= 128)).all()


@pytest.mark.parametrize(("difference", "is_grey"), [(40, True), (41, False)])
def test_a_little_colour_is_left_by_jpeg(difference: int, is_grey: bool, tmp_path: Path) -> None:
    pixels = np.full((2, 3, 3), 200, np.uint8)
    pixels[1, 2, 1] -= difference
    Image.fromarray(pixels).save(tmp_path / "a.png")
    if is_grey:
        assert read(tmp_path / "a.png", (3, 2)).all()
    else:
        with refused("has colours"):
            read(tmp_path / "a.png", (3, 2))
