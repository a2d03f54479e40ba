"""Block-NeRF's records, written here from their description, as scenes with cameras."""

from __future__ import annotations

import gzip
import io
import json
import re
import struct
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from PIL import Image
from scene_files import described, refused
from scipy.spatial.transform import Rotation

from leco_plugin.cli import main
from leco_plugin.scenes import block_nerf
from leco_plugin.scenes.block_nerf import make_scene
from leco_plugin.scenes.city.cameras import look_at
from leco_plugin.scenes.photographs import LecoPhotographsDataParserConfig

WIDTH, HEIGHT = 72, 48
BENT = (0.08, -0.03, 0.002, -0.003)
"""k1, k2, p1, p2."""


@dataclass(frozen=True)
class Shot:
    """A picture of a camera, as the records have it."""

    camera: int = 3
    known: int = 77
    place: tuple[float, float, float] = (5.0, -2.0, 1.8)
    bent: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    drift: float = 0.0
    """How far its camera moves while a picture is read out, from above to below."""
    turning: float = 0.0
    """Degrees by which it turns to the left meanwhile."""
    other: dict[str, bytes] = field(default_factory=dict)
    """Fields that replace those it has."""

    def pose(self) -> np.ndarray:
        place = np.array(self.place)
        return look_at(place, place + np.array([3.0, 1.0 + 0.1 * self.camera, -0.2]))

    def intrinsics(self) -> tuple[float, float, float, float]:
        return 60.0 + self.camera, 61.0, 35.0, 25.5

    def rays(self) -> tuple[np.ndarray, np.ndarray]:
        """Origins and directions [HEIGHT, WIDTH, 3], by nerfstudio's cameras."""
        k1, k2, p1, p2 = self.bent
        camera = Cameras(
            torch.from_numpy(self.pose()).float()[None],
            *self.intrinsics(),
            WIDTH,
            HEIGHT,
            distortion_params=torch.tensor([[k1, k2, 0.0, 0.0, p1, p2]]),
            camera_type=CameraType.PERSPECTIVE,
        )
        rays = camera.generate_rays(0)
        down = np.linspace(-0.5, 0.5, HEIGHT)[:, None, None] * [self.drift, 0.0, 0.0]
        angles = np.linspace(-0.5, 0.5, HEIGHT) * np.deg2rad(self.turning)
        turns = Rotation.from_rotvec(np.outer(angles, [0.0, 0.0, 1.0])).as_matrix()
        directions = np.einsum("yij,yxj->yxi", turns, rays.directions.numpy())
        return rays.origins.numpy() + down, directions

    def record(self) -> bytes:
        """A tf.train.Example."""
        origins, directions = self.rays()
        fields = {
            "image_hash": _integer(self.known),
            "cam_idx": _integer(self.camera),
            "width": _integer(WIDTH),
            "height": _integer(HEIGHT),
            "equivalent_exposure": _floats(np.array([0.3])),
            "image": _message((1, _message((1, picture(self.known))))),
            "ray_origins": _floats(origins),
            "ray_dirs": _floats(directions),
            "intrinsics": _floats(np.array(self.intrinsics()[:2])),
        }
        entries = [
            (1, _message((1, name.encode()), (2, value)))
            for name, value in (fields | self.other).items()
        ]
        return _message((1, _message(*entries)))


def picture(number: int, width: int = WIDTH, height: int = HEIGHT) -> bytes:
    noise = np.random.default_rng(abs(number)).integers(0, 256, (height, width, 3), dtype=np.uint8)
    file = io.BytesIO()
    Image.fromarray(noise).save(file, "png")
    return file.getvalue()


def _varint(value: int) -> bytes:
    said = b""
    while value > 127:
        said, value = said + bytes([value & 127 | 128]), value >> 7
    return said + bytes([value])


def _message(*fields: tuple[int, bytes]) -> bytes:
    return b"".join(
        _varint(number << 3 | 2) + _varint(len(content)) + content for number, content in fields
    )


def _integer(value: int) -> bytes:
    return _message((3, _message((1, _varint(value & (2**64 - 1))))))


def _floats(values: np.ndarray) -> bytes:
    return _message((2, _message((1, values.astype("<f4").tobytes()))))


def write(folder: Path, name: str, *shots: Shot) -> Path:
    """A file of records; sums of their bytes are nothing, as gzip has its own."""
    folder.mkdir(exist_ok=True)
    path = folder / f"waymo_block_nerf_mission_bay_{name}"
    with gzip.open(path, "wb") as file:
        for shot in shots:
            record = shot.record()
            file.write(struct.pack("<QI", len(record), 0) + record + bytes(4))
    return path


@pytest.fixture
def records(tmp_path: Path) -> Path:
    folder = tmp_path / "records"
    write(folder, "train.tfrecord-00000-of-00002", Shot(), Shot(known=-5, place=(6.0, 0.0, 2.0)))
    write(folder, "train.tfrecord-00001-of-00002", Shot(camera=4, known=8, bent=BENT))
    write(folder, "validation.tfrecord-00000-of-00001", Shot(known=2**62, place=(7.0, 1.0, 2.0)))
    return folder


def test_cameras_have_the_rays_of_their_records(records: Path, tmp_path: Path) -> None:
    report = make_scene(records, tmp_path / "scene")
    assert (report["pictures"], report["test_pictures"], report["cameras"]) == (4, 1, 2)
    assert report["error"]["worst"] < 0.01 and report["moved"] < 1e-5
    frames = {frame["file_path"]: frame for frame in described(tmp_path / "scene")["frames"]}
    assert "images/cam03_fffffffffffffffb.png" in frames and len(frames) == 4
    for shot in (Shot(), Shot(4, 8, bent=BENT)):
        frame = frames[f"images/cam{shot.camera:02d}_{shot.known:016x}.png"]
        np.testing.assert_allclose(np.array(frame["transform_matrix"])[:3], shot.pose(), atol=1e-4)
        fitted = [frame[name] for name in ("fl_x", "fl_y", "cx", "cy")]
        np.testing.assert_allclose(fitted, shot.intrinsics(), atol=0.02)
        assert ("k1" in frame) == any(shot.bent)
        if any(shot.bent):
            fitted = [frame[name] for name in ("k1", "k2", "p1", "p2")]
            np.testing.assert_allclose(fitted, shot.bent, atol=2e-3)
        written = (tmp_path / "scene" / frame["file_path"]).read_bytes()
        assert written == picture(shot.known)


def test_our_reader_and_nerfstudios_rays_agree_with_the_records(
    records: Path, tmp_path: Path
) -> None:
    make_scene(records, tmp_path / "scene")
    parser = LecoPhotographsDataParserConfig(data=tmp_path / "scene").setup()
    train, test = (parser.get_dataparser_outputs(split) for split in ("train", "val"))
    assert [len(each.image_filenames) for each in (train, test)] == [3, 1]
    number = [path.name[:5] for path in train.image_filenames].index("cam04")
    rays = train.cameras.generate_rays(number)
    origins, directions = Shot(camera=4, bent=BENT).rays()
    turn = train.dataparser_transform[:, :3].numpy()
    np.testing.assert_allclose(rays.directions.numpy(), directions @ turn.T, atol=3e-4)
    places = (origins @ turn.T + train.dataparser_transform[:, 3].numpy()) * train.dataparser_scale
    np.testing.assert_allclose(rays.origins.numpy(), places, atol=1e-4)


def test_a_camera_that_moves_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(tmp_path / "records", "train.tfrecord", Shot(drift=0.5))
    out = tmp_path / "scene"
    assert main(["rays", str(tmp_path / "records"), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "1 picture of 1 camera, 0 of them for testing" in said
    assert re.search(r"begin up to 0\.25\d* from its camera's place", said)
    assert f"leco points {out}" in said and "train_filenames" not in described(out)
    np.testing.assert_allclose(
        np.array(described(out)["frames"][0]["transform_matrix"])[:3, 3], Shot.place, atol=1e-4
    )


def test_a_car_that_turns_bends_no_lens_of_its_other_pictures(tmp_path: Path) -> None:
    shots = [Shot(known=1, turning=2.0), Shot(known=2, place=(6.0, 0.0, 2.0)), Shot(known=3)]
    write(tmp_path / "records", "train.tfrecord", *shots)
    report = make_scene(tmp_path / "records", tmp_path / "scene")
    assert report["worst"].endswith("01.png") and report["error"]["worst"] > 0.2
    assert report["error"]["median"] < 0.01
    for frame, shot in zip(described(tmp_path / "scene")["frames"], shots):
        fitted = [frame[name] for name in ("fl_x", "fl_y", "cx", "cy")]
        np.testing.assert_allclose(fitted, shot.intrinsics(), atol=0.02)
        off = np.array(frame["transform_matrix"])[:3] - shot.pose()
        half = np.deg2rad(shot.turning) / 2  # of the shear, at most, is a roll
        assert np.abs(off).max() < half + 1e-4


def test_a_lens_that_bends_its_rim_strongly_has_the_rays_of_its_pictures() -> None:
    k1, k2, values = -0.28, 0.06, np.array([700.0, 710.0, 950.0, 650.0])
    straight = np.linspace(0.0, 4.0, 100_000)
    bent = straight * (1.0 + k1 * straight**2 + k2 * straight**4)
    pixels = block_nerf._pixels(1920, 1280)
    points = (pixels - values[2:]) / values[:2]
    lengths = np.linalg.norm(points, axis=1, keepdims=True)
    rays = np.column_stack([points * np.interp(lengths, bent, straight) / lengths, lengths**0])
    turn = Rotation.from_rotvec([0.3, -2.0, 1.0])
    row = np.zeros((), block_nerf.RAYS)
    row["width"], row["height"] = 1920, 1280
    row["directions"] = turn.apply(rays / np.linalg.norm(rays, axis=1, keepdims=True))
    lens, error = block_nerf.fit_lens(row[()])
    np.testing.assert_allclose([lens[n] for n in ("fl_x", "fl_y", "cx", "cy")], values, atol=0.01)
    pose, off = block_nerf.fit_pose(row[()], lens)
    np.testing.assert_allclose(pose[:3, :3], turn.as_matrix() * [1.0, -1.0, -1.0], atol=1e-5)
    assert max(error, off) < 0.01


def test_pictures_of_other_heights_have_lenses_of_their_own(tmp_path: Path) -> None:
    origins, directions = (rays[:40] for rays in Shot().rays())
    image = _message((1, _message((1, picture(9, height=40)))))
    lower = {"height": _integer(40), "image": image, "ray_origins": _floats(origins)}
    low = Shot(known=99, other=lower | {"ray_dirs": _floats(directions)})
    write(tmp_path / "records", "train.tfrecord", Shot(), low)
    assert make_scene(tmp_path / "records", tmp_path / "scene")["error"]["worst"] < 0.01
    assert [frame["h"] for frame in described(tmp_path / "scene")["frames"]] == [48, 40]


def test_a_picture_that_stands_twice_counts_once_for_testing(records: Path, tmp_path: Path) -> None:
    write(records, "validation.tfrecord-00001-of-00002", Shot(camera=4, known=8, bent=BENT))
    report = make_scene(records, tmp_path / "scene")
    assert (report["pictures"], report["test_pictures"]) == (4, 2)


def test_a_killed_run_goes_on(
    records: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, out = make_scene(records, tmp_path / "whole"), records / "scene"  # in the way of none
    damaged = sorted(records.iterdir())[-1]
    content = damaged.read_bytes()
    damaged.write_bytes(content[:200])
    with refused("validation.tfrecord-00000-of-00001 is no file of Block-NeRF's records"):
        make_scene(records, out)
    assert not (out / "transforms.json").exists()
    (out / "images" / ".cut-off.part").touch()
    damaged.write_bytes(content)
    read = block_nerf._read
    asked: list[Path] = []
    monkeypatch.setattr(block_nerf, "_read", lambda *a: asked.append(a[0]) or read(*a))
    assert make_scene(records, out) == whole and asked == [damaged]
    assert described(out) == described(tmp_path / "whole")
    assert sorted(each.name for each in out.iterdir()) == ["images", "transforms.json"]
    assert len([*(out / "images").iterdir()]) == 4
    with refused("holds a scene already: give another folder"):
        make_scene(records, out)


def test_records_of_another_folder_are_not_taken_for_those_that_were_read(
    records: Path, tmp_path: Path
) -> None:
    damaged = sorted(records.iterdir())[-1]
    damaged.write_bytes(b"")
    with refused("no record"):
        make_scene(records, tmp_path / "scene")
    write(tmp_path / "other", "train.tfrecord-00000-of-00002", Shot(known=9))
    assert make_scene(tmp_path / "other", tmp_path / "scene")["pictures"] == 1


def test_a_file_that_another_of_its_size_replaces_is_read_anew(
    records: Path, tmp_path: Path
) -> None:
    first, *_, last = sorted(records.iterdir())
    other = write(tmp_path / "other", "train.tfrecord", Shot(known=9))
    whole, content = last.read_bytes(), other.read_bytes()
    first.write_bytes(first.read_bytes().ljust(1 << 19, b"\0"))  # gzip reads over such an end
    last.write_bytes(b"")
    with refused("no record"):
        make_scene(records, tmp_path / "scene")
    last.write_bytes(whole)
    first.write_bytes(content.ljust(1 << 19, b"\0"))
    assert make_scene(records, tmp_path / "scene")["pictures"] == 3
    files = {frame["file_path"] for frame in described(tmp_path / "scene")["frames"]}
    assert f"images/cam03_{9:016x}.png" in files


def _mirrored() -> dict[str, bytes]:
    return {"ray_dirs": _floats(Shot().rays()[1] * [1.0, 1.0, -1.0])}


def _behind() -> dict[str, bytes]:
    """Directions all around, as of a panorama."""
    around = Rotation.random(WIDTH * HEIGHT, rng=np.random.default_rng(0)).apply([1.0, 0.0, 0.0])
    return {"ray_dirs": _floats(around)}


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (_mirrored(), "of a mirrored picture"),
        (_behind(), "pixels from every lens"),
        ({"ray_dirs": _floats(np.zeros((HEIGHT, WIDTH, 3)))}, "of length 0"),
        ({"ray_dirs": _floats(np.full((HEIGHT, WIDTH, 3), np.nan))}, "not finite"),
        ({"ray_origins": _floats(np.full((HEIGHT, WIDTH, 3), np.inf))}, "not finite"),
        ({"ray_dirs": _floats(np.ones(5))}, "cannot reshape"),
        ({"ray_dirs": b""}, "KeyError: 'ray_dirs'"),
        ({"image": _message((1, _message((1, picture(0, 70)))))}, "for 72 x 48 rays"),
        ({"image": _message((1, _message((1, b"none"))))}, "no image that can be read"),
        ({"image": _message((1, b""))}, "IndexError"),
        ({"cam_idx": _integer(-1)}, "negative number"),
        ({"ray_dirs": _floats(np.ones((HEIGHT, WIDTH, 3)))}, "one direction"),
    ],
    ids=[
        *("mirrored", "panorama", "zero", "nan", "infinite", "few", "none", "size", "no-image"),
        *("empty", "negative", "parallel"),
    ],
)
def test_other_records_are_refused(tmp_path: Path, other: dict[str, bytes], message: str) -> None:
    write(tmp_path / "records", "train.tfrecord", Shot(other=other))
    with refused(message):
        make_scene(tmp_path / "records", tmp_path / "scene")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"no gzip", "BadGzipFile"),
        (gzip.compress(b"\x00" * 7 + b"\xff" + bytes(4)), "a record of"),
        (gzip.compress(struct.pack("<QI", 9, 0) + b"\x0a\xffabc"), "cut off|another form"),
        (gzip.compress(b"abc"), "unpack requires"),
        (gzip.compress(struct.pack("<QI", 999, 0) + Shot().record()[:99]), "cut off"),
        (b"", "no record"),
    ],
    ids=["no-gzip", "long", "cut-off", "short", "shorter", "empty"],
)
def test_other_files_are_refused(tmp_path: Path, content: bytes, message: str) -> None:
    write(tmp_path / "records", "train.tfrecord").write_bytes(content)
    with refused(message):
        make_scene(tmp_path / "records", tmp_path / "scene")


def test_a_folder_without_records_to_train_on_is_refused(tmp_path: Path) -> None:
    with refused("there is no folder"):
        make_scene(tmp_path / "none", tmp_path / "scene")
    write(tmp_path / "records", "validation.tfrecord", Shot())
    with refused("has no records to train on"):
        make_scene(tmp_path / "records", tmp_path / "scene")
    assert not (tmp_path / "scene").exists()


def test_what_was_fitted_is_written_as_json(records: Path, tmp_path: Path) -> None:
    file, out = tmp_path / "report.json", tmp_path / "s"
    given = ["rays", str(records), "--out", str(out), "--json"]
    assert main([*given, str(out / "transforms.json")]) == 2 and not out.exists()
    assert main([*given, str(file)]) == 0
    assert json.loads(file.read_text())["pictures"] == 4
