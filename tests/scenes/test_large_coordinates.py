"""Scenes with large coordinates, as of UTM, are read as exactly as those around their origin."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import mega_nerf_scene
import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManagerConfig
from nerfstudio.data.dataparsers.base_dataparser import (
    DataParser,
    DataparserOutputs,
)
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.instant_ngp_dataparser import InstantNGPDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import (
    Nerfstudio,
    NerfstudioDataParserConfig,
)
from nerfstudio.data.utils.colmap_parsing_utils import (
    read_cameras_text,
    read_images_text,
    read_points3D_text,
    write_cameras_binary,
    write_images_binary,
    write_points3D_binary,
)
from scene_files import change, described, write_colmap, write_ply

from leco_plugin.scenes.data_manager import LecoDataManagerConfig
from leco_plugin.scenes.frames import POINTS, data_frame_of, frame_of, inverse, moved
from leco_plugin.scenes.large_coordinates import FAR, _rounding, far_origin
from leco_plugin.scenes.mega_nerf import MegaNerfDataParserConfig
from leco_plugin.scenes.mega_nerf_files import Coordinates
from leco_plugin.scenes.photographs import LecoPhotographsDataParserConfig
from leco_plugin.scenes.survey import points_in, survey

UTM = np.array([500_000.25, 5_200_000.5, 300.0])
SCALE = 20.0
APPLIED = np.array([[0.0, 1.0, 0.0, 3.0], [1.0, 0.0, 0.0, -2.0], [0.0, 0.0, -1.0, 1.0]])
SPARSE = np.random.default_rng(0).uniform([-1.5, -1.5, 0.0], [1.5, 1.5, 0.6], (60, 3))


def as_nerfstudio(scene: Path, folder: Path, offset: np.ndarray) -> None:
    """The tiny scene in units of 1 / `SCALE`, moved, with sparse points."""
    shutil.copytree(scene, folder)
    write_ply(folder / "points.ply", SCALE * SPARSE + offset)

    def move(meta: dict[str, Any]) -> None:
        meta["ply_file_path"] = "points.ply"
        for frame in meta["frames"]:
            pose = np.array(frame["transform_matrix"])
            pose[:3, 3] = SCALE * pose[:3, 3] + offset
            frame["transform_matrix"] = pose.tolist()

    change(folder, move)


def as_blender(scene: Path, folder: Path, offset: np.ndarray) -> None:
    as_nerfstudio(scene, folder, offset)
    meta = described(folder)
    for split in ("train", "val", "test"):
        names = meta[f"{split}_filenames"]
        frames = [frame for frame in meta["frames"] if frame["file_path"] in names]
        frames = [frame | {"file_path": frame["file_path"][:-4]} for frame in frames]
        of_split = {"camera_angle_x": 0.9, "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(of_split))


def as_colmap(scene: Path, folder: Path, offset: np.ndarray) -> None:
    as_nerfstudio(scene, folder, offset)
    lens = "PINHOLE 32 32 32 32 16 16"
    write_colmap(folder, folder / "sparse", lens, SCALE * SPARSE + offset)


def as_binary_colmap(scene: Path, folder: Path, offset: np.ndarray) -> None:
    as_colmap(scene, folder, offset)
    model = folder / "sparse"
    write_cameras_binary(read_cameras_text(model / "cameras.txt"), model / "cameras.bin")
    write_images_binary(read_images_text(model / "images.txt"), model / "images.bin")
    write_points3D_binary(read_points3D_text(model / "points3D.txt"), model / "points3D.bin")
    for file in model.glob("*.txt"):
        file.unlink()


class OfAnother(Nerfstudio):
    """A reader of another package, built on nerfstudio's."""

    def _generate_dataparser_outputs(self, split: str = "train") -> DataparserOutputs:
        outputs: DataparserOutputs = super()._generate_dataparser_outputs(split)
        outputs.metadata["seen"] = True
        return outputs


Write = Callable[[Path, Path, np.ndarray], None]
COLMAP = {"colmap_path": Path("sparse"), "downscale_factor": 1, "eval_interval": 4}
READERS: dict[str, tuple[Write, Callable[..., Any], dict[str, Any]]] = {
    "leco-photographs": (as_nerfstudio, LecoPhotographsDataParserConfig, {}),
    "nerfstudio-data": (as_nerfstudio, NerfstudioDataParserConfig, {}),
    "nerfstudio-data by pca": (
        as_nerfstudio,
        NerfstudioDataParserConfig,
        {"orientation_method": "pca", "center_method": "focus"},
    ),
    "a subclass": (as_nerfstudio, NerfstudioDataParserConfig, {"_target": OfAnother}),
    "colmap": (as_colmap, ColmapDataParserConfig, COLMAP),
    "colmap, binary": (as_binary_colmap, ColmapDataParserConfig, COLMAP),
    "colmap as it is": (
        as_colmap,
        ColmapDataParserConfig,
        COLMAP | {"assume_colmap_world_coordinate_convention": False},
    ),
    "nerfstudio-data, not centred": (
        as_nerfstudio,
        NerfstudioDataParserConfig,
        {"center_method": "none", "auto_scale_poses": False},
    ),
    "instant-ngp-data": (as_nerfstudio, InstantNGPDataParserConfig, {"eval_mode": "interval"}),
    "blender-data": (as_blender, BlenderDataParserConfig, {}),
}
CENTRED = list(READERS)[:-3]


def managed(reader: str, scene: Path, folder: Path, offset: np.ndarray, **more: Any) -> Any:
    """A data manager on the tiny scene as that reader has it, moved."""
    write, config, options = READERS[reader]
    write(scene, folder, offset)
    parser = config(data=folder, **options | more)
    return LecoDataManagerConfig(dataparser=parser, images="memory").setup(device="cpu")


def exact(folder: Path) -> dict[str, np.ndarray]:
    """Positions of cameras by the names of their photographs, as the file has them."""
    return {
        Path(frame["file_path"]).stem: np.array(frame["transform_matrix"])[:3, 3]
        for frame in described(folder)["frames"]
    }


def in_the_data(manager: Any, positions: torch.Tensor) -> np.ndarray:
    """Positions of a model as the data's own files have them."""
    back = inverse(torch.tensor(data_frame_of(manager), dtype=torch.float64))
    return moved(positions.double(), back).numpy()


def check_places(manager: Any, outputs: DataparserOutputs, folder: Path) -> np.ndarray:
    """The cameras lead back to where the file has them, which is returned."""
    known = exact(folder)
    expected = np.array([known[path.stem] for path in outputs.image_filenames])
    found = in_the_data(manager, outputs.cameras.camera_to_worlds[:, :3, 3])
    np.testing.assert_allclose(found, expected, atol=2e-4, rtol=0)
    return expected


@pytest.mark.parametrize("reader", READERS)
def test_cameras_lead_back_to_the_data_in_every_split(
    reader: str, tiny_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """In float32 northings would be half a metre apart."""
    manager = managed(reader, tiny_scene, tmp_path / "far", UTM)
    assert capsys.readouterr().out.count("coordinates are large") == 1
    for outputs in (
        manager.train_dataparser_outputs,
        manager.dataparser.get_dataparser_outputs(split="test"),
    ):
        check_places(manager, outputs, tmp_path / "far")
        assert float(outputs.cameras.camera_to_worlds[:, :3, 3].abs().max()) < 10 * SCALE
    points = points_in(manager.train_dataparser_outputs.metadata)
    if points is not None:
        found = in_the_data(manager, points)
        np.testing.assert_allclose(found, SCALE * SPARSE + UTM, atol=2e-4, rtol=0)
    assert (points is None) == reader.startswith(("instant-ngp", "blender"))


@pytest.mark.parametrize("reader", CENTRED)
def test_a_moved_scene_is_the_same_to_a_model(
    reader: str, tiny_scene: Path, tmp_path: Path
) -> None:
    far = managed(reader, tiny_scene, tmp_path / "far", UTM).train_dataparser_outputs
    near = managed(reader, tiny_scene, tmp_path / "near", np.zeros(3)).train_dataparser_outputs
    poses, expected = far.cameras.camera_to_worlds, near.cameras.camera_to_worlds
    torch.testing.assert_close(poses, expected, atol=1e-4, rtol=0)
    assert far.dataparser_scale == pytest.approx(near.dataparser_scale, rel=1e-4)
    if (points := points_in(near.metadata)) is not None:
        torch.testing.assert_close(points_in(far.metadata), points, atol=1e-4, rtol=0)


@pytest.mark.parametrize("reader", ["leco-photographs", "nerfstudio-data", "colmap"])
def test_a_scene_near_its_origin_is_read_as_nerfstudio_reads_it(
    reader: str, tiny_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    manager = managed(reader, tiny_scene, tmp_path / "near", np.array([100.0, 50.0, 7.0]))
    outputs = manager.train_dataparser_outputs
    parser = READERS[reader][1](data=tmp_path / "near", **READERS[reader][2]).setup()
    if reader == "leco-photographs":
        options = {"data": tmp_path / "near", "orientation_method": "none"}
        parser = NerfstudioDataParserConfig(**options).setup()
    expected = parser.get_dataparser_outputs(split="train")
    assert torch.equal(outputs.cameras.camera_to_worlds, expected.cameras.camera_to_worlds)
    assert torch.equal(outputs.dataparser_transform, expected.dataparser_transform)
    assert "large" not in capsys.readouterr().out


@pytest.mark.parametrize("reader", ["leco-photographs", "nerfstudio-data"])
@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_what_was_applied_to_a_file_is_undone_in_one_frame_and_kept_in_the_other(
    reader: str, scale: float, tiny_scene: Path, tmp_path: Path
) -> None:
    _, config, options = READERS[reader]
    as_nerfstudio(tiny_scene, tmp_path / "far", UTM)
    said = {"applied_transform": APPLIED.tolist(), "applied_scale": scale}
    change(tmp_path / "far", lambda meta: meta.update(said))
    parser = config(data=tmp_path / "far", **options)
    manager: Any = LecoDataManagerConfig(dataparser=parser, images="memory").setup(device="cpu")
    of_file = check_places(manager, manager.train_dataparser_outputs, tmp_path / "far")
    # as nerfstudio's own frame has it: the scale outside, the transform inside
    frame = np.array(frame_of(manager))
    places = manager.train_dataparser_outputs.cameras.camera_to_worlds[:, :3, 3].double().numpy()
    before = (places - frame[:, 3]) @ np.linalg.inv(frame[:, :3]).T
    after = before @ APPLIED[:, :3].T + APPLIED[:, 3]
    if scale == 1.0:
        np.testing.assert_allclose(after, of_file, atol=2e-4, rtol=0)
    else:  # what nerfstudio says of a scaled file holds for distances
        distances = np.linalg.norm(after - after[0], axis=1) * scale
        expected = np.linalg.norm(of_file - of_file[0], axis=1)
        np.testing.assert_allclose(distances, expected, atol=2e-4)


def test_what_nerfstudio_saves_and_exports_has_the_shift(tiny_scene: Path, tmp_path: Path) -> None:
    """`dataparser_transforms.json` of the run folder, and `ns-export --save-world-frame`."""
    manager = managed("nerfstudio-data", tiny_scene, tmp_path / "far", UTM)
    outputs = manager.train_dataparser_outputs
    outputs.save_dataparser_transform(tmp_path / "dataparser_transforms.json")
    saved = json.loads((tmp_path / "dataparser_transforms.json").read_text())
    matrix = saved["scale"] * np.array(saved["transform"])
    places = outputs.cameras.camera_to_worlds[:, :3, 3].double().numpy()
    expected = np.array([exact(tmp_path / "far")[path.stem] for path in outputs.image_filenames])
    back = (places - matrix[:, 3]) @ np.linalg.inv(matrix[:, :3]).T
    np.testing.assert_allclose(back, expected, atol=2e-4, rtol=0)
    poses = outputs.transform_poses_to_original_space(outputs.cameras.camera_to_worlds)
    np.testing.assert_allclose(poses[:, :3, 3].numpy(), expected, atol=2e-4, rtol=0)


@pytest.mark.parametrize("reader", ["nerfstudio-data", "blender-data"])
def test_points_that_nerfstudio_reads_by_open3d_are_exact_too(
    reader: str, tiny_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cloud = SimpleNamespace(points=SCALE * SPARSE + UTM, colors=np.zeros_like(SPARSE))
    (open3d := ModuleType("open3d")).io = SimpleNamespace(  # type: ignore[attr-defined]
        read_point_cloud=lambda path: cloud
    )
    monkeypatch.setitem(sys.modules, "open3d", open3d)
    more: dict[str, Any] = {"load_3D_points": True}
    if reader == "blender-data":
        more = {"ply_path": Path("points.ply"), "scale_factor": 0.25}
    manager = managed(reader, tiny_scene, tmp_path / "far", UTM, **more)
    points = in_the_data(manager, manager.train_dataparser_outputs.metadata["points3D_xyz"])
    np.testing.assert_allclose(points, cloud.points, atol=2e-4, rtol=0)


@pytest.mark.parametrize("reader", ["leco-photographs", "colmap"])
def test_altitudes_are_those_of_the_data(reader: str, tiny_scene: Path, tmp_path: Path) -> None:
    """The cameras are 14 m over the origin; a tilt of a degree would be 90 km of northings."""
    manager = managed(reader, tiny_scene, tmp_path / "far", UTM)
    units = survey(manager).units
    heights = manager.train_dataset.cameras.camera_to_worlds[:, 2, 3]
    assert units is not None
    assert units.altitude(float(heights.mean())) == pytest.approx(UTM[2] + 14.0, abs=0.5)


class Unhelped(DataParser):
    """A reader of another package that reads the file by itself, and says what it did."""

    def _generate_dataparser_outputs(self, split: str = "train", **kwargs: Any) -> Any:
        frames = described(self.config.data)["frames"]
        poses = np.array([frame["transform_matrix"] for frame in frames])[:, :3]
        cameras = torch.from_numpy(poses.astype(np.float32))
        middle = cameras[:, :, 3].mean(dim=0)
        cameras[:, :, 3] = 0.1 * (cameras[:, :, 3] - middle)
        return DataparserOutputs(
            image_filenames=[self.config.data / frame["file_path"] for frame in frames],
            cameras=Cameras(cameras, 32.0, 32.0, 16.0, 16.0, 32, 32),
            dataparser_transform=torch.cat([torch.eye(3), -middle[:, None]], dim=1),
            dataparser_scale=0.1,
        )


@pytest.mark.parametrize("offset", [UTM, np.array([30.0, -10.0, 5.0])], ids=["far", "near"])
@pytest.mark.parametrize("reader", [Unhelped, Nerfstudio], ids=lambda reader: reader.__name__)
def test_a_reader_that_cannot_be_helped_is_named(
    reader: type, offset: np.ndarray, tiny_scene: Path, tmp_path: Path
) -> None:
    """In a method with a data manager of its own nerfstudio's readers are none of ours."""
    as_nerfstudio(tiny_scene, tmp_path / "scene", offset)
    parser: Any = NerfstudioDataParserConfig(_target=reader, data=tmp_path / "scene")
    own = LecoDataManagerConfig if reader is Unhelped else VanillaDataManagerConfig
    manager: Any = own(dataparser=parser).setup(device="cpu")
    said = [line for line in survey(manager).lines() if "rounds" in line]
    assert len(said) == (offset is UTM)
    named = f"the reader {reader.__name__} rounds large coordinates to 0.5: take (50000"
    assert all(line.startswith(named) for line in said)


def test_our_reader_does_not_round_in_whatever_data_manager(
    tiny_scene: Path, tmp_path: Path
) -> None:
    as_nerfstudio(tiny_scene, tmp_path / "scene", UTM)
    parser = LecoPhotographsDataParserConfig(data=tmp_path / "scene")
    manager: Any = VanillaDataManagerConfig(dataparser=parser).setup(device="cpu")
    check_places(manager, manager.train_dataparser_outputs, tmp_path / "scene")
    assert not any("rounds" in line for line in survey(manager).lines())


def test_points_and_frame_of_mega_nerfs_format_keep_their_metres(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its origin is in metres (down, right, back); northings lie on the third axis."""
    moved_by = np.array([-300.0, 500_000.25, -5_200_000.5])
    here = mega_nerf_scene.COORDINATES
    files = here.to_file(mega_nerf_scene.poses())
    far = Coordinates(here.origin_drb + moved_by, here.metres)
    monkeypatch.setattr(mega_nerf_scene, "COORDINATES", far)
    monkeypatch.setattr(Coordinates, "to_file", lambda self, poses: files)
    folder = mega_nerf_scene.write(tmp_path / "scene")
    cameras = files[:, :, 3] * far.metres + far.origin_drb
    write_ply(folder / "points.ply", cameras)
    parser = MegaNerfDataParserConfig(data=folder, protocol="full", val_scale_factor=1)
    outputs = parser.setup().get_dataparser_outputs("train")
    trained = [n for n in range(7) if n not in mega_nerf_scene.VALIDATION]
    places = outputs.cameras.camera_to_worlds[:, :, 3]
    torch.testing.assert_close(outputs.metadata[POINTS][trained], places, atol=1e-5, rtol=0)
    manager = SimpleNamespace(train_dataparser_outputs=outputs)
    found = in_the_data(manager, places)
    np.testing.assert_allclose(found, cameras[trained], atol=1e-3, rtol=0)


@pytest.mark.parametrize(("share", "is_far"), [(0.99, False), (1.01, True)])
def test_coordinates_are_large_beside_the_spread_of_the_cameras(share: float, is_far: bool) -> None:
    """The median distance from the middle is 2."""
    around = np.array([[0.0, 0.0, 0.0], [1.0, 0, 0], [-2.0, 0, 0], [0, 2.0, 0], [0, 0, 90.0]])
    away = share * FAR * 2.0 * np.array([0.6, -0.8, 0.0])
    found = far_origin(around + away)
    assert (found is not None) == is_far
    if found is not None:
        np.testing.assert_allclose(found, away)
        assert _rounding(np.array([-5_200_000.5, 500_000.25, 300.0])) == 0.5


@pytest.mark.parametrize("share", [0.9, 1.1])
def test_where_most_cameras_stand_at_one_place_the_farthest_says_what_is_far(share: float) -> None:
    """As of a panorama; all at one place say nothing."""
    around = np.array([[0.0, 0.0, 0.0]] * 5 + [[1.0, 0, 0], [0, -2.0, 0]])
    away = share * FAR * 2.0 * np.array([0.6, -0.8, 0.0])
    assert (far_origin(around + away) is not None) == (share > 1.0)
    assert far_origin(around[:5] + away) is None
