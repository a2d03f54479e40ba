"""Claims about `leco poses`: from rendered photographs to a scene, and what is said on the way."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image
from rendered_survey import (
    HEIGHT,
    METRES_A_DEGREE,
    ORIGIN,
    PLACES,
    WIDTH,
    exif_of,
    grid,
    write_survey,
)
from scene_files import described, read_ply

from leco_plugin import cli
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.photographs import LecoPhotographsDataParserConfig
from leco_plugin.scenes.poses import command
from leco_plugin.scenes.poses.command import _report, make_scene, summary
from leco_plugin.scenes.poses.georeference import Placement
from leco_plugin.scenes.whole_files import alone_in

pytestmark = pytest.mark.xdist_group("poses")


def places_of(scene: Path) -> dict[str, np.ndarray]:
    """Where each photograph was taken, by its name without an ending."""
    return {
        Path(frame["file_path"]).stem: np.array(frame["transform_matrix"])[:3, 3]
        for frame in described(scene)["frames"]
    }


@pytest.mark.slow
def test_photographs_of_all_kinds_are_placed_where_they_were_taken(made: Path) -> None:
    found = places_of(made)
    assert len(found) == 12
    origin = described(made)["geographic_origin"]
    north = METRES_A_DEGREE[0] * (origin["latitude"] - ORIGIN[0])
    east = METRES_A_DEGREE[1] * (origin["longitude"] - ORIGIN[1])
    for number, place in enumerate(PLACES):
        there = found[f"IMG_0{number:03}"] + [east, north, 0.0]
        known = number != 7  # nothing says the focal length of this one
        np.testing.assert_allclose(there, place, atol=0.3 if known else 1.5)
    report = json.loads((made / "poses.json").read_text())
    assert report == json.loads(made.with_suffix(".json").read_text())
    assert report["placed"] == 12 and report["not_placed"] == []
    assert report["gps"]["photographs"] == 11 and report["gps"]["most_metres"] < 0.3


@pytest.mark.slow
def test_pictures_are_upright_and_lenses_are_those_of_their_sizes(made: Path) -> None:
    lenses = {Path(frame["file_path"]).stem: frame for frame in described(made)["frames"]}
    for name, lens in lenses.items():
        size = (WIDTH - 40, HEIGHT - 40) if name == "IMG_0007" else (WIDTH, HEIGHT)
        with Image.open(made / lens["file_path"]) as image:
            assert image.size == (lens["w"], lens["h"]) == size
        assert lens["fl_x"] == pytest.approx(256.0, rel=0.03)


@pytest.mark.slow
def test_the_scene_is_upright_in_metres_with_points_in_its_coordinates(made: Path) -> None:
    meta = described(made)
    assert meta["metres_per_unit"] == 1.0
    assert meta["geographic_origin"]["latitude"] == pytest.approx(41.5, abs=1e-3)
    points = read_ply(made / meta["ply_file_path"])
    heights = points[:, 2]
    assert float(((heights > -0.5) & (heights < 10.5)).float().mean()) > 0.9
    outputs = LecoPhotographsDataParserConfig(data=made).setup().get_dataparser_outputs("train")
    assert bool((outputs.cameras.camera_to_worlds[:, 2, 2] > 0.95).all())


@pytest.mark.slow
def test_colmaps_own_model_has_the_same_coordinates(made: Path, pycolmap: Any) -> None:
    model = pycolmap.Reconstruction(made / "colmap/sparse/0")
    found = places_of(made)
    for image in model.images.values():
        np.testing.assert_allclose(
            image.projection_center(), found[Path(image.name).stem], atol=1e-6
        )


@pytest.mark.slow
def test_a_finished_scene_is_left_as_it_is(
    made: Path, photos: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = (made / "transforms.json").stat().st_mtime_ns
    assert make_scene(photos, made)["placed"] == 12
    assert "already holds this scene: nothing is done" in capsys.readouterr().out
    assert (made / "transforms.json").stat().st_mtime_ns == before
    with pytest.raises(InputError, match="was begun with other lens and size: give another folder"):
        make_scene(photos, made, "fisheye", 800)


def copied_without(made: Path, out: Path, *names: str) -> Path:
    """A copy of a scene that lacks some of its files."""
    shutil.copytree(made, out)
    for name in names:
        (out / name).unlink()
    return out


@pytest.mark.slow
def test_a_finished_scene_gets_a_picture_back_that_was_lost(
    made: Path, photos: Path, tmp_path: Path, pycolmap: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    lost = copied_without(made, tmp_path / "lost", "images/IMG_0000.jpg", "sparse_pc.ply")
    edited = (lost / "transforms.json").read_text().replace("1.0", "1.00")
    (lost / "transforms.json").write_text(edited)
    monkeypatch.setattr(pycolmap, "incremental_mapping", None)
    assert make_scene(photos, lost, threads=1)["placed"] == 12
    assert (lost / "images" / "IMG_0000.jpg").is_file()
    np.testing.assert_allclose(read_ply(lost / "sparse_pc.ply"), read_ply(made / "sparse_pc.ply"))
    assert (lost / "transforms.json").read_text() == edited


@pytest.mark.slow
def test_a_scene_within_its_photographs_is_known_by_any_path(
    pycolmap: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder = tmp_path / "photos"
    write_survey(folder, grid(3, 2))
    monkeypatch.chdir(tmp_path)
    report = make_scene(Path("photos"), Path("../") / tmp_path.name / "photos" / "out", threads=1)
    assert make_scene(Path("photos"), Path("photos/out"), threads=1) == report
    assert "nothing is done" in capsys.readouterr().out


@pytest.mark.slow
def test_a_run_that_was_killed_goes_on_with_what_is_missing(
    made: Path, photos: Path, tmp_path: Path, pycolmap: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a run that was killed while it mapped: features and matches are not made again."""
    gone = ("transforms.json", "poses.json", "colmap/models/all", "images/IMG_0000.jpg")
    killed = copied_without(made, tmp_path / "killed", *gone)
    (killed / "images" / ".IMG_0001.jpg.7-7.part").touch()
    monkeypatch.setattr(pycolmap, "extract_features", None)
    matched = pycolmap.Database.open(killed / "colmap/database.db").num_matched_image_pairs()
    assert make_scene(photos, killed, threads=1)["placed"] == 12
    assert (
        pycolmap.Database.open(killed / "colmap/database.db").num_matched_image_pairs() == matched
    )
    assert not [*killed.rglob("*.part")]


def with_exif(jpeg: bytes, exif: Image.Exif) -> bytes:
    """The same pixels with other EXIF."""
    rest = jpeg[2:]
    while rest[:2] in (b"\xff\xe0", b"\xff\xe1"):
        rest = rest[2 + int.from_bytes(rest[2:4], "big") :]
    said = exif.tobytes()
    return b"\xff\xd8\xff\xe1" + (len(said) + 2).to_bytes(2, "big") + said + rest


@pytest.mark.slow
def test_a_survey_whose_gps_is_mended_is_placed_anew_from_its_matches(
    pycolmap: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """As exiftool mends it: pixels stay as they are, and files get longer."""
    folder, out, places = tmp_path / "photos", tmp_path / "out", grid(3, 2)
    paths = write_survey(folder, places)
    right = [path.read_bytes() for path in paths]
    for path, wrong in zip(paths, np.random.default_rng(1).permutation(6)):
        shuffled = exif_of(places[wrong] if wrong else None)
        path.write_bytes(with_exif(path.read_bytes(), shuffled))
    assert not make_scene(folder, out, threads=1)["gps"]["used"]
    assert paths[0].stat().st_size != len(right[0]) or paths[1].stat().st_size != len(right[1])
    for path, content in zip(paths, right):
        path.write_bytes(content)
    monkeypatch.setattr(pycolmap, "extract_features", None)
    report = make_scene(folder, out, threads=1)
    assert "EXIF has other GPS than before" in capsys.readouterr().out
    assert report["gps"]["used"] and report["gps"]["most_metres"] < 1.0
    assert described(out)["metres_per_unit"] == 1.0
    assert "metres_per_unit" not in json.loads((out / "transforms.before_gps.json").read_text())
    assert make_scene(folder, out, threads=1) == report
    assert "nothing is done" in capsys.readouterr().out


def test_two_processes_do_not_make_one_scene_at_once(
    pycolmap: Any, photos: Path, tmp_path: Path
) -> None:
    """pycolmap would abort one of them in the middle."""
    with alone_in(tmp_path / "out", "scene"), pytest.raises(InputError, match="another process"):
        make_scene(photos, tmp_path / "out")


@pytest.mark.slow
def test_of_two_blocks_the_largest_is_written_and_wrong_gps_is_not_used(
    pycolmap: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "blocks"
    large, small = grid(3, 2), grid(2, 2)
    write_survey(folder, large, seed=1)
    write_survey(folder, small, seed=2)
    order = np.random.default_rng(1).permutation(6)
    for path, wrong in zip(sorted(folder.glob("IMG_1*")), order):
        with Image.open(path) as image:
            image.save(path, quality=95, exif=exif_of(large[wrong]))
    out = tmp_path / "out"
    assert cli.main(["poses", str(folder), "--out", str(out), "--threads", "1"]) == 0
    report = json.loads((out / "poses.json").read_text())
    others = [f"IMG_2{number:03}.jpg" for number in range(4)]
    assert report["placed"] == 6 and report["not_placed"] == others
    assert report["other_blocks"] == [others]
    said = capsys.readouterr().out
    assert "6 of 10 photographs are placed" in said
    assert "4 of these fit together only in groups of their own, which share too little" in said
    assert "give leco poses a folder with its photographs alone" in said
    kept = [pycolmap.Reconstruction(each) for each in (out / "colmap/models").glob("[0-9]*")]
    assert sorted(each.num_reg_images() for each in kept) == [4, 6]
    assert "no metres: GPS contradicts the poses: " in said and "mend EXIF" in said
    meta = described(out)
    assert not {"metres_per_unit", "geographic_origin"} & {*meta}
    assert min(frame["transform_matrix"][2][2] for frame in meta["frames"]) > 0.9


def test_a_folder_that_a_full_disk_left_without_files_can_be_used(
    pycolmap: Any, photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(command, "write_json", fail)
    for _ in range(2):
        with pytest.raises(OSError, match="No space left"):
            make_scene(photos, tmp_path / "out")
        (tmp_path / "out" / "colmap").mkdir(exist_ok=True)
        (tmp_path / "out" / ".DS_Store").touch()


def test_a_folder_with_something_else_is_refused_before_any_work(
    pycolmap: Any, photos: Path, tiny_scene: Path, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match="holds something else: give another folder"):
        make_scene(photos, tiny_scene)
    (tmp_path / "colmap").mkdir()
    (tmp_path / "colmap" / "asked.json").write_text('{"format"')
    with pytest.raises(InputError, match=r"asked\.json is damaged .*: give another folder"):
        make_scene(photos, tmp_path)


def test_without_pycolmap_one_line_says_how_to_install_it(
    photos: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pycolmap", None)
    assert cli.main(["poses", str(photos), "--out", str(tmp_path / "out")]) == 1
    said = capsys.readouterr().err
    assert "pip install 'pycolmap>=4' pillow-heif" in said and said.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_bad_options_are_refused(pycolmap: Any, photos: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="size is 10; it must be 100 pixels or more"):
        make_scene(photos, tmp_path / "out", size=10)
    with pytest.raises(InputError, match="threads is -1"):
        make_scene(photos, tmp_path / "out", threads=-1)
    with pytest.raises(InputError, match="there is no folder"):
        make_scene(tmp_path / "nowhere", tmp_path / "out")


def test_the_summary_names_some_and_counts_the_rest() -> None:
    report = {
        **{"photographs": 20, "placed": 8, "points": 9, "reprojection_error": 0.5},
        "not_placed": [f"{number}.jpg" for number in range(12)],
        "not_read": ["cut.jpg"],
        "altitudes": False,
        "other_blocks": [],
        "gps": {"used": True, "photographs": 8, "median_metres": 1.234, "most_metres": 5.0}
        | {"contradicted": []},
    }
    assert summary(report) == [
        "8 of 20 photographs are placed, with 9 points (0.50 pixels mean error)",
        "left out, as they cannot be read: cut.jpg",
        "not placed: 0.jpg, 1.jpg, 2.jpg, 3.jpg, 4.jpg and 7 more (poses.json has all)",
        "more overlap between neighbours places more photographs",
        "in metres by the GPS of 8 photographs: they are off by 1.23 m (median) and 5.00 m at most",
        "EXIF gives no altitude: heights count from the cameras, not the sea",
    ]
    groups = report | {"other_blocks": [["0.jpg", "1.jpg", "2.jpg"], ["2.jpg", "3.jpg"]]}
    assert any(line.startswith("4 of these fit together only in") for line in summary(groups))


@pytest.mark.parametrize(("placed", "advised"), [(8, True), (9, False)])
def test_more_overlap_is_advised_where_a_fifth_is_not_placed(placed: int, advised: bool) -> None:
    report = {
        **{"photographs": 10, "placed": placed, "points": 9, "reprojection_error": 0.5},
        **{"not_placed": ["lost.jpg"], "not_read": [], "other_blocks": []},
        "gps": {"used": False, "reason": "no photograph has GPS"},
    }
    assert any("more overlap" in line for line in summary(report)) == advised


def test_photographs_whose_gps_contradicts_their_poses_are_named() -> None:
    model: Any = SimpleNamespace(
        images={number: photographed(f"{number}.jpg") for number in range(5)},
        reg_image_ids=lambda: range(5),
        num_points3D=lambda: 9,
        compute_mean_reprojection_error=lambda: 0.5,
    )
    off = np.array([1.0, 2.0, 6e6, 3.0, np.nan])
    placement = Placement(1.0, np.eye(3), np.zeros(3), off)
    report = _report([model], {f"{number}.jpg": f"{number}.jpg" for number in range(5)}, placement)
    assert report["gps"]["photographs"] == 3 and report["gps"]["most_metres"] == 3.0
    assert report["gps"]["contradicted"] == ["2.jpg"] and report["gps"]["astray"] == []
    farther = replace(placement, residuals=np.where(off == 3.0, 30.0, off))
    assert _report([model], {f"{n}.jpg": f"{n}.jpg" for n in range(5)}, farther)["gps"][
        "astray"
    ] == ["3.jpg"]
    said = summary(report | {"not_read": [], "altitudes": True})
    assert said[-1] == "GPS contradicts the poses by more than 50 m, and is not used, of 2.jpg"
    level = report | {"gps": {**report["gps"], "level": True}}
    said = summary(level | {"not_read": [], "altitudes": True})
    assert any("altitudes in EXIF contradict the poses" in line for line in said)


def test_photographs_that_lie_astray_of_their_gps_are_named_where_the_others_do_not() -> None:
    gps = {"used": True, "photographs": 9, "median_metres": 0.3, "most_metres": 27.0}
    report = {
        **{"photographs": 9, "placed": 9, "points": 9, "reprojection_error": 0.5},
        **{"not_placed": [], "not_read": [], "other_blocks": [], "altitudes": True},
    }
    said = summary(report | {"gps": {**gps, "astray": ["zoomed.jpg"], "contradicted": []}})
    assert said[-1].endswith("as with another zoom or wrong GPS: zoomed.jpg")
    said = summary(report | {"gps": {**gps, "astray": [], "contradicted": []}})
    assert not any("zoom" in line for line in said)


def photographed(name: str) -> Any:
    """An image of pycolmap's, at the origin."""
    pose = SimpleNamespace(inverse=lambda: SimpleNamespace(matrix=lambda: np.eye(3, 4)))
    return SimpleNamespace(name=name, cam_from_world=lambda: pose)


def test_commands_to_copy_hold_names_with_blanks_together() -> None:
    from leco_plugin.cli import _training

    assert _training(Path("my scene")) == "ns-train leco-occupancy --data 'my scene'"


def test_a_photograph_that_is_mended_before_features_are_sought_begins_anew(
    pycolmap: Any,
    photos: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder, out = tmp_path / "photos", tmp_path / "out"
    shutil.copytree(photos, folder)
    last = sorted(folder.iterdir())[-1]
    whole = last.read_bytes()
    last.write_bytes(whole[:-200])
    stopped = InputError("at the features")
    monkeypatch.setattr(pycolmap, "import_images", lambda *_: (_ for _ in ()).throw(stopped))
    with pytest.raises(InputError, match="at the features"):
        make_scene(folder, out)
    said = capsys.readouterr().out
    assert f"left out: {last} cannot be read" in said and "is the file whole" in said
    assert not (out / "images" / last.name).exists()
    last.write_bytes(whole)
    with pytest.raises(InputError, match="at the features"):
        make_scene(folder, out)
    assert (out / "images" / last.name).read_bytes() == whole


def test_a_disk_that_is_too_full_is_said_before_the_work(
    pycolmap: Any, photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = SimpleNamespace(free=3e6)
    monkeypatch.setattr("leco_plugin.scenes.poses.command.shutil.disk_usage", lambda _: full)
    with pytest.raises(InputError, match="3 MB are free on its disk, and 13 are needed: free some"):
        make_scene(photos, tmp_path / "out")


def test_disk_is_counted_for_copies_that_are_larger_than_their_originals(
    pycolmap: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three turned photographs are written anew."""
    exif = Image.Exif()
    exif[0x0112] = 6
    folder = tmp_path / "photos"
    folder.mkdir()
    for number in range(3):
        noise = np.random.default_rng(number).integers(0, 255, (600, 800, 3), dtype=np.uint8)
        Image.fromarray(noise).save(folder / f"{number}.jpg", exif=exif)
    size = sum(path.stat().st_size for path in folder.iterdir())
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=3e6 + 2 * size))
    with pytest.raises(InputError, match=f"and {(3e6 + 3 * size) / 1e6:.0f} are needed"):
        make_scene(folder, tmp_path / "out")


def test_a_disk_that_copies_have_filled_is_said_before_features_are_sought(
    pycolmap: Any, photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    free = iter((1e9, 3e6))
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=next(free)))
    monkeypatch.setattr(pycolmap, "import_images", None)
    with pytest.raises(InputError, match="3 MB are free on its disk, and 12 are needed"):
        make_scene(photos, tmp_path / "out")
