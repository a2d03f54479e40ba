"""A folder is written whole or not at all, never twice, and never over something else."""

from __future__ import annotations

import dataclasses
import shutil
import signal
import subprocess
import sys
import weakref
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image
from scene_files import described

from leco_plugin.scenes.city.city import City, CityConfig
from leco_plugin.scenes.city.folder import CaptureConfig, LayoutName, count_pictures, write_city
from leco_plugin.scenes.city.render import Tracer
from leco_plugin.scenes.input_error import InputError

CITY = CityConfig(blocks=1, seed=3, sky=True)
CAPTURE = CaptureConfig(40, 30, aerial_per_block=6, street_per_block=3, test_every=3)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_city(CITY, tmp_path_factory.mktemp("scenes") / "city", CAPTURE)


@pytest.fixture
def copy(folder: Path, tmp_path: Path) -> Path:
    """A folder that a test may damage."""
    return Path(shutil.copytree(folder, tmp_path / "city"))


@pytest.fixture(scope="module")
def mega_nerf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same city in Mega-NeRF's format."""
    place = tmp_path_factory.mktemp("scenes") / "city"
    return write_city(CITY, place, CAPTURE, layout="mega-nerf")


def test_the_city_is_rebuilt_from_its_folder(folder: Path) -> None:
    assert City.from_folder(folder).config == CITY
    transforms = described(folder)
    frame = transforms["frames"][5]
    picture = np.array(Image.open(folder / frame["file_path"]))
    pose = np.array(frame["transform_matrix"])[:3]
    image, depth = Tracer(City.from_folder(folder)).photograph(pose, CAPTURE.lens)
    assert np.array_equal(picture, image)
    stored = CAPTURE.lens.along_ray(np.load(folder / frame["depth_file_path"]))
    np.testing.assert_allclose(stored, depth, rtol=1e-6)


def test_splits_share_the_pictures_without_overlap(folder: Path) -> None:
    transforms = described(folder)
    paths = {frame["file_path"] for frame in transforms["frames"]}
    train, test = set(transforms["train_filenames"]), set(transforms["test_filenames"])
    assert train | test == paths
    assert not train & test
    assert len(paths) == 9
    assert len(test) == 3
    assert transforms["orientation_override"] == "none"


def test_the_sparse_points_lie_on_surfaces(folder: Path) -> None:
    cloud = trimesh.load(folder / "sparse_pc.ply")
    points = np.asarray(cloud.vertices)
    assert len(points) > 500
    assert City.from_folder(folder).distance(points).max() < 1e-4
    assert np.asarray(cloud.colors).std() > 5


def test_a_folder_of_the_same_city_is_left_as_it_is(folder: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    assert write_city(CITY, folder, CAPTURE) == folder
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before


@pytest.mark.parametrize("change", [{"blocks": 2}, {"seed": 9}, {"sky": False}])
def test_a_folder_of_another_city_is_refused(folder: Path, change: dict) -> None:
    (name,) = change
    with pytest.raises(FileExistsError, match=rf"^[^\n]*another city \({name} is[^\n]*$"):
        write_city(dataclasses.replace(CITY, **change), folder, CAPTURE)
    with pytest.raises(FileExistsError, match="width is 40 there, not 80"):
        write_city(CITY, folder, dataclasses.replace(CAPTURE, width=80))


def test_a_folder_or_file_of_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "holiday.jpg").write_text("precious")
    for place in (tmp_path, tmp_path / "holiday.jpg"):
        with pytest.raises(FileExistsError, match=r"^[^\n]*is not a city[^\n]*$"):
            write_city(CITY, place, CAPTURE)
    assert [path.name for path in tmp_path.iterdir()] == ["holiday.jpg"]


@pytest.mark.parametrize(
    "damage", ["picture", "depth", "points", "transforms", "frames", "json", "config"]
)
def test_a_damaged_folder_gets_one_line(copy: Path, damage: str) -> None:
    if damage in ("picture", "depth"):
        next((copy / ("images" if damage == "picture" else "depths")).iterdir()).unlink()
    elif damage in ("points", "transforms"):
        (copy / {"points": "sparse_pc.ply"}.get(damage, "transforms.json")).unlink()
    elif damage == "frames":
        (copy / "transforms.json").write_text('{"frames": [{"file_path": "images/a.png"}]}')
    elif damage == "json":
        (copy / "city.json").write_text("{")
    else:
        (copy / "city.json").write_text('{"format": 1, "city": {"bricks": 7}}')
    with pytest.raises(ValueError, match=r"^[^\n]+$"):
        write_city(CITY, copy, CAPTURE)


KILLED = """
import os, pathlib, signal, sys
from leco_plugin.scenes.city.city import CityConfig
from leco_plugin.scenes.city.folder import CaptureConfig, write_city
from leco_plugin.scenes.city.render import Tracer
from leco_plugin.scenes import whole_files

photograph, taken = Tracer.photograph, []

def until_killed(self, *arguments):
    taken.append(1)
    if len(taken) == 4:  # in the middle of a file
        open(sys.argv[1] + "/" + os.listdir(sys.argv[1])[0] + "/.a.png.1-1.part", "w")
        os.kill(os.getpid(), signal.SIGKILL)
    return photograph(self, *arguments)

Tracer.photograph = until_killed
capture = CaptureConfig(40, 30, aerial_per_block=6, street_per_block=3, test_every=3)
config = CityConfig(blocks=1, seed=3, sky=True)
for layout in sys.argv[2:]:
    os.mkdir(sys.argv[1] + "/" + layout)
    if (child := os.fork()) == 0:
        sys.argv[1] += "/" + layout
        write_city(config, pathlib.Path(sys.argv[1], "city"), capture, layout)
        os._exit(0)
    print(os.WTERMSIG(os.waitpid(child, 0)[1]))
"""
LAYOUTS: tuple[LayoutName, ...] = ("nerfstudio", "mega-nerf")


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one of each layout, in which a run was killed while it wrote a city.

    One process imports what they need, and each run is a fork of it.
    """
    folder = tmp_path_factory.mktemp("killed")
    command = [sys.executable, "-W", "ignore", "-c", KILLED, str(folder), *LAYOUTS]
    done = subprocess.run(command, timeout=200, capture_output=True, text=True, check=True)
    assert done.stdout.split() == [str(int(signal.SIGKILL))] * len(LAYOUTS)
    return folder


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_killed_run_is_taken_up_where_it_ended(
    layout: LayoutName, killed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = killed / layout
    assert not (folder / "city").exists()
    assert [path.name for path in folder.iterdir() if path.name.startswith(".")] != []
    taken = []
    photograph = Tracer.photograph

    def count(self: Tracer, *arguments: Any) -> Any:
        taken.append(1)
        return photograph(self, *arguments)

    monkeypatch.setattr(Tracer, "photograph", count)
    resumed = write_city(CITY, folder / "city", CAPTURE, layout=layout)
    assert len(taken) == 9 - 3
    whole = write_city(CITY, folder / "other", CAPTURE, layout=layout)
    assert [path.name for path in folder.iterdir() if path.name.startswith(".")] == []
    assert contents(resumed) == contents(whole)


def contents(folder: Path) -> dict[str, bytes]:
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def test_a_city_is_written_into_the_folder_that_a_link_leads_to(
    tmp_path: Path,
) -> None:
    for name in ("there", "not_yet"):
        (tmp_path / f"to_{name}").symlink_to(tmp_path / name)
    (tmp_path / "there").mkdir()
    one = CaptureConfig(8, 8, aerial_per_block=2, street_per_block=0)
    for name in ("there", "not_yet"):
        assert write_city(CITY, tmp_path / f"to_{name}", one) == tmp_path / f"to_{name}"
        assert count_pictures(tmp_path / name) == (2, 1)


def test_a_folder_that_cannot_be_replaced_is_refused_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="where this command runs: give a folder in it"):
        write_city(CITY, Path(), CAPTURE)
    monkeypatch.setattr("os.path.ismount", lambda path: True)
    with pytest.raises(InputError, match="a disk is mounted"):
        write_city(CITY, tmp_path / "mounted", CAPTURE)
    assert not any(tmp_path.iterdir())


def test_an_interrupted_write_keeps_what_it_has_out_of_sight(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Tracer, "photograph", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_city(CITY, tmp_path / "city", CAPTURE)
    assert all(path.name.startswith(".city-unfinished-") for path in tmp_path.iterdir())


def test_two_processes_that_write_one_city_help_each_other(tmp_path: Path) -> None:
    with ThreadPoolExecutor(2) as pool:
        runs = [pool.submit(write_city, CITY, tmp_path / "city", CAPTURE) for _ in range(2)]
        folders = [run.result() for run in runs]
    assert folders == 2 * [tmp_path / "city"]
    assert [path.name for path in tmp_path.iterdir()] == ["city"]


def test_no_picture_stays_in_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Depth(np.ndarray):
        """An array whose life can be watched."""

    alive: list[weakref.ref[Depth]] = []
    most = []
    photograph = Tracer.photograph

    def watch(self: Tracer, *arguments: Any) -> Any:
        most.append(sum(one() is not None for one in alive))
        image, depth = photograph(self, *arguments)
        watched = depth.view(Depth)
        alive.append(weakref.ref(watched))
        return image, watched

    monkeypatch.setattr(Tracer, "photograph", watch)
    write_city(CITY, tmp_path / "city", CAPTURE)
    assert len(most) == 9 and max(most) <= 1


def test_a_city_in_another_format_is_refused(folder: Path) -> None:
    with pytest.raises(FileExistsError, match="layout is nerfstudio there, not mega-nerf"):
        write_city(CITY, folder, CAPTURE, layout="mega-nerf")


@pytest.mark.parametrize(
    "lost", ["mappings.txt", "coordinates.pt", "train/rgbs/000000.png", "val/metadata/000001.pt"]
)
def test_a_damaged_city_in_mega_nerfs_format_is_named(
    lost: str, mega_nerf: Path, tmp_path: Path
) -> None:
    folder = Path(shutil.copytree(mega_nerf, tmp_path / "city"))
    assert count_pictures(folder) == (9, 3)
    (folder / lost).unlink()
    with pytest.raises(ValueError, match=f"is damaged: .*{Path(lost).name} is missing"):
        write_city(CITY, folder, CAPTURE, layout="mega-nerf")


def test_no_city_at_all_is_said_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"^[^\n]*holds no city[^\n]*$"):
        City.from_folder(tmp_path)
