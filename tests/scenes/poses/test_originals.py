"""Claims about which photographs are used, and what their copies are."""

from __future__ import annotations

import os
import struct
import warnings
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rendered_survey import exif_of, odd_exif
from scene_files import refused

from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.photograph_files import decode
from leco_plugin.scenes.poses import originals
from leco_plugin.scenes.poses.originals import (
    copy_photographs,
    find_photographs,
    without_repeats,
)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three small photographs that differ."""
    made = tmp_path / "photos"
    made.mkdir()
    for number in range(3):
        noise = np.random.default_rng(number).integers(0, 255, (24, 32, 3), dtype=np.uint8)
        Image.fromarray(noise).save(made / f"IMG_{number}.jpg", exif=exif_of((number, 0.0, 9.0)))
    return made


def copies(folder: Path, out: Path) -> dict[str, Image.Image]:
    copy_photographs(find_photographs(folder, out), out / "images")
    opened = {}
    for path in (out / "images").iterdir():
        with Image.open(path) as image:
            image.load()
            opened[path.name] = image
    return opened


def test_plain_photographs_are_copied_byte_by_byte(folder: Path, tmp_path: Path) -> None:
    copies(folder, tmp_path / "out")
    for path in folder.iterdir():
        copy = tmp_path / "out" / "images" / path.name
        assert copy.read_bytes() == path.read_bytes() and not copy.samefile(path)


def test_a_turned_photograph_is_copied_upright_with_its_exif(folder: Path, tmp_path: Path) -> None:
    exif = exif_of((1.0, 2.0, 3.0))
    exif[0x0112] = 6
    with Image.open(folder / "IMG_1.jpg") as image:
        image.rotate(90, expand=True).save(folder / "IMG_3.jpg", quality=95, exif=exif)
        upright = np.asarray(image, dtype=float)
    photographs = find_photographs(folder, tmp_path / "out").photographs
    found = {each.path.name: each for each in photographs}
    assert found["IMG_3.jpg"].size == (32, 24)
    copy = copies(folder, tmp_path / "out")["IMG_3.jpg"]
    assert copy.size == (32, 24) and copy.getexif()[0x0112] == 1
    assert np.abs(np.asarray(copy, dtype=float) - upright).mean() < 20.0
    again = find_photographs(tmp_path / "out" / "images", tmp_path / "x").photographs
    assert [each.exif.position for each in again][3] == found["IMG_3.jpg"].exif.position


GPS_BEGINS = 8 + 2 + 2 * 12 + 4
"""Offset of what follows a folder of two tags: orientation, and where GPS is."""


@pytest.mark.parametrize(
    "exif",
    [
        odd_exif((0x11A, 2, 4, b"300\0")),
        odd_exif((0x128, 2, 3, b"in\0\0")),
        odd_exif((0x100, 9, 1, struct.pack("<i", -1))),
        *(
            odd_exif((0x8825, 4, 1, struct.pack("<I", GPS_BEGINS)))
            + struct.pack("<HHHI4sI", 1, tag, kind, count, value, 0)
            + struct.pack("<ii", -33, 1)
            for tag, kind, count, value in (
                (0, 2, 4, b"2.3\0"),
                (5, 2, 2, b"0\0\0\0"),
                (2, 10, 1, struct.pack("<I", GPS_BEGINS + 18)),
            )
        ),
    ],
    ids=["resolution", "unit", "width", "version of GPS", "reference of altitude", "degrees"],
)
def test_a_photograph_whose_exif_cannot_be_written_anew_is_turned(
    exif: bytes, folder: Path, tmp_path: Path
) -> None:
    with Image.open(folder / "IMG_2.jpg") as image:
        image.save(folder / "IMG_2.jpg", exif=exif)
    copy = copies(folder, tmp_path / "out")["IMG_2.jpg"]
    assert copy.size == (24, 32) and copy.getexif()[0x0112] == 1


@pytest.mark.parametrize("mode", ["L", "LA", "P", "1", "CMYK"])
def test_other_colours_become_those_that_nerfstudio_reads(
    mode: str, folder: Path, tmp_path: Path
) -> None:
    for path in [*folder.iterdir()]:
        with Image.open(path) as image:
            ending = ".tif" if mode == "CMYK" else ".png"
            image.convert("L" if mode == "LA" else "RGB").convert(mode).save(
                path.with_suffix(ending)
            )
        path.unlink()
    assert {image.mode for image in copies(folder, tmp_path / "out").values()} <= (
        {"RGBA"} if mode == "LA" else {"L", "RGB"}
    )


def test_photographs_of_other_folders_and_names_do_not_collide(
    folder: Path, tmp_path: Path
) -> None:
    for place in ("a/b.jpg", "a_b.jpg", "more of it/IMG 0.JPG"):
        (folder / place).parent.mkdir(exist_ok=True)
        (folder / place).write_bytes((folder / "IMG_0.jpg").read_bytes())
    names = [each.name for each in find_photographs(folder, tmp_path / "out").photographs]
    assert len({name.lower() for name in names}) == 6
    assert not any(" " in name or "/" in name for name in names)
    assert sum(name.endswith("more_of_it_IMG_0.JPG") for name in names) == 1


def test_a_photograph_that_is_there_twice_is_used_once(folder: Path, tmp_path: Path) -> None:
    (folder / "again").mkdir()
    (folder / "again" / "IMG_0.jpg").write_bytes((folder / "IMG_0.jpg").read_bytes())
    (folder / "again" / "other.jpg").write_bytes((folder / "IMG_1.jpg").read_bytes() + b"x")
    found = without_repeats(find_photographs(folder, tmp_path / "out"))
    assert found.repeats == (folder / "again" / "IMG_0.jpg",) and len(found.photographs) == 4
    (line,) = found.refused.values()
    assert line.endswith(f"is the same file as {folder / 'IMG_0.jpg'}")
    for path in (folder / "IMG_2.jpg", folder / "again" / "other.jpg"):
        path.unlink()
    with refused("is the same file as .*2 of 3 photographs can be used"):
        without_repeats(find_photographs(folder, tmp_path / "out"))


def test_a_number_that_tells_two_apart_is_nobody_elses_name(tmp_path: Path) -> None:
    for number, name in enumerate(("1_x_y.jpg", "x y.jpg", "x_y.jpg")):
        Image.new("RGB", (20, 20), (60 * number, 0, 0)).save(tmp_path / name)
    names = [each.name for each in find_photographs(tmp_path, tmp_path / "out").photographs]
    assert len(set(names)) == 3


def test_a_scene_that_would_hold_the_photographs_is_refused(folder: Path) -> None:
    for out in (folder, folder.parent):
        with pytest.raises(InputError, match="holds the photographs"):
            find_photographs(folder, out)


def test_a_scene_inside_the_folder_is_left_aside(folder: Path) -> None:
    copies(folder, folder / "scene")
    assert len(find_photographs(folder, folder / "scene").photographs) == 3


def test_thumbnails_in_hidden_folders_are_left_aside(folder: Path, tmp_path: Path) -> None:
    hidden = folder / ".thumbnails" / "normal"
    hidden.mkdir(parents=True)
    (hidden / "IMG_0.jpg").write_bytes((folder / "IMG_0.jpg").read_bytes())
    (folder / "._IMG_0.jpg").write_bytes(b"of another system")
    assert len(find_photographs(folder, tmp_path / "out").photographs) == 3


def test_photographs_in_linked_folders_are_found_once(folder: Path, tmp_path: Path) -> None:
    day = tmp_path / "day"
    day.mkdir()
    (folder / "IMG_2.jpg").rename(day / "IMG_2.jpg")
    (day / "back").symlink_to(folder)
    (folder / "day").symlink_to(day)
    (folder / "z").mkdir()
    (folder / "IMG_1.jpg").rename(folder / "z" / "IMG_1.jpg")
    (folder / "a").symlink_to(folder / "z")
    copies(folder, tmp_path / "out")
    (folder / "out").symlink_to(tmp_path / "out")
    names = [each.name for each in find_photographs(folder, tmp_path / "out").photographs]
    assert names == ["IMG_0.jpg", "day_IMG_2.jpg", "z_IMG_1.jpg"]


def test_what_a_link_or_a_closed_folder_hides_is_named(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder / "IMG_3.jpg").symlink_to(tmp_path / "gone.jpg")
    (folder / "closed").mkdir()
    scan = os.scandir

    def refuse(place: str) -> object:
        if Path(place).name == "closed":
            raise PermissionError(13, "Permission denied", place)
        return scan(place)

    monkeypatch.setattr(os, "scandir", refuse)
    found = find_photographs(folder, tmp_path / "out")
    assert len(found.photographs) == 3
    said = {path.name: line for path, line in found.refused.items()}
    assert "it is a link to" in said["IMG_3.jpg"] and "Permission denied" in said["closed"]
    folder.rename(tmp_path / "closed")
    with pytest.raises(InputError, match=r"no photographs, .*closed cannot be read .*the right to"):
        find_photographs(tmp_path / "closed", tmp_path / "out")


def test_photographs_of_one_lens_and_size_share_it(folder: Path, tmp_path: Path) -> None:
    with Image.open(folder / "IMG_0.jpg") as image:
        image.crop((0, 0, 20, 20)).save(folder / "IMG_3.jpg")
    lenses = [each.lens for each in find_photographs(folder, tmp_path / "out").photographs]
    assert lenses[0] == lenses[1] == lenses[2] != lenses[3]


def test_what_cannot_be_used_is_named_with_a_remedy(folder: Path, tmp_path: Path) -> None:
    def refused(match: str) -> None:
        with pytest.raises(InputError, match=match) as caught:
            copies(folder, tmp_path / "out")
        assert "\n" not in str(caught.value)

    whole = (folder / "IMG_0.jpg").read_bytes()
    (folder / "IMG_0.jpg").write_bytes(whole[:-100])
    refused(r"IMG_0.jpg cannot be read .*: is the file whole")
    (folder / "IMG_0.jpg").write_bytes(b"no image")
    refused(r"IMG_0.jpg cannot be read as an image: .*save it as JPEG.*2 of 3 photographs can be")
    (folder / "IMG_0.jpg").write_bytes(whole)
    Image.new("RGBA", (32, 24)).save(folder / "clear.png")
    refused(r"1 of 4 photographs has an alpha channel, .*clear.png: give it to all")
    (folder / "clear.png").unlink()
    (folder / "IMG_0.jpg").unlink()
    refused("has 2 photographs, and 3 or more are needed: take more")


def test_a_photograph_of_many_that_cannot_be_used_is_left_out(folder: Path, tmp_path: Path) -> None:
    whole = (folder / "IMG_0.jpg").read_bytes()
    (folder / "cut.jpg").write_bytes(whole[:-100])
    (folder / "none.jpg").write_bytes(b"")
    Image.fromarray(np.zeros((24, 32), dtype=np.uint16)).save(folder / "deep.png")
    found = find_photographs(folder, tmp_path / "out")
    assert len(found.photographs) == 4  # what is cut off shows when it is decoded
    left = copy_photographs(found, tmp_path / "out" / "images")
    names = [each.name for each in left.photographs]
    assert names == ["IMG_0.jpg", "IMG_1.jpg", "IMG_2.jpg"]
    assert sorted(path.name for path in (tmp_path / "out" / "images").iterdir()) == names
    reasons = {path.name: line for path, line in left.refused.items()}
    assert reasons.keys() == {"cut.jpg", "none.jpg", "deep.png"}
    assert "is the file whole" in reasons["cut.jpg"]
    assert "8 bits a channel" in reasons["deep.png"]


def test_long_names_of_folders_are_cut_to_what_a_file_may_have(
    folder: Path, tmp_path: Path
) -> None:
    deep = folder / ("a" * 150) / ("b" * 150)
    deep.mkdir(parents=True)
    for number in range(2):
        (folder / f"IMG_{number}.jpg").rename(deep / f"IMG_{number}.jpg")
    names = sorted(copies(folder, tmp_path / "out"))
    assert [name[-9:] for name in names] == ["IMG_2.jpg", "IMG_0.jpg", "IMG_1.jpg"]
    assert len(names[1]) <= 80


@pytest.mark.parametrize(("letter", "most"), [("\u6d77", 80), ("\U00020000", 63)])
def test_the_longest_name_in_letters_of_several_bytes_is_written(
    letter: str, most: int, folder: Path, tmp_path: Path
) -> None:
    (folder / letter).mkdir()
    longest = letter * (250 // len(letter.encode()))
    with Image.open(folder / "IMG_0.jpg") as image:
        image.save(folder / letter / f"{longest}.tif")
    names = list(copies(folder, tmp_path / "out"))
    assert max(map(len, names)) == most + len(".png")


def test_a_copy_that_cannot_be_written_ends_the_work(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "out").write_bytes(b"a file where the folder should be")
    with pytest.raises(InputError, match=r"nothing can be written into .*--out$"):
        copies(folder, tmp_path / "out")


def test_a_photograph_that_goes_away_is_named_and_not_the_place_of_its_copy(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def gone(path: Path, turn: bool) -> Image.Image:
        image = decode(path, turn)
        path.unlink()
        return image

    monkeypatch.setattr(originals, "decode", gone)
    with pytest.raises(OSError, match=r"No such file .*photos/IMG_0\.jpg"):
        copies(folder, tmp_path / "out")


def test_damaged_exif_is_no_reason_to_refuse(folder: Path, tmp_path: Path) -> None:
    damaged = b"Exif\0\0MM\0*\0\0\0\x08\xff\xff" + 9 * b"\xfe"
    with Image.open(folder / "IMG_0.jpg") as image:
        image.save(folder / "IMG_3.jpg", exif=damaged)
    found = find_photographs(folder, tmp_path / "out").photographs
    assert [each.exif.position is None for each in found] == [False, False, False, True]


def test_a_folder_of_raw_files_says_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no folder"):
        find_photographs(tmp_path / "nowhere", tmp_path / "out")
    (photograph := tmp_path / "IMG_0.jpg").touch()
    with pytest.raises(InputError, match=r"IMG_0\.jpg is a file, not a folder: give the one with"):
        find_photographs(photograph, tmp_path / "out")
    photograph.unlink()
    with pytest.raises(InputError, match=r"no photographs, .*give the folder .*\.jpg"):
        find_photographs(tmp_path, tmp_path / "out")
    (tmp_path / "DJI_0001.MP4").write_bytes(b"film")
    with pytest.raises(InputError, match=r"no photographs, .*1 video is not read: .* ffmpeg -i"):
        find_photographs(tmp_path, tmp_path / "out")
    (tmp_path / "DJI_0001.DNG").write_bytes(b"raw")
    with pytest.raises(InputError, match=r"no photographs, .*1 raw file is not read, save it"):
        find_photographs(tmp_path, tmp_path / "out")


def test_heic_without_its_reader_is_left_out_by_name(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder / "IMG_9.HEIC").write_bytes(b"....ftypheic")
    monkeypatch.setitem(__import__("sys").modules, "pillow_heif", None)
    found = find_photographs(folder, tmp_path / "out")
    assert len(found.photographs) == 3
    (why,) = found.refused.values()
    assert "IMG_9.HEIC is HEIC: `pip install pillow-heif` reads it" in why
    (folder / "IMG_0.jpg").unlink()
    with pytest.raises(
        InputError, match=r"IMG_9.HEIC is HEIC: .* \(2 of 3 photographs can be used"
    ):
        find_photographs(folder, tmp_path / "out")


def test_jpeg_named_heic_is_read_and_alpha_named_jpg_keeps_it(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pillow_heif", None)
    (folder / "IMG_0.jpg").rename(folder / "IMG_0.HEIC")
    found = copies(folder, tmp_path / "out")
    assert found["IMG_0.HEIC.jpg"].format == "JPEG"
    clear = tmp_path / "clear"
    clear.mkdir()
    for number in range(3):
        Image.new("RGBA", (32, 24), (number, 2, 3, 4)).save(clear / f"{number}.jpg", "PNG")
    copied = copies(clear, tmp_path / "two")
    assert {name: image.mode for name, image in copied.items()} == dict.fromkeys(
        ("0.jpg.png", "1.jpg.png", "2.jpg.png"), "RGBA"
    )


def test_what_a_copy_or_its_lens_depends_on_makes_another_picture(folder: Path) -> None:
    """Other GPS does not, nor a comment, nor fill bytes before a marker."""

    def content() -> tuple[object, ...]:
        return find_photographs(folder, folder / "out").photographs[0].content

    path = folder / "IMG_0.jpg"
    plain, before = path.read_bytes(), content()
    end = 4 + int.from_bytes(plain[4:6], "big")
    filled = plain[:end] + b"\xff\xfe\x00\x06note" + b"\xff" * 3 + plain[end:]
    path.write_bytes(filled)
    name, length, *rest = content()
    assert (name, rest) == (before[0], list(before[2:]))
    assert length == before[1] + 3  # type: ignore[operator]
    with Image.open(path) as image:
        exif = image.getexif()
        exif[0x0112] = 3
        image.save(path, quality=95, exif=exif)
    assert content()[3] == 3


@pytest.mark.parametrize("kind", ["WEBP", "PNG", "TIFF"])
def test_what_a_name_says_wrongly_is_written_anew_as_its_name_says(
    kind: str, folder: Path, tmp_path: Path
) -> None:
    with Image.open(folder / "IMG_0.jpg") as image:
        image.save(folder / "IMG_1.jpg", kind)
    assert copies(folder, tmp_path / "out")["IMG_1.jpg"].format == "JPEG"


@pytest.mark.parametrize("kind", ["jpg", "tif"])
def test_the_size_of_a_turned_photograph_is_that_of_its_copy(
    kind: str, folder: Path, tmp_path: Path
) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    with Image.open(folder / "IMG_0.jpg") as image:
        image.save(folder / f"turned.{kind}", exif=exif)
    found = find_photographs(folder, tmp_path / "out").photographs
    (turned,) = (each for each in found if each.path.name == f"turned.{kind}")
    assert turned.size == copies(folder, tmp_path / "out")[turned.name].size == (24, 32)


def test_a_picture_larger_than_pillow_opens_is_named_with_its_reason(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 32 * 24 - 1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = find_photographs(folder, tmp_path / "out")
        copied = copy_photographs(found, tmp_path / "out" / "images")
    assert len(copied.photographs) == 3
    Image.new("RGB", (64, 25)).save(folder / "IMG_7.jpg")
    (why,) = find_photographs(folder, tmp_path / "out").refused.values()
    assert "IMG_7.jpg has more than the 0 megapixels that Pillow opens: make it smaller" in why


def test_exif_that_is_too_long_for_a_jpeg_is_left_out(folder: Path, tmp_path: Path) -> None:
    pillow_heif = pytest.importorskip("pillow_heif")
    pillow_heif.register_heif_opener()
    exif = exif_of((1.0, 2.0, 3.0))
    exif[0x010E] = "a" * 70_000
    with Image.open(folder / "IMG_0.jpg") as image:
        image.save(folder / "IMG_3.HEIC", exif=exif)
    copy = copies(folder, tmp_path / "out")["IMG_3.HEIC.jpg"]
    assert dict(copy.getexif()) == {0x0112: 1}


def test_heic_is_copied_as_jpeg(folder: Path, tmp_path: Path) -> None:
    pillow_heif = pytest.importorskip("pillow_heif")
    pillow_heif.register_heif_opener()
    with Image.open(folder / "IMG_0.jpg") as image:
        image.save(folder / "IMG_3.HEIC", exif=image.getexif())
    copy = copies(folder, tmp_path / "out")["IMG_3.HEIC.jpg"]
    assert copy.format == "JPEG" and copy.getexif().get_ifd(0x8825)
