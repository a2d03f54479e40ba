"""Claims about what EXIF says of a photograph."""

from __future__ import annotations

import io
import math

import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational
from rendered_survey import FOCAL, ORIGIN, exif_of

from leco_plugin.scenes.poses.originals import Exif, _position, focal_length, read_exif


def read(exif: Image.Exif, size: tuple[int, int] = (320, 240)) -> Exif:
    file = io.BytesIO()
    Image.new("L", size).save(file, "JPEG", exif=exif)
    with Image.open(file) as image:
        return read_exif(image)


def test_position_time_and_lens_are_read() -> None:
    found = read(exif_of((0.0, 0.0, 260.5), second=61))
    assert found.position == pytest.approx((*ORIGIN, 260.5), abs=1e-6)
    assert found.time is not None and found.time % 3600 == 61.0
    assert found.camera.startswith("Numpy Survey")
    assert found.focal == pytest.approx(FOCAL / 320, rel=0.02)


def test_a_digital_zoom_makes_another_lens() -> None:
    lenses = []
    for zoom in (None, 0.0, 1.0, 2.0):
        exif = Image.Exif()
        exif[0x8769] = {0xA405: 28} | ({} if zoom is None else {0xA404: zoom})
        lenses.append(read(exif).camera)
    assert lenses[0] == lenses[1] == lenses[2] != lenses[3]


@pytest.mark.parametrize(
    ("gps", "wanted"),
    [
        ({1: "S", 2: (10.0, 30.0, 36.0), 3: "W", 4: (20.0, 0.0, 0.0)}, (-10.51, -20.0)),
        ({1: b"S\0", 2: (10.0, 30.0, 36.0), 3: "\0W", 4: (20.0, 0.0, 0.0)}, (-10.51, -20.0)),
        ({1: "N", 2: (0.0, 0.0, 0.0), 3: "E", 4: (0.0, 0.0, 0.0)}, None),
        ({1: "N", 2: (95.0, 0.0, 0.0), 3: "E", 4: (1.0, 0.0, 0.0)}, None),
        ({1: "N", 2: (45.0, 0.0, 0.0)}, None),
        ({1: "N", 2: 45.0, 3: "E", 4: 1.0}, None),
        ({}, None),
    ],
    ids=["south and west", "as bytes", "no satellites", "no latitude", "half", "one part", "none"],
)
def test_a_position_is_of_the_globe_or_none(
    gps: dict[int, object], wanted: tuple[float, float] | None
) -> None:
    exif = Image.Exif()
    exif[0x8825] = gps
    found = read(exif).position
    assert (found is None) == (wanted is None)
    if found is not None:
        assert found[:2] == pytest.approx(wanted) and math.isnan(found[2])


@pytest.mark.parametrize(("reference", "sign"), [(0, 1), (1, -1), (2, 1), (3, -1)])
def test_altitudes_below_the_sea_and_the_ellipsoid_are_negative(reference: int, sign: int) -> None:
    exif = exif_of((0.0, 0.0, 9.0))
    exif[0x8825][5] = bytes([reference])
    found = read(exif).position
    assert found is not None and found[2] == 9.0 * sign


@pytest.mark.parametrize(
    ("parts", "reference"),
    [
        (((33, 1), (51.5, 1), (0, 0)), "S"),
        (((33, 1), (51.5, 1)), "S"),
        (((33.858333, 1), (0, 0), (0, 0)), "S"),
        (((-33, 1), (51, 1), (30, 1)), None),
        (((-33, 1), (-51, 1), (-30, 1)), None),
        (((-33, 1), (51, 1), (30, 1)), "S"),
    ],
    ids=["blank seconds", "two parts", "degrees alone", "signed", "all signed", "signed and named"],
)
def test_parts_that_are_blank_are_zero_and_a_sign_is_of_all_parts(
    parts: tuple[tuple[float, int], ...], reference: str | None
) -> None:
    gps = {2: tuple(IFDRational(*part) for part in parts), 3: "E", 4: (1.0, 0.0, 0.0)}
    position = _position(gps | ({} if reference is None else {1: reference}))
    assert position is not None and position[0] == pytest.approx(-33.858333, abs=1e-6)


@pytest.mark.parametrize("degrees", [IFDRational(0, 0), "wide"])
def test_a_position_without_degrees_is_none(degrees: object) -> None:
    assert _position({2: (degrees, 30.0, 0.0), 4: (1.0, 0.0, 0.0)}) is None


def test_an_altitude_may_be_below_the_sea() -> None:
    exif = Image.Exif()
    place = {1: "N", 2: (45.0, 0.0, 0.0), 3: "E", 4: (1.0, 0.0, 0.0)}
    exif[0x8825] = {**place, 5: b"\x01", 6: 12.0}
    position = read(exif).position
    assert position is not None and position[2] == -12.0


def test_an_altitude_of_nothing_at_all_is_not_known() -> None:
    place = {1: "N", 2: (45.0, 0.0, 0.0), 3: "E", 4: (1.0, 0.0, 0.0)}
    for altitude in ({}, {6: 0.0}):
        position = _position({**place, 5: b"\0", **altitude})
        assert position is not None and math.isnan(position[2])


def test_a_picture_made_smaller_keeps_its_field_of_view() -> None:
    """The resolution of the sensor is that of the picture as it was taken."""
    taken = {0x920A: 4.3, 0xA20E: 16393.4, 0xA210: 2, 0xA002: 4000, 0xA003: 3000}
    whole, small = focal_length(taken, (4000, 3000)), focal_length(taken, (800, 600))
    assert whole == small == pytest.approx(0.694, abs=1e-3)


@pytest.mark.parametrize(
    "details",
    [{}, {0xA405: 0}, {0xA405: "wide"}, {0xA405: 90_000}, {0x920A: 4.3, 0xA20E: 1e4, 0xA210: 9}],
)
def test_a_focal_length_that_no_lens_has_counts_as_not_said(details: dict[int, object]) -> None:
    assert focal_length(details, (800, 600)) is None


def test_damaged_exif_says_nothing() -> None:
    exif = Image.Exif()
    exif[0x8769] = {0x9003: "yesterday"}
    assert read(exif).time is None
    file = io.BytesIO()
    Image.new("L", (8, 8)).save(file, "JPEG", exif=b"Exif\0\0MM\0*\0\0\0\x08\xff\xff" + 9 * b"\xfe")
    with pytest.warns(UserWarning, match="Corrupt EXIF"), Image.open(file) as image:
        assert read_exif(image).position is None


def test_on_the_equator_or_the_meridian_of_greenwich_a_position_is_one() -> None:
    assert _position({2: (51.0, 30.0, 0.0), 4: (0.0, 0.0, 0.0)}) is not None
    assert _position({2: (0.0, 0.0, 0.0), 4: (109.0, 15.0, 0.0)}) is not None
