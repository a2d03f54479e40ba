"""Claims about sparse points for a scene that has poses."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import CameraType
from PIL import Image
from rendered_survey import BLOCKS
from scene_files import change, described, read_ply, refused

from leco_plugin import cli
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.lenses import lens_of
from leco_plugin.scenes.poses.points import BEFORE, FILE, camera_of, find_points, training_frames
from leco_plugin.scenes.poses.reconstruction import FEW, choose_posed_pairs
from leco_plugin.scenes.scene_file import SceneFile

pytestmark = pytest.mark.xdist_group("poses")  # which share `made`

FAR_AWAY = np.array([500_000.0, 4_600_000.0, 0.0])
"""Metres, as UTM has them."""


@pytest.fixture
def bare(made: Path, tmp_path: Path) -> Path:
    """The scene that `leco poses` made, far from its origin and without its points."""
    scene = tmp_path / "bare"
    shutil.copytree(made / "images", scene / "images")
    shutil.copy(made / "transforms.json", scene)

    def move(meta: dict[str, Any]) -> None:
        del meta["ply_file_path"]
        for frame in meta["frames"]:
            for row, shift in zip(frame["transform_matrix"], FAR_AWAY):
                row[3] += float(shift)

    change(scene, move)
    return scene


@pytest.fixture
def few(bare: Path) -> Path:
    """Eight photographs of that scene: two rows of the flight."""
    frames = sorted(described(bare)["frames"], key=lambda frame: frame["file_path"])
    change(bare, lambda meta: meta.update(frames=frames[:8]))
    return bare


def shuffle(meta: dict[str, Any]) -> None:
    """Gives each photograph the pose of another one."""
    poses = [frame["transform_matrix"] for frame in meta["frames"]]
    for frame, other in zip(meta["frames"], np.random.default_rng(0).permutation(len(poses))):
        frame["transform_matrix"] = poses[other]


def test_points_lie_where_mapping_finds_them_and_nothing_else_changes(
    bare: Path, made: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    before = (bare / "transforms.json").read_bytes()
    monkeypatch.chdir(bare.parent)
    assert cli.main(["points", bare.name, "--threads", "1"]) == 0  # a relative path, as typed
    known = read_ply(made / "sparse_pc.ply", torch.float64)
    found = read_ply(bare / FILE, torch.float64) - torch.from_numpy(FAR_AWAY)
    assert len(found) >= len(known)
    levels = torch.tensor([[0.0], *([block[-1]] for block in BLOCKS)], dtype=torch.float64)
    off = (found[:, 2] - levels).abs().amin(dim=0)  # metres
    assert off.median() < 0.1 and off.quantile(0.9) < 0.5
    assert torch.cdist(known, found).amin(dim=1).median() < 0.1
    assert (bare / BEFORE).read_bytes() == before
    meta = described(bare)
    assert meta.pop("ply_file_path") == FILE and meta == json.loads(before)
    assert cli.main(["points", str(bare)]) == 0
    assert "has" in (said := capsys.readouterr().out) and "nothing is done" in said


@pytest.mark.parametrize("hidden_by", ["masks", "opacity"])
def test_what_is_hidden_gets_no_points(few: Path, hidden_by: str) -> None:
    """The left third of each photograph is hidden; no point is there in all that see it."""
    bare, meta = few, described(few)
    for number, frame in enumerate(meta["frames"]):
        with Image.open(bare / frame["file_path"]) as image:
            shown = Image.new("L", image.size, 255)
            shown.paste(0, (0, 0, image.width // 3, image.height))
            if hidden_by == "masks":
                frame["mask_path"] = f"{number}.png"
                shown.save(bare / frame["mask_path"])
            else:
                image.putalpha(shown)
                frame["file_path"] = f"{number}.png"
                image.save(bare / frame["file_path"])
    before = (bare / "transforms.json").read_bytes()
    (bare / "hidden.json").write_text(json.dumps(meta))
    find_points(bare / "hidden.json", threads=1)  # what it writes is its own
    file = bare / f"hidden.{FILE}"
    assert json.loads((bare / "hidden.json").read_text())["ply_file_path"] == file.name
    assert json.loads((bare / f"hidden.{BEFORE}").read_text()) == meta
    assert (bare / "transforms.json").read_bytes() == before and not (bare / FILE).exists()
    points = (read_ply(file, torch.float64) - torch.from_numpy(FAR_AWAY)).numpy()
    seen = np.zeros(len(points), dtype=int)
    for frame in meta["frames"]:
        pose = np.array(frame["transform_matrix"])
        right, up, back = ((points - pose[:3, 3] + FAR_AWAY) @ pose[:3, :3]).T
        column = frame["cx"] - right / back * frame["fl_x"]
        row = frame["cy"] + up / back * frame["fl_y"]
        inside = (column > frame["w"] / 3 - 5) & (column < frame["w"])
        seen += inside & (row > 0) & (row < frame["h"])
    assert len(points) > 100 and (seen >= 2).all()


def test_poses_of_other_photographs_are_refused_and_nothing_is_written(few: Path) -> None:
    change(few, shuffle)
    before = sorted(few.iterdir()), (few / "transforms.json").read_bytes()
    with pytest.raises(InputError, match=r"agree with the poses in .*`leco poses` makes both"):
        find_points(few, threads=1)
    assert (sorted(few.iterdir()), (few / "transforms.json").read_bytes()) == before


def test_photographs_that_share_too_little_are_refused(pycolmap: Any, tiny_scene: Path) -> None:
    with pytest.raises(InputError, match="too few for points: add photographs between them"):
        find_points(tiny_scene, threads=1)


def test_photographs_of_another_size_than_their_intrinsics_are_refused(
    pycolmap: Any, scene: Path
) -> None:
    """As training refuses them."""
    Image.new("RGB", (16, 16)).save(scene / "images/001.png")
    with refused("001.png has 16 x 16 pixels, its intrinsics are for 32 x 32"):
        find_points(scene, threads=1)


def test_photographs_for_tests_are_left_out() -> None:
    frames = [{"file_path": f"{number}.jpg"} for number in range(4)]
    scene = SceneFile(Path("scene"), {"frames": frames[:3]}, frames, [], Path())
    assert training_frames(scene) == [0, 1, 2]  # the last is one of ScanNet++'s test frames
    scene.meta["train_filenames"] = ["2.jpg", "0.jpg"]
    assert training_frames(scene) == [0, 2]


def test_photographs_for_training_are_known_by_any_name_that_the_reader_takes(
    tmp_path: Path,
) -> None:
    (tmp_path / "images").mkdir()
    for name in "abcd":
        (tmp_path / "images" / f"{name}.png").touch()
    frames = [{"file_path": f"images/{name}"} for name in ("a.png", "b", "c.png", "d.png")]
    listed = ["./images/a.png", "images/b.png", "images\\c.png"]
    meta = {"frames": frames, "train_filenames": listed}
    scene = SceneFile(tmp_path / "transforms.json", meta, frames, [], tmp_path)
    assert training_frames(scene) == [0, 1, 2]


def test_a_disk_that_is_too_full_for_copies_is_said_before_the_work(
    pycolmap: Any, tiny_scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=1e6))
    monkeypatch.setattr("leco_plugin.scenes.poses.points._copies", None)
    with pytest.raises(InputError, match=r"TMPDIR .*: 1 MB are free on its disk, and \d+ are need"):
        find_points(tiny_scene)


def test_a_camera_is_scaled_with_its_copy(pycolmap: Any) -> None:
    meta = {"w": 800, "h": 600, "fl_x": 500, "fl_y": 510, "cx": 390, "cy": 310, "k1": 0.1}
    meta |= {"p2": 0.02, "camera_model": "OPENCV"}
    camera = camera_of(lens_of(meta, {}, "a.jpg"), (800, 600), (400, 300), "a.jpg")
    assert camera.params[:8].tolist() == [250, 255, 195, 155, 0.1, 0, 0, 0.02]
    fisheye = camera_of(
        lens_of(meta | {"camera_model": "OPENCV_FISHEYE", "p2": 0}, {}, "a.jpg"),
        (800, 600),
        (800, 600),
        "",
    )
    assert fisheye.model.name == "OPENCV_FISHEYE" and fisheye.params[4] == 0.1
    panorama = lens_of({"w": 800, "h": 400, "camera_model": "EQUIRECTANGULAR"}, {}, "a.jpg")
    assert panorama.kind is CameraType.EQUIRECTANGULAR
    with pytest.raises(
        InputError, match=r"a\.jpg: leco points needs a perspective or fisheye lens"
    ):
        camera_of(panorama, (800, 400), (800, 400), "a.jpg")


@pytest.mark.parametrize(
    ("model", "name", "said"),
    [("OPENCV", "k4", "k4 of a perspective lens"), ("OPENCV_FISHEYE", "p1", "p1 of a fisheye")],
)
def test_distortion_that_pycolmap_lacks_is_refused(
    model: str, name: str, said: str, pycolmap: Any
) -> None:
    """nerfstudio undoes it: points would be placed by another lens than rays."""
    meta = {"w": 800, "h": 600, "fl_x": 500, "fl_y": 510, "cx": 390, "cy": 310}
    lens = lens_of(meta | {"camera_model": model, name: 0.01}, {}, "a.jpg")
    with pytest.raises(InputError, match=rf"a\.jpg: leco points knows no {said}: undistort"):
        camera_of(lens, (800, 600), (800, 600), "a.jpg")


def test_pairs_by_pose_are_near_ones_that_look_the_same_way() -> None:
    poses = np.tile(np.eye(3, 4), (3 * FEW, 1, 1))
    poses[:, 0, 3] = np.arange(3 * FEW)
    poses[::2, :, 2] *= -1.0  # every other one looks back
    pairs = choose_posed_pairs(poses).pairs
    assert all(one < other and (other - one) % 2 == 0 for one, other in pairs)
    assert (10, 12) in pairs and len(pairs) < 12 * len(poses)
    assert len(choose_posed_pairs(poses[:FEW]).pairs) == FEW * (FEW - 1) // 2


def test_a_scene_that_cannot_be_written_to_is_refused_before_the_work(
    bare: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(dir: Path) -> None:
        raise PermissionError(13, "Permission denied", str(dir))

    monkeypatch.setattr("leco_plugin.scenes.whole_files.TemporaryFile", refuse)
    monkeypatch.setattr("leco_plugin.scenes.poses.points._copies", None)
    with pytest.raises(InputError, match=r"nothing can be written into .*Permission denied"):
        find_points(bare)
